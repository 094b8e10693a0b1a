"""Arms in time: halts and aborts from every state, and what estimates make them do."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock import PATIENCE_S
from live_objects import small_update
from plan_objects import RADIUS_MM, TUMOR_MM, located, sphere
from refused import refused
from reports import bounded
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.geometry import rigid, transform_points, turned_by
from tumortrack.core.types import Mesh
from tumortrack_resection.budget import ErrorBudget, LiveBudget
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.halt import Halt
from tumortrack_resection.motions import JOINTS, Execution, Motions, MotionStage, Stage
from tumortrack_resection.operation import (
    Following,
    Operation,
    OperationConfig,
    Planned,
    ResectionProgress,
)
from tumortrack_resection.values import (
    ELECTRODE,
    NO_ROOM,
    OVER_BUDGET,
    Clearance,
    ResectionConfig,
)

STATES = ("approach", "grasp", "hold", "sweep 1", "sweep 2", "lift", "release", "home")
FRAME_S = 1 / 30
GOOD = replace(small_update(), quality="good")
FAR_MM = (-25.0, 22.0, 160.0)  # of the second tumor
LOCATED = located(sphere(TUMOR_MM, RADIUS_MM), sphere(FAR_MM, 8.0), n=8_000)
PLAN = plan_resection(LOCATED, ResectionConfig(method="published", tumor="tumor_1"))


def motions(states=STATES, first=None):
    """Each stage turns every joint by 0.2 rad in a second, ``hold`` and ``release`` stand."""
    here = np.zeros(len(JOINTS)) if first is None else first
    stages = []
    for number, name in enumerate(states):
        turn = 0.0 if name in ("hold", "release") else 0.2 * (-1) ** number
        times = np.linspace(0, 1, 11)
        way = here + turn * np.sin(np.pi / 2 * times)[:, None] * np.linspace(0.3, 1, len(JOINTS))
        stages.append(MotionStage(name, times, way, np.full(11, name.startswith("sweep"))))
        here = way[-1]
    return Motions(tuple(stages))


def run_until(execution, state):
    while execution.state != state:
        execution.step(0.01)
        assert execution.state != Stage.DONE or state == Stage.DONE


@pytest.mark.parametrize("state", STATES)
def test_an_abort_stops_the_arms_smoothly_from_every_state_and_for_good(state):
    execution = Execution(motions())
    run_until(execution, state)
    execution.step(0.3)
    joints = [execution.joints_rad]
    execution.abort(Halt("stopped", {"message": "the surgeon said so"}))
    assert execution.state == Stage.ABORTED
    for _ in range(200):
        execution.step(0.005)
        joints.append(execution.joints_rad)
    joints = np.array(joints)
    assert execution.ended
    assert execution.halted.kind == "stopped"
    assert np.abs(joints[-1] - joints[-60]).max() == 0  # stands
    speed = np.diff(joints, axis=0) / 0.005
    assert np.abs(np.diff(speed, axis=0)).max() / 0.005 < 4.6  # braked, not thrown
    execution.go()
    execution.step(1.0)
    assert execution.state == Stage.ABORTED
    assert np.array_equal(execution.joints_rad, joints[-1])


def test_a_cut_is_one_once_an_arm_has_had_the_time_to_come_up_with_it():
    execution, cutting = Execution(motions()), []
    while execution.state != Stage.DONE:
        cutting.append((execution.state, execution.cutting))
        execution.step(0.01)
    for state in STATES:
        flags = [is_cut for name, is_cut in cutting if name == state]
        first = flags.index(True) if any(flags) else len(flags)
        assert all(flags[first:])
        # All of these sweeps is cut: but for their first 0.3 s, by the samples 0.1 s apart.
        assert (25 <= first <= 42) == state.startswith("sweep")
    assert not execution.cutting


@given(st.lists(st.tuples(st.booleans(), st.floats(0, 0.7)), min_size=1, max_size=30))
@settings(max_examples=60, deadline=None)
def test_halts_only_delay(orders):
    """Whatever the halts, arms stay on their way, never turn back, and come to the same end."""
    straight = motions(("approach", "sweep 1"))
    execution = Execution(straight)
    before = execution.joints_rad
    for go, seconds in orders:
        execution.go() if go else execution.halt(Halt("silent"))
        execution.step(seconds)
        after = execution.joints_rad
        stage = straight.stages[0 if execution.state == "approach" else 1]
        way = stage.joints_rad
        assert (after >= way.min(0) - 1e-12).all()
        assert (after <= way.max(0) + 1e-12).all()
        if execution.state == "approach":
            assert (after >= before - 1e-12).all()
        before = after
    execution.go()
    execution.step(10.0)
    assert execution.state == Stage.DONE
    assert execution.joints_rad == pytest.approx(straight.stages[-1].joints_rad[-1])


def test_new_motions_begin_where_the_arms_are():
    execution = Execution(motions())
    with pytest.raises(InputError):
        execution.step(-0.1)
    execution.step(0.5)
    with pytest.raises(InputError):
        execution.replace(motions())
    execution.halt(Halt("planning"))
    execution.step(2.0)
    with pytest.raises(InputError):
        execution.replace(motions())
    execution.replace(motions(("sweep 2", "home"), first=execution.joints_rad))
    execution.go()
    execution.step(0.5)
    assert execution.state == "sweep 2"
    assert execution.sweep == 2
    assert execution.holds


@pytest.mark.parametrize("sweep", [1, 2])
def test_while_an_instrument_withdraws_the_sweep_is_the_one_that_follows(sweep):
    rest = STATES[STATES.index(f"sweep {sweep}") :]
    execution, seen = Execution(motions((Stage.WITHDRAW, *rest))), {}
    while execution.state != Stage.DONE:
        seen.setdefault(execution.state, set()).add((execution.sweep, execution.holds))
        assert not (execution.state == Stage.WITHDRAW and execution.cutting)
        execution.step(0.01)
    assert list(seen) == [Stage.WITHDRAW, *rest]
    assert seen[Stage.WITHDRAW] == seen[f"sweep {sweep}"] == {(sweep, True)}
    assert seen["lift"] == seen["home"] == {(3, True)}


def plain(cell):
    """The state without its note."""
    return cell.state.partition(" (")[0]


def keeping(plan, **least_mm):
    """The plan with the least distances of the electrode that a check has found."""
    when = ("sweep 1", 0.0, (0.0, 0.0, 0.0))
    found = [Clearance(ELECTRODE, part, mm, mm, *when) for part, mm in least_mm.items()]
    return replace(plan, clearances=tuple(found))


def states_of(plan):
    sweeps = (f"sweep {n}" for n in range(1, plan.sweeps + 1))
    return (*STATES[:3], *sweeps, *STATES[-3:])


class World:
    """An organ that the tests move, an operation on it, and a clock."""

    def __init__(self, replan=None, config=None, plan=PLAN, budget=None):
        self.located = LOCATED
        self.planned = Planned(plan, self.located.meshes, motions(states_of(plan)))
        self.calls, self.before = [], []
        self.made = replan or self.replan
        self.pool = ThreadPoolExecutor(1)
        self.waits, self.plans = True, []
        self.operation = Operation(
            self.planned,
            config or OperationConfig(settled_s=0.2),
            lambda joints: (),
            Following(self.locate, self.begin, budget),
        )
        self.now_s = 100.0
        self.shifts = {}  # of parts that move by themselves
        self.shift = np.zeros(3)

    def locate(self, update):
        meshes = {
            name: mesh.with_vertices(mesh.vertices_mm + self.shifts.get(name, self.shift))
            for name, mesh in self.located.meshes.items()
        }
        return replace(self.located, points_mm=self.located.points_mm + self.shift, meshes=meshes)

    def begin(self, update, joints_rad, progress, before):
        self.before.append(before)
        work = self.pool.submit(self.made, self.locate(update), joints_rad, progress)
        self.plans.append(work)
        return work

    def replan(self, organ, joints_rad, progress):
        before = self.planned.plan
        config = ResectionConfig(
            method=before.method, margin_mm=before.margin_mm, tumor=before.tumor
        )
        plan = replace(plan_resection(organ, config), clearances=before.clearances)
        sweep = progress.first_sweep
        self.calls.append((organ.meshes["tumor_1"].box_mm.mean(0), sweep))
        states = states_of(plan)
        states = states if sweep is None else states[states.index(f"sweep {sweep}") :]
        return Planned(plan, organ.meshes, motions(states, joints_rad))

    def frame(self, seconds=FRAME_S, **changes):
        """One frame later; returns what sinks get of the arms."""
        self.now_s += seconds
        if self.waits:  # in the world's time, planning takes no longer than a frame
            wait(self.plans)
        update = replace(GOOD, **changes)
        return self.operation.act(update, self.now_s).control

    @property
    def joints_rad(self):
        return np.array(list(self.operation.workcell().joints_rad.values()))

    def frames(self, n, **changes):
        for _ in range(n):
            cell = self.frame(**changes)
        return cell

    def until(self, state, most=600, **changes):
        for _ in range(most):
            cell = self.frame(**changes)
            if plain(cell) == state:
                return cell
        raise AssertionError(f"never {state}, but {cell.state}: {cell.stopped}")


def test_a_whole_procedure_on_an_organ_that_keeps_still():
    world = World()
    states = []
    while not world.operation.ended:
        cell = world.frame()
        if not states or states[-1] != plain(cell):
            states.append(plain(cell))
        assert cell.halt is None
        assert set(cell.joints_rad) == set(JOINTS)
    assert tuple(states) == (*STATES, Stage.DONE)
    log = world.operation.summary()["resection"]["log"]
    assert [entry["state"] for entry in log] == [*STATES, Stage.DONE]
    assert 7.8 < log[-1]["at_s"] < 8.6  # eight stages of a second, and a soft start


NO_ESTIMATE = {"estimate": None, "reason": "no frame for 0.6 s", "quality": "none"}


@pytest.mark.parametrize("state", [s for s in STATES if s not in ("lift", "release", "home")])
@pytest.mark.parametrize(
    ("doubt", "kind"),
    [
        (NO_ESTIMATE, "no_estimate"),
        ({"quality": "poor", "warning": "the camera sees through it"}, "poor"),
    ],
    ids=["stale", "flagged"],
)
def test_every_doubt_halts_the_arms_and_they_go_on_after_it(state, doubt, kind):
    world = World()
    world.until(state)
    cell = world.frames(15, **doubt)
    assert cell.halt.kind == kind
    assert cell.halt.values["message"] in doubt.values()
    still = world.frame(**doubt)
    assert still.joints_rad == cell.joints_rad
    assert plain(still) == state
    world.until(Stage.DONE)


def test_without_a_word_from_the_loop_the_arms_halt_by_themselves():
    world = World()
    world.until("approach")
    world.frame()
    before = world.joints_rad
    world.frame(seconds=5.0)  # the loop hung
    moved = np.abs(world.joints_rad - before).max()
    assert 0 < moved < 0.2 * 0.5  # rad: no more than 0.2 s and the brake's way of 0.2 rad/s ...
    assert world.operation.summary()["resection"]["state"] == "approach"


def test_a_tumor_that_moved_is_planned_anew_once_it_has_settled():
    world = World()
    world.until("approach")
    world.shift = np.array([6.0, 2.0, 0.0])
    cell = world.frames(3)
    assert cell.halt.kind == "moved"
    assert cell.halt.values == {"part": "tumor_1", "off_mm": pytest.approx(np.hypot(6, 2))}
    for _ in range(200):
        cell = world.frame()
        if world.calls and not cell.halt:
            break
    assert world.calls[0][0] == pytest.approx(TUMOR_MM + world.shift, abs=0.1)
    assert world.calls[0][1] is None  # not held yet: from the approach
    assert world.operation.planned.plan.grasp_mm == pytest.approx(
        world.planned.plan.grasp_mm + world.shift, abs=0.5
    )
    world.until(Stage.DONE)
    assert len(world.calls) == 1
    assert any(entry.get("event") == "planned anew" for entry in world.operation.log)


def test_a_tumor_that_moves_in_the_second_sweep_is_held_and_cut_on_from_there():
    world = World()
    world.until("sweep 2")
    world.frames(10)
    world.shift = np.array([0.0, 0.0, 4.0])
    for _ in range(300):
        world.frame()
        if world.calls:
            break
    assert world.calls[0][1] == 2
    world.until(Stage.DONE)


def test_a_tumor_that_moves_while_the_instrument_withdraws_loses_no_sweep():
    """Planned anew in the second sweep, and once more before the instrument is out."""

    def replan(organ, joints_rad, progress):
        world.calls.append((organ.meshes["tumor_1"].box_mm.mean(0), progress))
        states = (Stage.WITHDRAW, *STATES[STATES.index(f"sweep {progress.first_sweep}") :])
        return Planned(PLAN, organ.meshes, motions(states, joints_rad))

    world = World(replan)
    world.until("sweep 2")
    world.shift = np.array([0.0, 0.0, 4.0])
    cell = world.until(Stage.WITHDRAW)
    colours = {line.name: line.colour for line in cell.lines}
    assert colours["cut/1"] != colours["cut/2"]  # the first is done
    world.frames(3)
    world.shift = np.array([0.0, 0.0, 8.0])
    while len(world.calls) < 2:
        assert plain(world.frame()) == Stage.WITHDRAW
    assert [progress for _, progress in world.calls] == 2 * [ResectionProgress(True, 1)]
    world.until("sweep 2")
    world.until(Stage.DONE)


def test_where_an_organ_that_is_cut_has_no_plan_the_arms_halt_and_seek_one_again():
    """They stand as they are: it goes on from there, with a later plan or where it was."""

    def refuses(organ, joints_rad, progress):
        world.calls.append(progress)
        raise NoPlan("the holder can't reach it")

    world = World(refuses)
    world.until("sweep 1")
    world.shift = np.array([0.0, 0.0, 4.0])
    while not world.calls:
        cell = world.frame()
    cell = world.frames(100)
    assert (cell.halt.kind, cell.halt.values["message"]) == ("no_plan", "the holder can't reach it")
    assert plain(cell) == "sweep 1"
    assert world.calls == [ResectionProgress(True, 0)]
    cell = world.frames(100)  # seconds later
    assert world.calls == 2 * [ResectionProgress(True, 0)]
    stood = cell.joints_rad
    world.shift = np.zeros(3)
    assert world.frame().joints_rad == stood
    world.made = world.replan
    world.until("sweep 2")
    world.shift = np.array([0.0, 0.0, 4.0])
    world.until(Stage.DONE)
    assert world.calls[-1][1] == 2


def test_facets_and_grasp_go_with_the_tumor_and_what_they_are_planned_on_is_the_flap_as_it_is():
    """A flap that is lifted and turned has its walls elsewhere."""
    whole = plan_resection(LOCATED, ResectionConfig(tumor="tumor_1"))
    world = World(plan=whole)
    world.until("sweep 1")
    world.frames(5)
    turned = rigid(turned_by(np.radians([20.0, -10.0, 0.0])), np.array([2.0, 1.0, 8.0]))
    tumor = LOCATED.meshes["tumor_1"]
    lifted = tumor.with_vertices(transform_points(turned, tumor.vertices_mm))
    world.located = replace(LOCATED, meshes={**LOCATED.meshes, "tumor_1": lifted})
    while not world.before:
        world.frame()
    before = world.before[0]
    for axis, plane, made, cut in zip(
        before.facets[:, :3], before.facets, whole.cuts, before.cuts, strict=True
    ):
        at = transform_points(turned, made.path_mm)
        assert cut.path_mm == pytest.approx(at)
        assert at @ axis == pytest.approx(plane[3])  # the tip stays in its facet
        assert cut.axis == pytest.approx(turned[:3, :3] @ made.axis)
    assert before.lift == pytest.approx(turned[:3, :3] @ whole.lift)
    assert before.grasp_mm == pytest.approx(transform_points(turned, whole.grasp_mm[None])[0])


@pytest.mark.parametrize("part", ["kidney", "tumor_1", "tumor_2"])
def test_a_part_that_is_not_found_halts_the_arms(part):
    world = World()
    world.until("approach")
    whole = world.located
    left = {name: mesh for name, mesh in whole.meshes.items() if name != part}
    world.located = replace(whole, meshes=left)
    cell = world.frames(10)
    assert (cell.halt.kind, cell.halt.values) == ("missing", {"part": part})
    assert world.frame().joints_rad == cell.joints_rad
    world.located = whole
    world.until(Stage.DONE)


def test_after_the_last_sweep_no_estimate_is_needed_any_more():
    world = World()
    world.until("lift")
    assert world.frame(**NO_ESTIMATE).halt is None
    world.until(Stage.DONE, **NO_ESTIMATE)


@pytest.mark.parametrize("part", ["kidney", "tumor_2"])
def test_another_part_that_moved_far_halts_the_arms_too(part):
    world = World()
    world.until("approach")
    world.shifts = {part: np.array([0, 0, 3.9])}  # twice the tumor's 2 mm are allowed
    assert world.frames(2).halt is None
    world.shifts = {part: np.array([0, 0, 5.0])}
    halt = world.frames(2).halt
    assert halt.kind == "moved"
    assert halt.values == {"part": part, "off_mm": pytest.approx(5.0)}


def test_a_tumor_that_keeps_moving_is_waited_for_and_its_return_is_enough():
    world = World()
    world.until("approach")
    for n in range(60):  # it breathes: never at rest, and away from the plan
        world.shift = np.array([0.0, 0.0, 6.0 + 3.0 * np.sin(0.6 * n)])
        cell = world.frame()
    assert cell.halt.kind == "moved"
    assert not world.calls
    assert list(world.operation.halts.values()) == [1]  # one reason, many numbers
    for n in range(60, 60 + int(11 / FRAME_S)):
        world.shift = np.array([0.0, 0.0, 6.0 + 3.0 * np.sin(0.6 * n)])
        cell = world.frame()
    assert cell.halt.kind == "restless"  # it does not settle: that is said
    assert cell.halt.values["part"] in LOCATED.meshes
    world.shift = np.zeros(3)
    assert world.frames(2).halt is None
    world.until(Stage.DONE)


INDEPENDENT_MM = np.hypot(4.2, np.sqrt(5))  # tracking, hand-eye and tool


def off_by(bound_mm):
    """How an estimate differs whose tumors may be so far off."""
    estimate = bounded(GOOD.estimate, tumor_1=bound_mm, tumor_2=bound_mm)
    return {"estimate": estimate, "latency_ms": 50.0}


def budgeted(**least_mm):
    """A world whose arms heed an error budget for each tumor, by the electrode's least distance
    from it, and estimates as sure as when it was planned."""
    plan = keeping(plan_resection(LOCATED, ResectionConfig(tumor="tumor_1")), **least_mm)
    planned = [
        ErrorBudget(part=part, margin_mm=mm, tracking_mm=4.2, hand_eye_mm=1.0, tool_mm=2.0)
        for part, mm in least_mm.items()
    ]
    return World(plan=plan, budget=LiveBudget(planned)), off_by(4.2)


def test_arms_stand_while_the_errors_exceed_the_margin_and_go_on_when_they_shrink():
    world, changes = budgeted(tumor_1=10.0, tumor_2=30.0)
    cell = world.until("grasp", **changes)
    assert cell.left_mm == pytest.approx(10.0 - INDEPENDENT_MM)
    changes = off_by(12.0)
    cell = world.frames(15, **changes)
    assert cell.halt.kind == "over_budget"
    assert cell.halt.values == {
        "sum_mm": pytest.approx(np.hypot(12.0, np.sqrt(5))), "margin_mm": 10.0, "part": "tumor_1",
        "term": "tracking", "term_mm": 12.0,
    }  # fmt: skip
    assert cell.left_mm < 0
    assert cell.stopped == cell.halt.message
    assert all(words and words in cell.line for words in (cell.state, cell.stopped, cell.note))
    changes = off_by(12.5)
    worse = world.frame(**changes)
    assert worse.joints_rad == cell.joints_rad
    assert (worse.kind, worse.line != cell.line) == (cell.kind, True)  # other numbers alone
    assert not world.plans  # a new plan would not help
    changes = off_by(4.5)
    assert world.frames(2, **changes).halt is None
    world.until(Stage.DONE, **changes)
    budgets = world.operation.summary()["resection"]["budget"]
    assert budgets["planned"]["sum_mm"] == pytest.approx(INDEPENDENT_MM)
    assert budgets["worst"]["tracking_mm"] == 4.5  # of those on which the arms went on
    assert budgets["worst"]["left_mm"] > 0
    assert list(world.operation.halts.values()) == [1]


@pytest.mark.parametrize(("bound_mm", "pace"), [(4.2, 0.58), (6.0, 0.4), (8.9, 0.25)])
def test_the_less_is_known_of_a_tumor_the_slower_are_the_sweeps(bound_mm, pace):
    world, _ = budgeted(tumor_1=10.0, tumor_2=30.0)
    changes = off_by(bound_mm)
    world.until("sweep 1", **changes)
    world.frames(5, **changes)
    before, at_s = world.joints_rad, world.now_s
    cell = world.frames(3, **changes)
    slow_rad = np.abs(world.joints_rad - before).max() / (world.now_s - at_s)
    assert f"{pace:.0%}" in cell.line
    free = World(plan=world.planned.plan)
    free.until("sweep 1")
    free.frames(2)
    before, at_s = free.joints_rad, free.now_s
    assert "%" not in free.frames(2).line
    fast_rad = np.abs(free.joints_rad - before).max() / (free.now_s - at_s)
    assert slow_rad / fast_rad == pytest.approx(pace, rel=0.1)


def test_less_motion_than_allowed_can_be_too_much_and_is_planned_anew():
    world, changes = budgeted(tumor_1=5.6, tumor_2=30.0)
    world.until("approach", **changes)
    world.shift = np.array([1.5, 0.0, 0.0])  # 2 mm are allowed
    cell = world.frames(3, **changes)
    assert cell.halt.kind == "over_budget"
    assert cell.halt.values["sum_mm"] == pytest.approx(1.5 + INDEPENDENT_MM, abs=0.1)  # some lag
    for _ in range(200):
        cell = world.frame(**changes)
        if world.calls and not cell.halt:
            break
    assert world.calls[0][0] == pytest.approx(TUMOR_MM + world.shift, abs=0.1)
    assert cell.left_mm > 0


def test_arms_stand_while_nothing_says_how_far_off_a_tumor_may_be():
    world, changes = budgeted(tumor_1=30.0, tumor_2=30.0)
    world.until("sweep 1", **changes)
    unknown = {**changes, "estimate": bounded(GOOD.estimate, tumor_1=4.2)}
    cell = world.frames(15, **unknown)
    assert (cell.halt.kind, cell.halt.values) == ("no_bound", {"part": "tumor_2"})
    assert world.frame(**unknown).joints_rad == cell.joints_rad
    assert not world.plans
    assert world.frames(2, **changes).halt is None
    world.until(Stage.DONE, **changes)


def test_where_no_new_plan_can_be_made_the_arms_stop_for_good_and_say_why():
    def refuses(organ, joints_rad, progress):
        raise NoPlan("the holder can't reach it")

    world = World(refuses)
    world.until("hold")
    world.shift = np.array([9.0, 0.0, 0.0])
    cell = None
    for _ in range(300):
        cell = world.frame()
        if cell.state == Stage.ABORTED:
            break
    assert cell.state == Stage.ABORTED
    assert (cell.halt.kind, cell.halt.values["message"]) == ("no_plan", "the holder can't reach it")
    assert world.operation.ended


def test_while_it_is_planned_the_loop_goes_on():
    gate = threading.Event()

    def slow(organ, joints_rad, progress):
        gate.wait(PATIENCE_S)
        raise NoPlan("never mind")

    world = World(slow)
    world.waits = False
    world.until("grasp")
    world.shift = np.array([9.0, 0.0, 0.0])
    try:
        cells = [world.frame() for _ in range(40)]  # which would end in "never mind"
        assert cells[-1].halt.kind == "planning"
    finally:
        gate.set()


@pytest.mark.parametrize("bad", [{"moved_mm": 0}, {"speed": 50}, {"settled_s": -1}])
def test_nonsense_is_refused(bad):
    with refused(InputError, *bad):
        OperationConfig(**bad)


def test_what_a_new_plan_warns_of_is_said_with_every_state_from_then_on():
    def replan(organ, joints_rad, progress):
        made = world.replan(organ, joints_rad, progress)
        notes = (f"{NO_ROOM} 5 mm from other tumors; kept are 1 mm from tumor_2.",)
        return replace(made, plan=replace(made.plan, notes=notes))

    world = World(replan, plan=replace(PLAN, notes=(f"{OVER_BUDGET}: 9 mm of error.",)))
    assert NO_ROOM not in world.until("approach").state
    world.shift = np.array([6.0, 2.0, 0.0])
    while not world.calls:
        world.frame()
    cell = world.until("sweep 1")
    assert NO_ROOM in cell.state
    assert OVER_BUDGET in cell.state  # which a person accepted, for all plans
    assert NO_ROOM in world.operation.summary()["resection"]["note"]


def test_surfaces_of_other_triangles_are_compared_by_their_distance():
    from tumortrack_resection.operation import distance_mm

    a, b = sphere(TUMOR_MM, RADIUS_MM), sphere(TUMOR_MM + [3.0, 4.0, 0.0], RADIUS_MM, finer=3)
    assert 2.0 < distance_mm(a, b) < 5.0  # between the surfaces, some of which slide
    wall = sphere(TUMOR_MM, 0.3 * RADIUS_MM)  # a new one
    more = Mesh(
        np.concatenate([a.vertices_mm, wall.vertices_mm]),
        np.concatenate([a.faces, wall.faces + len(a.vertices_mm)]),
    )
    assert distance_mm(more, a) == 0
    assert distance_mm(a, more) > 2
    assert distance_mm(a, sphere(TUMOR_MM, RADIUS_MM, finer=3)) < 0.7
    assert distance_mm(a, a.with_vertices(a.vertices_mm + [0, 0, 2.0])) == pytest.approx(2.0)
