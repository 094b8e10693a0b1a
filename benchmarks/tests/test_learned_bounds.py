"""What is learned of parts' misses holds for scenes that were not learned from."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from bounds import bounded, learned, left_out, quantile_of

TRUE = {"center_std": 0.8, "nearest": 0.4, "cost": 0.0}


def rows(seed, count=3000, constant=-1.0):
    rng = np.random.default_rng(seed)
    figures = {name: rng.normal(1.0, 0.7, count) for name in TRUE}
    logs = constant + sum(TRUE[name] * figures[name] for name in TRUE) + rng.normal(0, 0.4, count)
    # One tumor an answer; each scene is judged twice.
    about = {"scene": np.arange(count) // 2, "answer": np.arange(count) % 2, "part": "tumor_1"}
    about |= {"organ": rng.integers(0, 5, count), "family": rng.choice(["rest", "pull"], count)}
    misses = {
        "largest_error_mm": np.exp(logs),
        "center_mm": 0.8 * np.exp(logs),
        "rigid_fit_mm": 2.0,
    }
    return pd.DataFrame({**about, **misses, "finding": None, **figures})


def bounds_mm(model, some):
    return np.array([model.bound_mm(known) for known in some[list(TRUE)].to_dict("records")])


def test_the_quantile_is_found_and_follows_the_figures():
    model, fresh = quantile_of(rows(0)), rows(1)
    found_mm = bounds_mm(model, fresh)
    assert (fresh.largest_error_mm <= found_mm).mean() == pytest.approx(0.95, abs=0.015)
    right_mm = np.exp(-1.0 + fresh.center_std * 0.8 + fresh.nearest * 0.4 + 1.645 * 0.4)
    usual = fresh[list(TRUE)].apply(lambda each: each.between(0.0, 2.0)).all(axis=1)
    assert np.abs(np.log(found_mm / right_mm)[usual]).mean() < 0.12
    for other_mm in (np.quantile(fresh.largest_error_mm, 0.95), 0.8 * found_mm, 1.25 * found_mm):
        assert _pinball(fresh.largest_error_mm, found_mm) < _pinball(
            fresh.largest_error_mm, other_mm
        )


def _pinball(misses_mm, given_mm):
    over_mm = misses_mm - given_mm
    return np.maximum(0.95 * over_mm, -0.05 * over_mm).mean()


def test_tumors_and_organs_have_their_own():
    organs = rows(2).assign(part="kidney")
    organs["largest_error_mm"] *= 3
    model = learned(pd.concat([rows(0), organs], ignore_index=True), {"seed": 3})
    ratio = bounds_mm(model.organ, organs) / bounds_mm(model.tumor, organs)
    assert np.median(ratio) == pytest.approx(3.0, rel=0.1)
    assert model.about == {"seed": 3, "answers": 6000}


def test_what_makes_an_answer_poor_anyway_does_not_widen_the_bound():
    plain, lost = rows(0), rows(2, 200)
    lost["largest_error_mm"], lost["finding"] = 80.0, "fit"
    both = pd.concat([plain, lost], ignore_index=True)
    assert quantile_of(both) == quantile_of(plain)


def test_families_count_alike_however_many_answers_they_have():
    few = rows(3, 600).assign(family="pull")
    few["largest_error_mm"] *= 4
    together = pd.concat([rows(0).assign(family="rest"), few], ignore_index=True)
    model = quantile_of(together)
    within = together.largest_error_mm <= bounds_mm(model, together)
    shares = within.groupby(together.family).mean()
    assert shares.mean() == pytest.approx(0.95, abs=0.01)


def test_each_part_is_judged_by_what_was_learned_from_the_others():
    table = left_out(bounded(rows(4), "organ"), "organ").set_index("organ")
    assert list(table.index) == [0, 1, 2, 3, 4, "all"]
    assert table["within the bound %"].between(91, 98.5).all()
    assert table.loc["all", "rank correlation"] == pytest.approx(0.8, abs=0.1)
    by_family = left_out(bounded(rows(4), "organ"), "family").set_index("family")
    assert list(by_family.index) == ["pull", "rest", "all"]
    assert (by_family["rigid fit: median"] == 2.0).all()
    assert by_family.loc["all", "answers"] == table.loc["all", "answers"]


def test_an_answer_is_good_if_all_its_tumors_are_near():
    one, sure = rows(6), left_out(bounded(rows(6), "organ"), "organ").iloc[-1]["good %"]
    far = one.assign(
        center_std=9.0, largest_error_mm=one.largest_error_mm * np.exp(0.8 * (9.0 - one.center_std))
    )
    both = left_out(bounded(pd.concat([one, far], ignore_index=True), "organ"), "organ").iloc[-1][
        "good %"
    ]
    assert sure > 20
    assert both == 0


def test_weights_are_never_negative():
    turned = rows(5)
    turned["cost"] = -turned["center_std"] + np.random.default_rng(0).normal(0, 0.1, len(turned))
    hinges = quantile_of(turned).hinges
    assert min(weight for each in hinges.values() for _, weight in each) > 0
