"""How far off tumors may be: the shipped model and its laws."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from reports import NOWHERE, reporting
from tumortrack.assessment.advice import advise, worthwhile
from tumortrack.assessment.bound import (
    POOR_MM,
    Quantile,
    alternatives_mm,
    bound_mm,
    bounds_of,
    depths_within_mm,
    figures,
    shipped,
)
from tumortrack.assessment.sight import Sight
from tumortrack.assessment.verdict import finding_of
from tumortrack.core.assessment import ErrorBound
from tumortrack.core.types import DepthError, SensorCloud, View
from tumortrack.registration.frame import estimate_of
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, placed

FIT = {"now": 10.0, "without_outliers": 10.0, "usual": 20.0, "outliers": 0.0}


def visible():
    moved = placed(share=0.3).forward(ANATOMY.organ.vertices_mm)
    normals = moved - moved.mean(0)
    return SensorCloud(moved[(normals * moved).sum(1) < 0].astype(np.float32))


@pytest.fixture(scope="module")
def model(slim_model):
    return load_model(slim_model, "cpu")


@pytest.fixture(scope="module")
def estimate(model):
    return Tracker(model).locate(visible(), grid=16)


@pytest.fixture(scope="module")
def one_place(estimate):
    """An ellipsoid fits as well turned by half a turn, which is not what these tests are about."""
    return reporting(estimate, fit_cost=FIT)


def test_other_places_that_are_as_likely_are_within_the_bound(estimate):
    (other,) = estimate.report.fit_cost.others[:1]
    assert other.turn_degrees > 150
    assert 0.05 < other.share < 0.6
    for chances, expected_mm in (((0.04,), 0.0), ((0.06,), 40.0), ((0.03, 0.03), 25.0)):
        others = [
            {"more": 1.0, "distance_mm": {"kidney": 9.0, "tumor_1": mm}, "share": chance}
            for chance, mm in zip(chances, (40.0, 25.0), strict=False)
        ]
        told = reporting(estimate, fit_cost={"others": others, **FIT}).report
        assert alternatives_mm(told, "tumor_1") == expected_mm
        assert bounds_of(told)["tumor_1"].error_bound95_mm >= expected_mm


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


def test_an_answer_says_how_far_off_its_tumors_may_be(one_place):
    bounds, tumor = bounds_of(one_place.report, 1.25), one_place.report.parts["tumor_1"]
    assert [*bounds] == ["kidney", "tumor_1"]
    assert bounds["tumor_1"].least_sure == tumor.center_axes[0]
    known = figures(one_place.report, "tumor_1")
    depth_mm = 1.96 * one_place.report.motion.depth_share * math.hypot(*tumor.center_mm)
    assert depths_within_mm(one_place.report, "tumor_1") == pytest.approx(depth_mm)
    assert depth_mm > 1
    whole_mm = math.hypot(shipped().tumor.bound_mm(known), depth_mm)
    assert bounds["tumor_1"].error_bound95_mm == pytest.approx(1.25 * whole_mm)
    nearest_mm = np.linalg.norm(visible().points_mm - tumor.center_mm, axis=1).min()
    assert tumor.nearest_mm == pytest.approx(nearest_mm, abs=1.0)  # of the points that are fitted
    assert known["nearest"] == pytest.approx(math.log(tumor.nearest_mm))


@pytest.mark.parametrize(("depth_share", "kind"), [(0.0, "miss"), (0.5, "depths")])
def test_a_bound_that_is_mostly_of_depths_says_so(one_place, depth_share, kind):
    motion = {**NOWHERE, "depth_share": depth_share * POOR_MM / 100}
    report = reporting(one_place, motion=motion, size=None, evidence=()).report
    finding = finding_of(report, {"tumor_1": ErrorBound(POOR_MM + 0.1)}, Sight())
    assert finding.kind == kind


def test_a_models_factor_multiplies_the_bounds_of_its_answers(model, estimate):
    found = Tracker(replace(model, bound_factor=1.25)).locate(visible(), grid=16)
    assert found.assessment.factor == 1.25
    for name, plain in estimate.assessment.bounds.items():
        times = found.assessment.bounds[name].error_bound95_mm / plain.error_bound95_mm
        assert times == pytest.approx(1.25)
    assert bool(found.assessment.shown) == (found.quality == "good")


def test_what_is_foreseen_of_a_touch_follows_those_before_it(one_place):
    found = one_place.assessed(bounds=bounds_of(one_place.report, 1.25), factor=1.25)
    *touches, outline, _ = every = advise(found, "tumor_1")
    assert [each.kind for each in every] == ["touch", "touch", "touch", "outline", "view"]
    now_mm = found.assessment.bounds["tumor_1"].error_bound95_mm
    assert touches[0].bound_mm == outline.bound_mm == pytest.approx(now_mm)
    for before, after in itertools.pairwise(touches):
        assert after.bound_mm == before.then_bound_mm < before.bound_mm
    for each in every:
        foreseen_mm = bound_mm(one_place.report, "tumor_1", each.then_std_mm / outline.std_mm)
        assert each.then_bound_mm == pytest.approx(1.25 * foreseen_mm)
    pays = {each.kind for each in worthwhile(every)}
    assert pays <= {kind for kind, found in shipped().advice.items() if 0.7 <= found <= 1.3}


def test_a_method_that_does_not_know_enough_has_no_bound_and_claims_none(estimate):
    surfaces = replace(estimate_of(estimate.meshes), motion=estimate.motion)
    assert bounds_of(surfaces.report) == {}
    every = advise(surfaces, "tumor_1")
    assert {(each.bound_mm, each.then_bound_mm) for each in every} == {(None, None)}
    assert worthwhile(every) == ()


def test_of_several_cameras_the_worst_counts_and_one_that_nobody_stated(model):
    tracker, cloud = Tracker(model), visible()
    shares = {}
    for first, second in ((0.0, 0.0), (0.0, 3.0), (3.0, 0.0), (0.0, None)):
        error = None if second is None else DepthError(second)
        view = View(replace(cloud, depth_error=error), cloud, np.eye(4))
        mine = replace(cloud, depth_error=DepthError(first))
        found = tracker.locate(mine, views=[view], grid=16)
        shares[first, second] = found.report.motion.depth_share
    assert shares[0.0, 0.0] == 0
    assert shares[0.0, 3.0] == pytest.approx(shares[3.0, 0.0])
    assert shares[0.0, 3.0] > 0.005
    assert shares[0.0, None] > 0.005
