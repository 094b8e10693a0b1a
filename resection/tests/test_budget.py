"""The error budget: how errors add up, what a margin keeps, and what the numbers are made of."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace as with_terms

from live_objects import small_estimate, small_update
from plan_objects import RADIUS_MM, TUMOR_MM, Deviating, located, sphere
from reports import reporting
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.report import MarginReport, StatedMargin
from tumortrack.live.calibration_file import read_frames
from tumortrack_resection.budget import (
    HAND_EYE_MM,
    LEAST_TRACKING_MM,
    TERMS,
    TOOL_MM,
    UNKNOWN_TRACKING_MM,
    ErrorBudget,
    checked_against,
    kept_mm,
    kept_words,
    plan_within,
    planned_budget,
    widened,
)
from tumortrack_resection.live_budget import LiveBudget
from tumortrack_resection.located import of_estimate
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.ur_sink import OFF_MM
from tumortrack_resection.values import OVER_BUDGET, CutLayer, ResectionConfig

NAMES = [f"{name.replace('-', '_')}_mm" for name in TERMS]
millimetres = st.floats(0, 50)


def budget(margin_mm=5.0, **terms):
    return ErrorBudget(margin_mm=margin_mm, **terms)


@given(st.tuples(*[millimetres] * 5), st.sampled_from(NAMES), st.floats(0.01, 20))
def test_the_sum_grows_with_every_term_and_lies_between_the_largest_and_the_plain_sum(
    values, name, more
):
    terms = dict(zip(NAMES, values, strict=True))
    found = budget(**terms)
    assert max(values) - 1e-9 <= found.sum_mm <= sum(values) + 1e-9
    assert budget(**{**terms, name: terms[name] + more}).sum_mm > found.sum_mm
    assert found.left_mm == pytest.approx(5 - found.sum_mm)


def test_what_always_points_the_same_way_is_added_and_what_is_independent_in_quadrature():
    assert budget(motion_mm=3, lag_mm=4).sum_mm == 7
    assert budget(tracking_mm=2, hand_eye_mm=3, tool_mm=6).sum_mm == 7
    assert budget(tracking_mm=3, hand_eye_mm=4, motion_mm=2).sum_mm == 7


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_an_error_that_is_none_is_refused(name, bad):
    with pytest.raises(InputError, match="allowed: 0 or more"):
        budget(**{name: bad})
    with pytest.raises(InputError, match="margin"):
        budget(math.nan)


def test_two_millimetres_of_motion_and_3_6_of_tracking_do_not_go_into_a_margin_of_5():
    plan = plan_resection(located(), ResectionConfig())
    over = budget(tracking_mm=3.6, motion_mm=2)
    with pytest.raises(NoPlan, match=r"5\.6 mm of error, most of it tracking \(3\.6\).* 5\.0 mm"):
        checked_against(plan, over, accept=False)
    accepted = checked_against(plan, over, accept=True)
    assert accepted.notes[-1].startswith(f"{OVER_BUDGET}: 5.6 mm of error")
    fits = checked_against(plan, with_terms(over, margin_mm=6.0), accept=False)
    assert fits.notes[-1] == "0.4 mm of the margin are left after 5.6 mm of error."


@pytest.mark.parametrize("margin_mm", [2.0, 5.0, 8.0])
def test_a_plan_keeps_its_margin_and_no_more(margin_mm):
    plan = plan_resection(located(), ResectionConfig(margin_mm=margin_mm, most_healthy=1.0))
    fine = sphere(TUMOR_MM, RADIUS_MM, finer=5).vertices_mm
    assert kept_mm(plan.layers, fine) == pytest.approx(margin_mm, abs=0.3)
    # Moved towards any side it keeps as much less; a wider margin above holds no cut.
    for side in np.eye(3)[:2]:
        moved = kept_mm(plan.layers, fine + 1.5 * side)
        assert moved == pytest.approx(margin_mm - 1.5, abs=0.4)
    assert kept_mm(plan.layers, fine - [0, 0, 1.5]) == pytest.approx(margin_mm - 1.5, abs=0.3)
    assert kept_mm(plan.layers, fine - [0, 0, margin_mm + 2]) == pytest.approx(-2, abs=0.3)


def test_of_a_box_of_two_slabs_distances_are_known():
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    layers = (
        CutLayer(10.0, np.inf, (20 * square,)),
        CutLayer(0.0, 10.0, (8 * square,)),  # a ledge at 10, from 8 out to 20
    )
    kept = lambda *point: kept_mm(layers, np.array([point], float))  # noqa: E731
    assert kept(0, 0, 5) == pytest.approx(5)  # over the floor
    assert kept(6, 0, 5) == pytest.approx(2)  # beside the wall
    assert kept(14, 0, 13) == pytest.approx(3)  # over the ledge
    assert kept(5, 0, 14) == pytest.approx(5, abs=0.01)  # the ledge's inner edge: 3 off, 4 below
    assert kept(0, 0, 500) == pytest.approx(20, abs=0.01)  # open at the top
    assert kept(11, 0, 5) == pytest.approx(-3, abs=0.01)  # outside
    assert kept(0, 0, -4) == pytest.approx(-4)
    both = np.array([[0, 0, 5], [11, 0, 5.0]])
    assert kept_mm(layers, both) == pytest.approx(-3, abs=0.01)  # the worst


def test_the_papers_method_keeps_nothing_below_the_tumor():
    plan = plan_resection(located(), ResectionConfig(method="published"))
    assert planned_budget(plan, located(std_mm=0.5)).margin_mm < 0.5


def test_what_nobody_states_is_assumed_and_named():
    plan = plan_resection(located(), ResectionConfig())
    bare = planned_budget(plan, located())
    assert set(bare.assumed) == {"tracking", "hand-eye", "tool"}
    assert bare.tracking_mm == UNKNOWN_TRACKING_MM
    assert bare.hand_eye_mm == HAND_EYE_MM
    assert bare.tool_mm == TOOL_MM + OFF_MM
    known = planned_budget(plan, located(std_mm=2.0), 0.7, 0.4, moved_mm=1.0)
    assert known.assumed == ()
    assert [*known.terms.values()] == pytest.approx([6.0, 0.7, 0.4 + OFF_MM, 1.0, 0.0])
    sure = planned_budget(plan, located(std_mm=0.1))
    assert sure.tracking_mm == LEAST_TRACKING_MM  # none is as good as it says
    assert "  hand-eye   2.0  assumed" in sure.table()


def test_a_calibration_states_its_error_at_the_tumor(tmp_path):
    path = tmp_path / "frame.json"
    rows = np.eye(4).tolist()

    def stated(**error):
        frame = {"frame_id": "base", "unit": "m", "robot_from_camera": rows, **error}
        path.write_text(json.dumps(frame))
        return read_frames(path).error_at(200.0)

    assert stated() is None
    assert stated(error_mm=1.2) == 1.2
    assert stated(error_mm=1.0, error_deg=0.5) == pytest.approx(1 + 200 * math.radians(0.5))
    for error in ({"error_mm": 0}, {"error_mm": -1}, {"error_deg": 0.5},
                  {"error_mm": 1, "error_deg": 20}):  # fmt: skip
        with pytest.raises(InputError, match="error_"):
            stated(**error)


def update(number, latency_ms=100.0, smoothing_ms=0.0, std_mm=0.5):
    estimate = replace(small_estimate(), motion=Deviating(std_mm))
    estimate = reporting(estimate, smoothing={"lag_ms": smoothing_ms})
    stamp_ns = small_update().stamp_ns + number * 33_000_000
    return replace(small_update(), stamp_ns=stamp_ns, estimate=estimate, latency_ms=latency_ms)


def test_lag_is_the_tumors_speed_times_all_that_comes_late():
    live = LiveBudget(budget(20.0, hand_eye_mm=1), servo_s=0.1)
    tumor = sphere(TUMOR_MM, RADIUS_MM)
    for frame in range(20):  # 9 mm/s
        moved = tumor.moved(tumor.vertices_mm + [0.297 * frame, 0, 0])
        live.add_up(update(frame, 80.0, 120.0), "tumor_1", moved, 0.5, 15.0)
        if not frame:
            assert live.now.lag_mm == 0  # nothing is known of a speed
    assert live.now.lag_mm == pytest.approx(9 * (0.08 + 0.12 + 0.1))
    assert (live.now.motion_mm, live.now.margin_mm, live.now.hand_eye_mm) == (0.5, 15.0, 1.0)
    # After a gap, and where the clock was set back, the last place says nothing.
    live.add_up(update(60), "tumor_1", tumor, 0.5, 15.0)
    assert live.now.lag_mm == 0
    live.add_up(update(3), "tumor_1", moved, 0.5, 15.0)
    assert live.now.lag_mm == 0


def test_a_tumor_is_as_unsure_as_along_its_least_sure_axis():
    live, tumor = LiveBudget(budget(20.0)), sphere(TUMOR_MM, RADIUS_MM)
    live.add_up(update(0, std_mm=2.0), "tumor_1", tumor, 0.0, 15.0)  # over all axes 1.2
    assert live.now.tracking_mm == 6.0
    estimate = update(0, std_mm=2.0).estimate
    seen = of_estimate(estimate)
    assert {*seen.std_mm} == {"tumor_1", "tumor_2"}
    assert (seen.std_mm["tumor_1"] == 2.0).all()


def test_a_camera_whose_clock_is_ahead_takes_nothing_off_the_lag():
    live, tumor = LiveBudget(budget(20.0)), sphere(TUMOR_MM, RADIUS_MM)
    for frame in range(10):  # 9 mm/s, stamped 50 ms too late: more than the loop takes
        moved = tumor.moved(tumor.vertices_mm + [0.297 * frame, 0, 0])
        live.add_up(update(frame, -50.0, 120.0), "tumor_1", moved, 0.5, 15.0)
    assert live.now.lag_mm == pytest.approx(9 * 0.12)


def test_a_new_plan_helps_where_the_motion_alone_is_too_much():
    live, tumor = LiveBudget(budget(9.0)), sphere(TUMOR_MM, RADIUS_MM)
    assert live.add_up(update(0), "tumor_1", tumor, 1.0, 5.6) == (None, False)
    said, helps = live.add_up(update(1), "tumor_1", tumor, 1.9, 5.6)
    assert said.words == "6.1 mm of error, most of it tracking (4.2), against a margin of 5.6 mm"
    assert helps
    _, helps = live.add_up(update(2, std_mm=2.0), "tumor_1", tumor, 1.9, 5.6)
    assert not helps
    # Accepted by a person when it was planned: added up, and nothing follows.
    accepted = LiveBudget(budget(1.0, motion_mm=2))
    assert accepted.add_up(update(0), "tumor_1", tumor, 1.9, 1.0) == (None, False)
    assert accepted.now.left_mm < 0


def stating(**mm):
    """Located, by an estimate that states these margins with 90 and 95 %."""
    less = {name: radius_mm - 1 for name, radius_mm in mm.items()}
    said = (StatedMargin(confidence=0.9, mm=less), StatedMargin(confidence=0.95, mm=mm))
    return replace(located(std_mm=0.2), margin=MarginReport(stated=said))


def test_a_calibrated_margin_is_the_tracking_term():
    plan, seen = plan_resection(located(), ResectionConfig()), stating(tumor_1=4.5)
    highest = planned_budget(plan, seen)
    assert (highest.tracking_mm, highest.confidence) == (4.5, 0.95)
    assert "  tracking   4.5  95 % margin" in highest.table()
    chosen = planned_budget(plan, seen, confidence=0.9)
    assert (chosen.tracking_mm, chosen.confidence) == (3.5, 0.9)
    without = planned_budget(plan, located(std_mm=0.2))
    assert (without.tracking_mm, without.confidence) == (LEAST_TRACKING_MM, 0)
    assert f"  tracking {LEAST_TRACKING_MM:5.1f}  not calibrated" in without.table()
    for none in (located(std_mm=0.2), stating(tumor_2=3.0)):
        with pytest.raises(InputError, match="states no 95 % margin of tumor_1"):
            planned_budget(plan, none, confidence=0.95)


def test_healthy_tissue_is_kept_beyond_all_errors():
    seen, config = stating(tumor_1=2.0), ResectionConfig(margin_mm=3.0, most_healthy=1.0)
    budget_of = partial(
        planned_budget,
        located=seen,
        hand_eye_mm=0.5,
        tool_error_mm=0.0,
        moved_mm=1.0,
        confidence=0.95,
    )
    as_asked, same, first = plan_within(seen, config, budget_of)
    assert (as_asked.margin_mm, same) == (3.0, config)
    plan, wide, budget = plan_within(seen, config, budget_of, beyond_errors=True)
    assert wide.margin_mm == pytest.approx(3 + 1 + math.hypot(2.0, 0.5, OFF_MM))
    assert plan.margin_mm == wide.margin_mm
    assert budget.left_mm == pytest.approx(3.0, abs=0.3)
    assert "3 mm of healthy tissue" in plan.notes[0]
    assert "within 2.0 mm of its estimate in 95 of 100" in plan.notes[0]
    with pytest.raises(NoPlan, match=r"allowed are 20"):
        widened(ResectionConfig(margin_mm=18.0), first)
    for twice in (ResectionConfig(method="published"), ResectionConfig(sigmas=1.0)):
        with pytest.raises(InputError, match="needs the method margin"):
            widened(twice, first)


def test_live_the_margin_of_the_moment_counts():
    live = LiveBudget(budget(20.0, confidence=0.9))
    of = update(0, std_mm=0.1)
    said = stating(tumor_1=6.0).margin
    of = replace(of, estimate=of.estimate.reporting(margin=said))
    assert live.add_up(of, "tumor_1", sphere(TUMOR_MM, RADIUS_MM), 0.0, 20.0) == (None, False)
    assert (live.now.tracking_mm, live.now.confidence) == (5.0, 0.9)
    of = replace(of, estimate=of.estimate.reporting(margin=MarginReport(reason="poor")))
    why, _ = live.add_up(of, "tumor_1", sphere(TUMOR_MM, RADIUS_MM), 0.0, 20.0)
    assert why.words == "the estimate states no 90 % margin, with which it was planned"
    assert (live.now.tracking_mm, live.now.confidence) == (LEAST_TRACKING_MM, 0)


def test_the_margin_in_words_is_the_one_that_the_budget_counts():
    seen = located()
    plan = plan_resection(seen, ResectionConfig(margin_mm=5.0))
    kept = planned_budget(plan, seen).margin_mm
    words = kept_words(plan, seen)
    assert words.startswith(f"margin {kept:.1f} mm")
    assert ("(5 mm asked for)" in words) == (f"{kept:.1f}" != "5.0")
    into = plan_resection(seen, ResectionConfig(method="published", margin_mm=1.0))
    narrow = replace(
        into, layers=tuple(CutLayer(x.bottom_mm + 4, x.top_mm, x.rings_mm) for x in into.layers)
    )
    deep = planned_budget(narrow, seen).margin_mm
    assert deep < -3
    asked = "(1 mm asked for)"
    assert kept_words(narrow, seen) == f"the cut goes {-deep:.1f} mm into the tumor {asked}"
