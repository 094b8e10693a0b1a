"""The error budget: how errors add up, what a margin keeps, and what the numbers are made of."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import strategies as st

from cut_objects import swept, to_axes
from live_objects import small_estimate, small_update
from plan_objects import RADIUS_MM, TUMOR_MM, located, sphere
from refused import refused
from reports import bounded, reporting
from tumortrack.core.assessment import ErrorBound
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.values import TrackingResult
from tumortrack_resection.budget import (
    HAND_EYE_MM,
    TERMS,
    TOOL_MM,
    UNKNOWN_TRACKING_MM,
    ErrorBudget,
    LiveBudget,
    checked_against,
    foreseen_mm,
    planned_budgets,
    tightest,
)
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.facets import Tools
from tumortrack_resection.halt import Halt
from tumortrack_resection.ur_sink import OFF_MM
from tumortrack_resection.values import (
    ELECTRODE,
    OVER_BUDGET,
    UNCHECKED,
    Clearance,
    Located,
    ResectionConfig,
    ResectionPlan,
)

NAMES = [f"{name.replace('-', '_')}_mm" for name in TERMS]
BESIDE_MM = np.array([-24.0, -18.0, 158.0])  # a second tumor
millimetres = st.floats(0, 50)


def budget(margin_mm=5.0, part="tumor_1", **terms) -> ErrorBudget:
    return ErrorBudget(margin_mm=margin_mm, part=part, **terms)


@cache
def seen() -> Located:
    return located(n=12_000)


@cache
def planned(method="margin") -> ResectionPlan:
    return plan_resection(seen(), ResectionConfig(method=method))


@cache
def two() -> Located:
    return located(sphere(TUMOR_MM, RADIUS_MM), sphere(BESIDE_MM, 7.0), n=20_000)


def kept(least_mm: float, part="tumor_1", solid=ELECTRODE) -> Clearance:
    """What a check of motions found."""
    return Clearance(solid, part, least_mm, least_mm, "sweep 1", 1.0, (0.0, 0.0, 0.0))


def test_what_always_points_the_same_way_is_added_and_what_is_independent_in_quadrature():
    assert budget(motion_mm=3, lag_mm=4).sum_mm == 7
    assert budget(tracking_mm=2, hand_eye_mm=3, tool_mm=6).sum_mm == 7
    assert budget(tracking_mm=3, hand_eye_mm=4, motion_mm=2).sum_mm == 7


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
@pytest.mark.parametrize("name", NAMES)
def test_an_error_that_is_none_is_refused(name, bad):
    with refused(InputError, bad):
        budget(**{name: bad})
    with refused(InputError, math.nan):
        budget(math.nan)


def test_every_tumor_has_to_be_covered_and_the_tightest_is_told():
    roomy, narrow = budget(9.0, tracking_mm=5.0), budget(5.0, "tumor_2", tracking_mm=4.0)
    over = budget(2.0, "tumor_3", tracking_mm=4.0)
    assert tightest([roomy, narrow, over]) is over
    assert tightest([roomy, narrow]) is narrow
    fits = checked_against(planned(), [roomy, narrow], accept=False)
    assert "tumor_2" in fits.notes[-1]
    assert "1.0 mm are left" in fits.notes[-1]
    for order in ([roomy, over], [over, roomy]):
        with refused(NoPlan, "tumor_3"):
            checked_against(planned(), order, accept=False)
    worse = budget(-1.0, "tumor_4", tracking_mm=4.0)
    accepted = checked_against(planned(), [roomy, over, worse], accept=True)
    said = [note for note in accepted.warnings if note.startswith(OVER_BUDGET)]
    assert [name in "".join(said) for name in ("tumor_1", "tumor_3", "tumor_4")] == [
        False,
        True,
        True,
    ]


@pytest.mark.parametrize("left_mm", [-1e-9, 0.0, 1e-9])
def test_what_is_just_covered_is(left_mm):
    just = budget(5.0 + left_mm, tracking_mm=5.0)
    if left_mm < 0:
        with pytest.raises(NoPlan):
            checked_against(planned(), [just], accept=False)
    else:
        (unchecked,) = checked_against(planned(), [just], accept=False).warnings
        assert unchecked.startswith(UNCHECKED)


def test_the_electrode_s_whole_length_counts():
    """A second tumor lies far behind the tip, on the way of the electrode."""
    cut = planned().cuts[0]
    one, reach_mm = replace(planned(), cuts=(cut,)), Tools().electrode_mm
    tip = cut.path_mm[len(cut.path_mm) // 2]
    aside = np.cross(cut.axis, cut.path_mm[-1] - cut.path_mm[0])
    aside /= np.linalg.norm(aside)
    for back_mm, off_mm in ((60.0, 9.0), (60.0, 0.0), (90.0, 0.0)):
        middle = tip - back_mm * cut.axis + off_mm * aside
        there = replace(seen(), meshes={**seen().meshes, "tumor_2": sphere(middle, 5.0)})
        found = foreseen_mm(one, there, Tools())["tumor_2"]
        off = to_axes(middle[None], swept(cut))[0]
        assert found == pytest.approx(-5.0 if off < 1 else off - 5 - Tools().radius_mm, abs=0.4)
        assert (found < 0) == (back_mm < reach_mm and off_mm == 0)
        short = foreseen_mm(one, there, Tools(electrode_mm=30.0))["tumor_2"]
        assert short > found + 3


def test_what_was_found_of_the_motions_counts_instead_of_what_was_foreseen():
    found = (kept(3.3), kept(1.1, "tumor_2"), kept(-4.0, solid="pencil"), kept(0.2, "artery"))
    plan = replace(planned(), clearances=found)
    budgets = planned_budgets(plan, two())
    assert [(each.part, each.margin_mm) for each in budgets] == [("tumor_1", 3.3), ("tumor_2", 1.1)]


def test_there_is_a_budget_for_every_tumor_the_planned_one_s_first():
    plan = plan_resection(two(), ResectionConfig(tumor="tumor_2"))
    first, other = planned_budgets(plan, two(), 0.7, 0.4, moved_mm=1.0)
    assert (first.part, other.part) == ("tumor_2", "tumor_1")
    least = foreseen_mm(plan, two(), Tools())
    assert (first.margin_mm, other.margin_mm) == (least["tumor_2"], least["tumor_1"])
    assert (other.hand_eye_mm, other.tool_mm, other.motion_mm) == (0.7, 0.4 + OFF_MM, 1.0)
    first, other = planned_budgets(plan, replace(two(), bounds_mm={"tumor_1": 6.5, "tumor_2": 0.3}))
    assert (first.tracking_mm, other.tracking_mm) == (0.3, 6.5)
    assert not {"tracking"} & {*first.assumed, *other.assumed}
    first, other = planned_budgets(plan, replace(two(), bounds_mm={"tumor_2": 0.3}))
    assert (first.tracking_mm, other.tracking_mm) == (0.3, UNKNOWN_TRACKING_MM)
    assert ("tracking" in first.assumed, "tracking" in other.assumed) == (False, True)


def test_what_nobody_states_is_assumed_and_named():
    (bare,) = planned_budgets(planned(), seen())
    assert set(bare.assumed) == {"tracking", "hand-eye", "tool"}
    assert bare.tracking_mm == UNKNOWN_TRACKING_MM
    assert bare.hand_eye_mm == HAND_EYE_MM
    assert bare.tool_mm == TOOL_MM + OFF_MM
    bound = replace(seen(), bounds_mm={"tumor_1": 4.53})
    (known,) = planned_budgets(planned(), bound, 0.7, 0.4, moved_mm=1.0)
    assert known.assumed == ()
    assert [*known.terms.values()] == pytest.approx([4.53, 0.7, 0.4 + OFF_MM, 1.0, 0.0])
    rows = [line.split() for line in planned_budgets(planned(), bound)[0].table()]
    assert ["hand-eye", "2.0", "assumed"] in rows
    assert [row[0] for row in rows[1:]] == [*TERMS, "together"]
    assert rows[1] == ["tracking", "4.5", *ErrorBound(4.53).message.split()]
    assert ["tracking", "8.0", "assumed"] in [line.split() for line in bare.table()]
    (poor,) = planned_budgets(planned(), replace(bound, doubt="it is seen through"))
    assert (poor.tracking_mm, "tracking" in poor.assumed) == (4.53, True)


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
        with refused(InputError, "error_"):
            stated(**error)


def update(number, latency_ms=100.0, smoothing_ms=0.0, **bounds_mm):
    estimate = bounded(small_estimate(), **{"tumor_1": 4.2, "tumor_2": 4.2, **bounds_mm})
    estimate = reporting(estimate, smoothing={"lag_ms": smoothing_ms})
    stamp_ns = small_update().stamp_ns + number * 33_000_000
    return replace(small_update(), stamp_ns=stamp_ns, estimate=estimate, latency_ms=latency_ms)


class Live:
    """A live budget of tumors that the test moves."""

    def __init__(self, *planned: ErrorBudget, servo_s: float = 0.0) -> None:
        self.budget = LiveBudget(planned, servo_s)

    def add_up(
        self, update: TrackingResult, motion_mm: float = 0.5, margin_mm: float = 15.0,
        off_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), others: Mapping[str, float] = {},
    ) -> tuple[Halt | None, bool]:  # fmt: skip
        """``others``: how far they have moved."""
        tumor = sphere(np.array(TUMOR_MM) + off_mm, RADIUS_MM)
        tumors = {"tumor_1": (tumor, motion_mm)}
        tumors |= {name: (tumor, moved) for name, moved in others.items()}
        least_mm = dict.fromkeys(tumors, margin_mm)
        return self.budget.add_up(update, "tumor_1", tumors, least_mm)

    @property
    def now(self) -> ErrorBudget:
        assert self.budget.now is not None
        return self.budget.now


def test_lag_is_the_tumors_speed_times_all_that_comes_late():
    live = Live(budget(20.0, hand_eye_mm=1), servo_s=0.1)
    for frame in range(20):  # 9 mm/s
        live.add_up(update(frame, 80.0, 120.0), off_mm=(0.297 * frame, 0.0, 0.0))
        if not frame:
            assert live.now.lag_mm == 0  # nothing is known of a speed
    assert live.now.lag_mm == pytest.approx(9 * (0.08 + 0.12 + 0.1))
    assert (live.now.motion_mm, live.now.margin_mm, live.now.hand_eye_mm) == (0.5, 15.0, 1.0)
    # After a gap, and where the clock was set back, the last place says nothing.
    live.add_up(update(60))
    assert live.now.lag_mm == 0
    live.add_up(update(3), off_mm=(5.0, 0.0, 0.0))
    assert live.now.lag_mm == 0


def test_a_camera_whose_clock_is_ahead_takes_nothing_off_the_lag():
    live = Live(budget(20.0))
    for frame in range(10):  # 9 mm/s, stamped 50 ms too late: more than the loop takes
        live.add_up(update(frame, -50.0, 120.0), off_mm=(0.297 * frame, 0.0, 0.0))
    assert live.now.lag_mm == pytest.approx(9 * 0.12)


def test_a_new_plan_helps_where_the_motion_alone_is_too_much():
    live = Live(budget(9.0))
    assert live.add_up(update(0), 1.0, 5.6) == (None, False)
    said, helps = live.add_up(update(1), 1.9, 5.6)
    values = {"sum_mm": pytest.approx(6.1), "margin_mm": 5.6, "part": "tumor_1", "term": "tracking"}
    assert said.values.items() >= values.items()
    assert helps
    _, helps = live.add_up(update(2, tumor_1=6.0), 1.9, 5.6)
    assert not helps
    # Accepted by a person when it was planned: added up, and nothing follows.
    accepted = Live(budget(1.0, motion_mm=2))
    assert accepted.add_up(update(0), 1.9, 1.0) == (None, False)
    assert accepted.now.left_mm < 0
    assert f"{-accepted.now.left_mm:.1f} mm" in accepted.now.left_words


def test_live_every_tumor_counts():
    live = Live(budget(9.0), budget(9.0, "tumor_2"))
    assert live.add_up(update(0), 0.5, 5.6, others={"tumor_2": 1.0}) == (None, False)
    assert live.now.part == "tumor_2"  # the tightest
    said, helps = live.add_up(update(1), 0.5, 5.6, others={"tumor_2": 1.9})
    assert (said.values["part"], helps) == ("tumor_2", True)
    # Of a tumor that was never budgeted nothing is known; one that a person accepted never halts.
    assert Live(budget(9.0)).add_up(update(0), 0.5, 5.6, others={"tumor_2": 9.0})[0] is None
    accepted = Live(budget(9.0), budget(1.0, "tumor_2", motion_mm=2))
    assert accepted.add_up(update(0), 0.5, 5.6, others={"tumor_2": 9.0}) == (None, False)
    assert accepted.now.part == "tumor_2"
    assert (
        accepted.add_up(update(1), 1.9, 5.6, others={"tumor_2": 9.0})[0].values["part"] == "tumor_1"
    )


def test_the_worst_is_of_what_the_arms_moved_on():
    live = Live(budget(9.0))
    live.add_up(update(0), 0.5, 9.0)
    live.budget.went_on()
    went_on = live.now
    live.add_up(update(1), 8.0, 9.0)  # they halt
    assert live.budget.worst is went_on
    live.budget.forget()
    assert live.budget.now is None
    live.budget.went_on()
    assert live.budget.worst is went_on
    summary = live.budget.summary()
    assert summary["worst"]["left_mm"] == went_on.left_mm
    assert (summary["planned"]["margin_mm"], summary["planned"]["part"]) == (9.0, "tumor_1")


@pytest.mark.parametrize("margin_mm", [20.0, 1.0], ids=["covered", "accepted"])
def test_live_a_bound_that_is_lost_halts(margin_mm):
    """Whatever a person accepted: less is known than when it was planned."""
    live = Live(budget(20.0), budget(margin_mm, "tumor_2", motion_mm=2))
    known = update(0)
    unknown = replace(known, estimate=bounded(known.estimate, tumor_1=4.2))
    assert live.add_up(known, 0.0, 20.0, others={"tumor_2": 0.0}) == (None, False)
    why, helps = live.add_up(unknown, 0.0, 20.0, others={"tumor_2": 0.0})
    assert (why.kind, why.values, helps) == ("no_bound", {"part": "tumor_2"}, False)
    assert (live.now.part, live.now.tracking_mm) == ("tumor_2", UNKNOWN_TRACKING_MM)
    # A plan that never had one goes on with what it assumed.
    live = Live(budget(20.0, tracking_mm=8.0, assumed=("tracking",)))
    assert live.add_up(replace(known, estimate=bounded(known.estimate)), 0.0, 20.0)[0] is None
    assert live.now.tracking_mm == UNKNOWN_TRACKING_MM
