"""The holder pulls at what it holds: its place is evidence, and the arms follow the tumor."""

from __future__ import annotations

import json
from concurrent.futures import Future
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from live_objects import small_estimate, small_update
from plan_objects import Deviating, located, sphere
from refused import refused
from reports import reporting
from stories import answered, succeeded, tumortrack
from tumortrack.core import store
from tumortrack.core.errors import NoPlan
from tumortrack.core.geometry import transform_points
from tumortrack.core.report import NextEvidence
from tumortrack.io.case import load_case
from tumortrack.io.ply import write_cloud_ply
from tumortrack.live.spec import SOURCES
from tumortrack.live.values import PublishedFrame
from tumortrack.segmentation import Hints, organ_points
from tumortrack.tracking.tracker import region_for
from tumortrack_devices.pulled import PulledStates
from tumortrack_resection.arms import procedure as arms_procedure
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.cell import ArmCell
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.procedure import plan_motions
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.files import PlanFolder, read_plan, write_plan
from tumortrack_resection.grip import Grip
from tumortrack_resection.motions import HOLDER, Execution, Motions, MotionStage, Stage
from tumortrack_resection.operation import (
    Following,
    Operation,
    OperationConfig,
    Planned,
    ResectionProgress,
)
from tumortrack_resection.values import ResectionConfig

FIRST, LAST = ("approach", "grasp", "hold", "pull", "taut"), ("lift", "release", "home")
STATES = (*FIRST, "sweep 1", *LAST)
GRIPPING = (Stage.PULL, Stage.TAUT, "sweep 1")
PULL_MM = 4.0
LOCATED = located(sphere((12.0, -14.0, 165.0), 10.0), n=6_000)
PLAN = plan_resection(LOCATED, ResectionConfig(method="published"))
FRAMES = PublishedFrame(
    "table", np.array([[1.0, 0, 0, 5.0], [0, -1, 0, -8.0], [0, 0, -1, 300.0], [0, 0, 0, 1]])
)
CAMERA_FROM_TABLE = np.linalg.inv(FRAMES.published_from_camera)


def motions(states=STATES):
    """The holder's first joint is its tip's height (mm): up by the pull, and far at the lift."""
    ends, here, stages = {Stage.PULL: PULL_MM, Stage.LIFT: 60.0}, 0.0, []
    for name in states:
        there, joints = ends.get(name, here), np.zeros((2, 12))
        joints[:, 6], here = (here, there), there
        stages.append(MotionStage(name, np.array([0.0, 1.0]), joints, np.zeros(2, bool)))
    return Motions(tuple(stages))


def tip_mm(arm, own_rad):
    assert arm == HOLDER
    return np.array([10.0, 20.0, 150.0 + own_rad[0]])


def seen(quality="good", **entries):
    estimate = replace(small_estimate(), motion=Deviating(0.9))
    estimate = reporting(estimate, **entries) if entries else estimate
    return replace(small_update(frames=FRAMES), estimate=estimate, quality=quality)


class Procedure:
    """Its operation on a tumor that the test moves, frame by frame."""

    def __init__(self, replan=None):
        self.shift_mm, self.now_s = np.zeros(3), 0.0
        config = OperationConfig(settled_s=0.1)
        planned, self.grip = Planned(PLAN, LOCATED.meshes, motions()), Grip(tip_mm, 1.2)
        draw = lambda joints: ()  # noqa: E731
        live = Following(self.locate, replan, grip=self.grip)
        self.operation = Operation(planned, config, draw, live)

    def locate(self, update):
        meshes = {
            n: m.with_vertices(m.vertices_mm + self.shift_mm) for n, m in LOCATED.meshes.items()
        }
        return replace(LOCATED, meshes=meshes)

    def frame(self, update=None):
        self.now_s += 0.02
        return self.operation.act(update or seen(), self.now_s).control

    def until(self, state):
        for _ in range(900):
            if (cell := self.frame()).state.partition(" (")[0] == state:
                return cell
        raise AssertionError(f"never {state}")

    @property
    def held(self):
        return self.operation.evidence(CAMERA_FROM_TABLE, 7)


def test_what_the_cup_holds_is_evidence_from_the_grip_to_the_lift_and_no_longer():
    procedure, told = Procedure(), {state: [] for state in STATES}
    while not procedure.operation.ended:
        state = procedure.frame().state.partition(" (")[0]
        told.get(state, []).append(procedure.held)
    for state, frames in told.items():
        assert all(bool(held) == (state in GRIPPING) for held in frames[1:-1])
    first, last = told[Stage.PULL][0][0], told["sweep 1"][-1][0]
    assert first.point_ct == last.point_ct  # of the moment of gripping, wherever it is by now
    assert first.point_ct == pytest.approx(
        transform_points(CAMERA_FROM_TABLE, tip_mm(HOLDER, [0.0])[None])[0]  # Deviating carries so
    )
    assert last.place_mm == pytest.approx(
        transform_points(CAMERA_FROM_TABLE, tip_mm(HOLDER, [PULL_MM])[None])[0]
    )
    assert (last.std_mm, last.stamp_ns, last.tool) == (1.2, 7, HOLDER)
    assert last.point_std_mm == pytest.approx(0.9 / np.sqrt(3))


def test_without_a_motion_or_a_good_estimate_nothing_is_known_of_what_is_held():
    without = replace(small_update(frames=FRAMES), estimate=small_estimate())
    for update in (without, seen("poor"), replace(without, estimate=None, quality="none")):
        execution, grip = Execution(motions()), Grip(tip_mm, 1.2)
        while execution.state != Stage.TAUT:
            grip.update(execution, update)
            execution.step(0.05)
        grip.update(execution, seen())  # too late: the tissue has moved since
        assert grip.evidence(CAMERA_FROM_TABLE, 0) == ()
        assert grip.pulled_mm == pytest.approx(PULL_MM)  # that the arm knows all the same


def test_a_tip_that_moves_is_less_sure_of_where_it_is():
    execution, grip = Execution(motions()), Grip(tip_mm, 1.2)
    grip.update(execution, seen())
    while execution.state != Stage.PULL:
        execution.step(0.05)
    grip.update(execution, seen())
    before_mm = execution.joints_rad[6]
    execution.step(0.5)
    grip.update(execution, seen())
    (held,) = grip.evidence(CAMERA_FROM_TABLE, 0)
    assert held.std_mm == pytest.approx(np.hypot(1.2, execution.joints_rad[6] - before_mm))
    grip.update(execution, seen())
    assert grip.evidence(CAMERA_FROM_TABLE, 0)[0].std_mm == pytest.approx(1.2)


@pytest.mark.parametrize(("far_mm", "kind"), [(PULL_MM, "moved"), (0.5, "planning")])
def test_the_pull_itself_halts_nothing_and_then_it_is_planned_on_the_pulled_tumor(far_mm, kind):
    plans = []

    def replan(update, joints_rad, progress, before):
        assert before.grasp_mm == pytest.approx(PLAN.grasp_mm + procedure.shift_mm)
        plans.append((joints_rad[6], progress))
        meshes = procedure.locate(update).meshes
        later = Motions(motions(STATES[5:]).stages)
        for stage in later.stages:
            stage.joints_rad[:, 6] = np.maximum(stage.joints_rad[:, 6], PULL_MM)
        work = Future()
        work.set_result(Planned(PLAN, meshes, later))
        return work

    procedure = Procedure(replan)
    procedure.until(Stage.PULL)
    for _ in range(20):
        procedure.shift_mm = np.array([0.0, 0.0, procedure.grip.pulled_mm])
        assert procedure.frame().halt is None
    while procedure.frame().state == Stage.PULL:
        pass
    procedure.shift_mm = np.array([0.0, 0.0, far_mm])
    assert procedure.frame().halt.kind == kind
    procedure.until("sweep 1")
    ((height_mm, progress),) = plans
    assert height_mm == pytest.approx(PULL_MM)
    assert progress == ResectionProgress(holds=True, done=0)  # it begins with its first sweep
    assert len(procedure.held) == 1  # with the same point, though no stage of the new plan took it
    assert procedure.frame().halt is None


def test_a_grip_that_slips_halts_the_arms():
    procedure = Procedure()
    procedure.until("sweep 1")
    errors = {"std_mm": 1.2, "off_mm": 11.6, "information_gain": 0.0}
    slipped = [{"name": "grasp", **errors, "rejected": True}]
    for quality in ("good", "poor"):  # whatever else is thought of it
        cell = procedure.frame(seen(quality, evidence=slipped))
        assert (cell.halt.kind, cell.halt.values["off_mm"]) == ("slipped", 11.6)
    assert procedure.frame(seen(evidence=[{**slipped[0], "rejected": False}])).halt is None


@pytest.fixture(scope="module")
def taut():
    """A workcell that pulls, and what was planned in it."""
    config = CellConfig(pull_mm=PULL_MM)
    return config, *plan_motions(LOCATED, ResectionConfig(most_facets=3), config)


def test_arms_are_planned_to_pull_and_a_plan_without_its_pull_is_refused(taut, tmp_path):
    config, plan, made = taut
    sweeps = [f"sweep {n}" for n in range(1, plan.sweeps + 1)]
    named = {stage.name: stage for stage in made.stages}
    assert list(named) == [*FIRST, *sweeps, *LAST]
    cell = ArmCell(config, LOCATED.organ)
    begin, end = (cell.tips(named[Stage.PULL].joints_rad[n])[HOLDER][:3, 3] for n in (0, -1))
    assert end - begin == pytest.approx(PULL_MM * plan.lift, abs=0.02)
    assert np.ptp(named[Stage.TAUT].joints_rad, axis=0).max() == 0
    content = PlanFolder(
        plan, ResectionConfig(), PublishedFrame("table"), LOCATED.meshes,
        (ErrorBudget(part="tumor_1", margin_mm=5.0),), config, made,
    )  # fmt: skip
    write_plan(tmp_path / "plan", content, {}, lambda folder: None)
    assert [s.name for s in read_plan(tmp_path / "plan").motions.stages] == list(named)
    still = replace(content, cell=msgspec.structs.replace(config, pull_mm=0.0))
    with refused(NoPlan, "approach, grasp, hold, pull"):
        write_plan(tmp_path / "still", still, {}, lambda folder: None)


def test_what_is_taut_is_cut_along_the_same_facets_where_it_lies_now(taut, monkeypatch):
    config, plan, made = taut
    urdf = cell_urdf(config)
    monkeypatch.setattr(
        arms_procedure, "_setting", [(ResectionConfig(most_facets=3), config, urdf)]
    )
    here = next(stage.joints_rad[-1] for stage in made.stages if stage.name == Stage.TAUT)
    up_mm = PULL_MM * plan.lift
    meshes = {n: mesh.with_vertices(mesh.vertices_mm + up_mm) for n, mesh in LOCATED.meshes.items()}
    pulled = replace(LOCATED, points_mm=LOCATED.points_mm + up_mm, meshes=meshes)
    anew = arms_procedure.replan(pulled, here, ResectionProgress(holds=True), plan)
    assert [stage.name for stage in anew.motions.stages] == [s.name for s in made.stages[5:]]
    assert anew.plan.facets[:, :3] == pytest.approx(plan.facets[:, :3])
    assert anew.plan.facets[:, 3] == pytest.approx(plan.facets[:, 3] + plan.facets[:, :3] @ up_mm)
    assert anew.plan.least_mm["tumor_1"] > 4.7
    holder_rad = np.concatenate([s.joints_rad[:, 6:] for s in anew.motions.stages[: plan.sweeps]])
    assert np.ptp(holder_rad, axis=0).max() == 0  # it pulls on, and does not pull again


@pytest.mark.parametrize("reached", [True, False])
def test_arms_that_stand_advise_what_they_reach(monkeypatch, reached):
    touch = NextEvidence(
        kind="touch", part="tumor_1", place_mm=(1.0, 2.0, 3.0), direction=(0.0, 0.0, -1.0),
        std_mm=2.0, then_std_mm=1.0, bound_mm=6.0, then_bound_mm=3.0,
    )  # fmt: skip
    ways = np.array(touch.place_mm), np.array(touch.direction)
    monkeypatch.setattr(
        "tumortrack_resection.operation.advise", lambda _, part, reach: [touch] * reach(*ways)
    )
    asked = []

    def reach_of(organ, joints_rad):
        return lambda place_mm, normal: asked.append((place_mm, normal)) or reached

    live = Following(lambda update: LOCATED, reach=reach_of)
    arms = Operation(
        Planned(PLAN, LOCATED.meshes, motions()), OperationConfig(), lambda joints_rad: (), live
    )
    estimate = seen().estimate
    update = replace(seen(), estimate=estimate.assessed(next_evidence=(touch,)))
    assert arms.act(update, 0.0).estimate.assessment.next_evidence == ()  # at work
    assert not asked
    halted = arms.act(replace(update, quality="poor"), 0.02).estimate.assessment.next_evidence
    assert halted == (touch,) * reached
    ((place_mm, normal),) = asked  # table frame
    assert transform_points(CAMERA_FROM_TABLE, place_mm[None])[0] == pytest.approx(ways[0])
    assert normal == pytest.approx([0.0, 0.0, 1.0])


@pytest.mark.slow
def test_a_live_pull_is_followed_planned_on_and_cut(ready_case, tmp_path):
    """The tumor goes up with the holder; everything else stays: the plan must follow."""
    case = load_case(ready_case)
    world = "breathing=false&instrument=false&camera_motion=false&fps=10"
    source = SOURCES.parse(f"virtual:{ready_case}?{world}")
    player = source.player()
    seen = source.open().at(0.0, 1)
    cloud = organ_points(seen.content, region_for(), Hints(), np.random.default_rng(0)).cloud
    write_cloud_ply(tmp_path / "cloud.ply", cloud.points_mm)
    answered(
        tumortrack(
            "locate", ready_case, tmp_path / "cloud.ply", "--out", tmp_path / "run", "--grid", 64
        )
    )
    (tmp_path / "cell.json").write_text('{"pull_mm": 4}')
    succeeded(
        tumortrack(
            "plan", tmp_path / "run", tmp_path / "plan", "--cell", tmp_path / "cell.json",
            "--method", "published", "--accept-poor", "--accept-budget",
        )
    )  # fmt: skip
    plan = read_plan(tmp_path / "plan")
    up_ct = -player.state_at(0.0).camera_from_room[2, :3]
    tumor = plan.plan.tumor
    grip = case.anatomy.parts[case.anatomy.names.index(tumor)].vertices_mm.mean(0)
    vertices = np.concatenate([part.vertices_mm for part in player.anatomy_ct.parts])
    share = np.exp(-0.5 * (np.linalg.norm(vertices - grip, axis=1) / 30.0) ** 2)
    moved_mm = np.array([0.0, 4.0])[:, None, None] * share[:, None] * up_ct
    sha256 = store.sha256_of(ready_case / store.MANIFEST)
    PulledStates(sha256, np.array([0.0, 4.0]), moved_mm).write(tmp_path / "pulled.safetensors")
    live = f"virtual:{ready_case}?{world}&pulled={tmp_path / 'pulled.safetensors'}"
    output = succeeded(
        tumortrack(
            "resect", tmp_path / "plan", "--live", ready_case, live, "--speed", 3,
            "--report", tmp_path / "report.json",
        )
    )  # fmt: skip
    assert "done: both virtual arms are home." in output
    resected = json.loads((tmp_path / "report.json").read_text())["resection"]
    assert {Stage.PULL, Stage.TAUT} <= {entry["state"] for entry in resected["log"]}
    assert any(entry.get("event") == "planned anew" for entry in resected["log"])
    assert not any("slipped" in halt for halt in resected["halts"])
