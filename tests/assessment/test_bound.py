"""How far off tumors may be: the shipped model, its laws, and the verdict that follows from it."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reports import reporting
from tumortrack.assessment import bound, verdict
from tumortrack.assessment.advice import advise, worthwhile
from tumortrack.assessment.bound import (
    POOR_MM,
    BoundModel,
    Quantile,
    alternatives_mm,
    bounds_of,
    figures,
    shipped,
)
from tumortrack.core.assessment import ErrorBound
from tumortrack.core.types import DepthError, Look, SensorCloud
from tumortrack.models.report import estimate_of
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, placed


@pytest.fixture(scope="module")
def estimate(slim_model):
    cloud = visible()
    return Tracker(load_model(slim_model, "cpu")).locate(cloud, 16, 0)


@pytest.fixture
def one_place(monkeypatch):
    """An ellipsoid fits as well turned by half a turn, which is not what these tests are about."""
    monkeypatch.setattr(bound, "alternatives_mm", lambda report, name: 0.0)


def test_other_places_that_are_as_likely_are_within_the_bound(estimate):
    cost = estimate.report.fit_cost
    (other,) = cost.others[:1]
    for chances, expected_mm in (((0.04,), 0.0), ((0.06,), 40.0), ((0.03, 0.03), 25.0)):
        others = [
            {"more": 1.0, "apart_mm": {"kidney": 9.0, "tumor_1": mm}, "share": chance}
            for chance, mm in zip(chances, (40.0, 25.0), strict=False)
        ]
        told = reporting(estimate, fit_cost={"others": others, **FIT})
        assert alternatives_mm(told.report, "tumor_1") == expected_mm
        bound_mm = bounds_of(told.report)["tumor_1"].error_bound95_mm
        assert bound_mm >= expected_mm
    assert other.turn_degrees > 150
    assert 0.05 < other.share < 0.6


FIT = {"now": 10.0, "without_strays": 10.0, "usual": 20.0, "strays": 0.0}


def visible():
    moved = placed(share=0.3).carry(ANATOMY.organ.vertices_mm)
    normals = moved - moved.mean(0)
    return SensorCloud(moved[(normals * moved).sum(1) < 0].astype(np.float32))


def test_the_page_says_of_which_method_the_shipped_model_is_unless_it_is_of_this_one():
    page = Path(__file__).parents[2] / "docs/trust.md"
    stated = f"learned with method {shipped().fingerprint}" in page.read_text("utf-8")
    assert stated == (shipped().fingerprint != fingerprint())


def of_radius(radius_mm):
    every = Quantile(math.log(radius_mm), {})
    return BoundModel(fingerprint(), every, every, {"touch": 1.0}, {})


@pytest.mark.parametrize("part", ["tumor_1", "kidney"])
def test_what_is_shipped_cannot_reward_what_gets_worse(estimate, part):
    model = shipped().organ if part == "kidney" else shipped().tumor
    known = figures(estimate.report, part)
    assert set(model.hinges) <= set(known)
    assert min(weight for hinges in model.hinges.values() for _, weight in hinges) >= 0
    before = model.bound_mm(known)
    assert before > 0
    for name in known:
        assert model.bound_mm({**known, name: known[name] + 0.5}) >= before


def test_a_figure_counts_from_its_knots_on():
    model = Quantile(math.log(2.0), {"cost": ((0.5, 1.0), (1.5, 2.0))})
    for cost, expected in ((0.0, 2.0), (1.0, 2 * math.exp(0.5)), (2.0, 2 * math.exp(1.5 + 1.0))):
        assert model.bound_mm({"cost": cost}) == pytest.approx(expected)


def test_an_answer_says_how_far_off_its_tumors_may_be(slim_model, one_place):
    estimate = Tracker(load_model(slim_model, "cpu")).locate(visible(), 16, 0)
    bounds, tumor = estimate.assessment.bounds, estimate.report.parts["tumor_1"]
    assert [*bounds] == ["kidney", "tumor_1"]
    assert bounds["tumor_1"].least_sure == tumor.center_axes[0]
    known = figures(estimate.report, "tumor_1")
    depth_mm = 1.96 * estimate.report.motion.depth_share * math.hypot(*tumor.center_mm)
    assert depth_mm > 1
    bound_mm = math.hypot(shipped().tumor.bound_mm(known), depth_mm)
    assert bounds["tumor_1"].error_bound95_mm == pytest.approx(bound_mm)
    nearest_mm = np.linalg.norm(visible().points_mm - tumor.center_mm, axis=1).min()
    assert tumor.nearest_mm == pytest.approx(nearest_mm, abs=1.0)  # of the points that are fitted
    assert known["nearest"] == pytest.approx(math.log(tumor.nearest_mm))


def test_a_miss_that_may_be_large_makes_an_answer_poor(slim_model, one_place, monkeypatch):
    tracker = Tracker(load_model(slim_model, "cpu"))
    cases = (POOR_MM - 0.1, 0.0, None), (POOR_MM + 0.1, 0.0, "miss"), (2.0, 10.0, "depths")
    for radius_mm, depth_mm, kind in cases:
        cloud = replace(visible(), depth_error=DepthError(depth_mm))
        model = of_radius(radius_mm)
        monkeypatch.setattr(bound, "shipped", lambda model=model: model)
        found = tracker.locate(cloud, 16, 0).finding
        assert (None if found is None else found.kind) == kind


def test_a_factor_multiplies_the_bound_and_so_decides(slim_model, one_place, monkeypatch):
    model = load_model(slim_model, "cpu")
    plain = of_radius(0.8 * POOR_MM)
    monkeypatch.setattr(bound, "shipped", lambda: plain)
    cloud = replace(visible(), depth_error=DepthError(0.0))
    for factor, kind in ((1.0, None), (1.24, None), (1.26, "miss")):
        found = Tracker(replace(model, bound_factor=factor)).locate(cloud, 16, 0)
        said = found.assessment
        assert said.factor == factor
        bound_mm = said.bounds["tumor_1"].error_bound95_mm
        assert bound_mm == pytest.approx(factor * 0.8 * POOR_MM)
        assert (None if said.finding is None else said.finding.kind) == kind
        assert bool(said.shown) == (kind is None)


def test_what_is_foreseen_of_a_touch_follows_those_before_it(slim_model, one_place, monkeypatch):
    by_std = Quantile(math.log(3.0), {"center_std": ((-20.0, 1.0),)})
    model = BoundModel(fingerprint(), by_std, by_std, {"touch": 1.0}, {})
    monkeypatch.setattr(bound, "shipped", lambda: model)
    tracker = Tracker(replace(load_model(slim_model, "cpu"), bound_factor=1.25))
    found = tracker.locate(replace(visible(), depth_error=DepthError(0.0)), 16, 0)
    *touches, outline, _ = every = advise(found, "tumor_1")
    assert [each.kind for each in every] == ["touch", "touch", "touch", "outline", "look"]
    now_mm = found.assessment.bounds["tumor_1"].error_bound95_mm
    assert touches[0].bound_mm == outline.bound_mm == pytest.approx(now_mm)
    for before, after in itertools.pairwise(touches):
        assert after.bound_mm == before.then_bound_mm < before.bound_mm
    for each in every:  # here the bound is as large as the standard deviation
        assert each.then_bound_mm / now_mm == pytest.approx(each.then_std_mm / outline.std_mm)


def test_advice_without_a_bound_claims_none(estimate):
    surfaces = replace(estimate_of(estimate.meshes), motion=estimate.motion)
    every = advise(surfaces, "tumor_1")
    assert {(each.bound_mm, each.then_bound_mm) for each in every} == {(None, None)}
    assert not any("95 %" in each.words for each in every)
    assert worthwhile(every) == ()


def test_an_organ_without_tumors_is_judged_by_its_own_bound(estimate):
    organ = reporting(estimate)
    alone = {"kidney": organ.report.parts["kidney"]}
    report = organ.reporting(parts=alone, evidence=(), size=None, fit_cost=None).report
    for bound_mm, kind in ((POOR_MM - 0.1, None), (POOR_MM + 0.1, "miss")):
        finding = verdict._doubt(report, {"kidney": ErrorBound(bound_mm)})
        assert (finding and finding.kind) == kind


def test_a_method_that_does_not_know_enough_has_none_and_keeps_the_older_checks(estimate):
    surfaces = estimate_of(estimate.meshes)
    assert bounds_of(surfaces.report) == {}
    std_mm = verdict._MAX_UNCERTAINTY_MM + 0.1
    unsure = reporting(surfaces, parts={"tumor_1": {"center_std_mm": std_mm}})
    assert verdict._doubt(unsure.report, {}).kind == "unsure"


def test_of_several_cameras_the_worst_counts_and_one_that_nobody_stated(slim_model):
    tracker, cloud = Tracker(load_model(slim_model, "cpu")), visible()
    shares = {}
    for first, second in ((0.0, 0.0), (0.0, 3.0), (3.0, 0.0), (0.0, None)):
        error = None if second is None else DepthError(second)
        look = Look(replace(cloud, depth_error=error), cloud, np.eye(4))
        mine = replace(cloud, depth_error=DepthError(first))
        found = tracker.locate(mine, 16, 0, evidence=[look])
        shares[first, second] = found.report.motion.depth_share
    assert shares[0.0, 0.0] == 0
    assert shares[0.0, 3.0] == pytest.approx(shares[3.0, 0.0])
    assert shares[0.0, 3.0] > 0.005
    assert shares[0.0, None] > 0.005
