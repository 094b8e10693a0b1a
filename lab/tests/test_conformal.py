"""Conformal quantiles, risk bounds and tested rules against known answers and by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom

from tumortrack_lab.margins.conformal import (
    conformal_quantile,
    groups_of,
    least_scores,
    least_tested,
    loosest_rule,
    risk_bound,
)


def test_the_quantile_is_the_stated_score():
    assert [least_scores(c) for c in (0.5, 0.8, 0.9, 0.95)] == [1, 4, 9, 19]
    scores = np.random.default_rng(0).permutation(np.arange(1.0, 20.0))  # 1 to 19
    assert conformal_quantile(scores, 0.95) == 19  # ceil(20 * 0.95) = 19
    assert conformal_quantile(scores, 0.9) == 18
    assert conformal_quantile(scores, 0.5) == 10
    assert conformal_quantile(scores[1:], 0.95) == math.inf  # 18 do not suffice
    assert conformal_quantile(np.arange(1.0, 40.0), 0.9) == 36  # 40 * 0.9 is not above 36


@pytest.mark.parametrize("confidence", [0.8, 0.9])
def test_a_further_score_is_covered_as_often_as_stated(confidence):
    """With n = 19 the coverage is exactly the confidence; one rank lower it would be 5 % less,
    which is 30 standard errors here."""
    rng = np.random.default_rng(5)
    drawn = rng.exponential(size=(40_000, 20))
    at = np.array([conformal_quantile(some, confidence) for some in drawn[:, 1:]])
    covered = (drawn[:, 0] <= at).mean()
    assert abs(covered - confidence) < 4 * math.sqrt(confidence * (1 - confidence) / len(drawn))


def test_the_bound_is_clopper_and_pearsons():
    assert risk_bound(0, 59) == pytest.approx(1 - 0.05 ** (1 / 59))
    assert risk_bound(0, 59) < 0.05 < risk_bound(0, 58)
    assert (least_tested(0.05), least_tested(0.1), least_tested(0.5)) == (59, 29, 5)
    assert least_tested(0.05, misses=1) == 93
    bound = risk_bound(3, 100, 0.1)
    assert binom.cdf(3, 100, bound) == pytest.approx(0.1)  # its definition
    assert risk_bound(0, 0) == risk_bound(7, 7) == 1.0


def test_the_loosest_rule_before_the_first_that_fails_is_found():
    rules = [[(0, 70)], [(0, 60), (1, 150)], [(0, 100), (9, 100)], [(0, 900)]]
    assert loosest_rule(rules, 0.05) == 1  # what comes after a failure is not asked
    assert loosest_rule(rules, 0.2) == 3
    assert loosest_rule([[(0, 58)], *rules], 0.05) is None
    assert loosest_rule(rules, 0.05, 0.025) is None  # 72 without a miss
    assert loosest_rule([[(0, 72)]], 0.05, 0.025) == 0


def test_a_rule_with_too_large_a_risk_passes_as_seldom_as_stated():
    """Three rules whose risk is just too large, in one of two groups: one of them is returned with
    a chance of at most 5 % (a little less, as counts are whole numbers)."""
    rng = np.random.default_rng(3)
    missed = rng.binomial(200, 0.101, (8000, 3))
    wrong = [
        loosest_rule([[(0, 200), (int(count), 200)] for count in counts], 0.1) is not None
        for counts in missed
    ]
    assert 0.02 < np.mean(wrong) < 0.05


def test_small_groups_join_the_next_larger_one():
    labels = [("a", "far", "x")] * 5 + [("a", "far", "y")] * 2 + [("a", "near", "x")] * 1
    labels += [("b", "far", "x")]
    found = groups_of(labels, 4)
    assert {label: len(of) for label, of in found.items()} == {
        ("a", "far", "x"): 5,
        ("a", "far"): 7,  # y's two, with x's five
        ("a",): 8,
        (): 9,
    }
    np.testing.assert_array_equal(found["a", "far"], np.arange(7))
