"""Stored and new motions are not believed: what the planner would not have made is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from plan_objects import located, sphere
from refused import refused
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError, NoPlan
from tumortrack.io.mesh_files import write_mesh
from tumortrack.live.values import PublishedFrame
from tumortrack_devices.ros.messages import Messages
from tumortrack_resection import begin_resection
from tumortrack_resection.arms import procedure
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.cell import ArmCell, PlanningGroup
from tumortrack_resection.arms.config import ELECTRODE_RADIUS_MM, CellConfig
from tumortrack_resection.arms.kinematics import level_pose
from tumortrack_resection.arms.procedure import plan_motions
from tumortrack_resection.arms.trajectory import first_hit
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.check import TOLERANCE_MM, checked, clearances
from tumortrack_resection.facets import sphere as directions
from tumortrack_resection.files import (
    PlanFolder,
    check_structures,
    read_plan,
    ros_trajectories,
    write_plan,
)
from tumortrack_resection.motions import CUTTER, JOINTS, Motions, MotionStage, Stage
from tumortrack_resection.operation import ResectionProgress
from tumortrack_resection.values import ELECTRODE, ResectionConfig

pytestmark = pytest.mark.slow

CONFIG = CellConfig()
URDF = cell_urdf(CONFIG)
MARGIN_MM = 5.0
PLANNING = ResectionConfig(
    tumor="tumor_1", margin_mm=MARGIN_MM, most_facets=3, least_exophytic=0.0,
    keep_away={"artery": 3.0},
)  # fmt: skip
FIRST, LAST = ("approach", "grasp", "hold"), ("lift", "release", "home")
LOCATED = replace(
    located(sphere((12.0, -14.0, 165.0), 10.0), sphere((-25.0, 22.0, 160.0), 8.0), n=8_000),
    structures={"artery": sphere((-30.0, 0.0, 140.0), 4.0, 2), "vein": sphere((-36, 0, 140), 2, 2)},
)


@pytest.fixture(scope="module")
def content():
    plan, motions = plan_motions(LOCATED, PLANNING, CONFIG)
    plan = checked(plan, motions, URDF, LOCATED)
    budgets = tuple(
        ErrorBudget(part=part, margin_mm=plan.least_mm[part], motion_mm=2.0)
        for part in ("tumor_1", "tumor_2")
    )
    return PlanFolder(
        plan, PLANNING, PublishedFrame("base"), LOCATED.meshes, budgets, CONFIG, motions,
        "c" * 64, "f" * 64, "e" * 64, structures=dict(LOCATED.structures),
    )  # fmt: skip


def cell_file(folder):
    (folder / "cell.urdf").write_text(URDF)


@pytest.fixture(scope="module")
def stored(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored") / "plan"
    write_plan(folder, content, {}, cell_file)
    return folder


def changed(stored, folder, tensors=None, plan_json=None, files=lambda folder: None):
    """A copy whose files were changed, and sealed again."""
    shutil.copytree(stored, folder)
    path = folder / "motions.safetensors"
    if tensors:
        with safe_open(path, "np") as stream:
            said = stream.metadata()
        arrays = load_file(path)
        said = tensors(arrays) or said
        save_file(arrays, path, metadata=said)
    if plan_json:
        data = json.loads((folder / "plan.json").read_text())
        plan_json(data)
        (folder / "plan.json").write_text(json.dumps(data))
    files(folder)
    store.seal(folder, "plan", {}, "base")
    return folder


def test_a_plan_keeps_its_motions_and_all_that_arms_are_judged_by(content, stored):
    read = read_plan(stored)
    for one, other in zip(read.motions.stages, content.motions.stages, strict=True):
        assert np.array_equal(one.joints_rad, other.joints_rad)
    assert (read.frame_source, read.cell_source) == ("f" * 64, "e" * 64)
    assert (read.budgets, read.cell) == (content.budgets, CONFIG)
    assert set(read.meshes) == {"kidney", "tumor_1", "tumor_2"}
    assert set(read.structures) == {"artery", "vein"}
    plan, planned = read.plan, content.plan
    assert (plan.taken, plan.keep_mm) == (planned.taken, planned.keep_mm)
    assert plan.clearances == planned.clearances
    assert plan.least_mm["tumor_1"] >= MARGIN_MM - TOLERANCE_MM
    assert plan.facets == pytest.approx(planned.facets, abs=1e-4)
    assert plan.lift == pytest.approx(planned.lift)
    assert plan.piece.volume_ml == pytest.approx(planned.piece.volume_ml, rel=1e-5)
    for one, other in zip(plan.cuts, planned.cuts, strict=True):
        assert one.path_mm == pytest.approx(other.path_mm, abs=1e-4)
        assert one.axis == pytest.approx(other.axis)
    assert begin_resection(stored).seconds == pytest.approx(content.motions.seconds)


def pop(*names):
    def change(data):
        *way, last = names
        for name in way:
            data = data[name]
        data.pop(last)

    return {"plan_json": change}


def unlink(file):
    return {"files": lambda folder: (folder / f"{file}.ply").unlink()}


NEEDED = ("frame_source", "cell_source", "budgets", "patient", "cell", "structures", "plan")
OF_PLAN = ("facets", "taken", "keep_mm", "lift", "clearances", "cuts")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        *((pop(name), name) for name in NEEDED),
        *((pop("plan", name), name) for name in OF_PLAN),
        *((unlink(name), name) for name in ("piece", "artery")),
        ({"plan_json": lambda data: data.update(budgets=[])}, "budget"),
        ({"plan_json": lambda data: data.update(cell=None)}, "cell"),
    ],
)
def test_a_plan_that_lacks_what_arms_are_judged_by_is_refused(stored, tmp_path, change, named):
    folder = changed(stored, tmp_path / "plan", **change)
    with refused(ArtifactError, named):
        read_plan(folder)


def test_a_structure_with_the_name_of_a_plans_file_is_refused():
    check_structures(["artery", "vein"])
    for name in ("piece", "strokes"):
        with refused(InputError, name):
            check_structures(["artery", name])


def longer_electrode(folder):
    config = msgspec.structs.replace(CONFIG, electrode_mm=CONFIG.electrode_mm + 5)
    (folder / "cell.urdf").write_text(cell_urdf(config))


@pytest.mark.parametrize(
    "change", [longer_electrode, lambda folder: (folder / "cell.urdf").unlink()]
)
def test_a_cell_that_is_not_the_one_planned_with_is_refused(stored, tmp_path, change):
    folder = changed(stored, tmp_path / "plan", files=change)
    read_plan(folder)
    with pytest.raises(ArtifactError):
        begin_resection(folder)


def put(name, value):
    def change(arrays):
        arrays[name] = arrays[name].copy()
        arrays[name][10, 3] += value

    return change


def stretch(factor):
    def change(arrays):
        arrays |= {n: a * factor for n, a in arrays.items() if n.endswith("times_s")}

    return change


def rename(*stages):
    return lambda _: {"stages": json.dumps(stages), "joints": json.dumps(JOINTS)}


def shift(arrays):
    arrays["3.joints_rad"] = arrays["3.joints_rad"] + 1e-3


def turn(arrays):
    """All the way, so that nothing jumps: the elbow a whole turn farther."""
    for name in arrays:
        if name.endswith("joints_rad"):
            arrays[name] = arrays[name] + 2 * np.pi * (np.arange(12) == 2)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (put("1.joints_rad", np.nan), ["grasp"]),
        (put("1.joints_rad", 3.0), ["cutter_wrist_1_joint"]),
        (put("1.joints_rad", 0.1), ["grasp"]),
        (stretch(1e300), [14400]),
        (stretch(1e3), [14400]),
        (stretch(-1.0), []),
        (stretch(0.1), []),
        (lambda a: a.update({n: v[:0] for n, v in a.items()}), []),
        (turn, ["cutter_elbow_joint", "approach"]),
        (shift, ["0.001 rad", "sweep 1"]),
        (rename(*FIRST, "sweep 2", "sweep 1", *LAST), ["sweep 2, sweep 1"]),
        (rename(*FIRST, "sweep x", "sweep 2", *LAST), []),
        (rename(Stage.WITHDRAW, *FIRST[1:], "sweep 1", "sweep 2", "sweep 3", *LAST), []),
        (rename("approach"), ["approach"]),
    ],
)
def test_motions_that_were_not_planned_so_are_refused_when_read(
    stored, tmp_path, unchecked, change, named
):
    folder = changed(stored, tmp_path / "plan", change)
    with refused(ArtifactError, *named):
        read_plan(folder)


def test_what_would_be_refused_is_not_written(content, tmp_path):
    slow = [replace(stage, times_s=stage.times_s * 1000) for stage in content.motions.stages]
    with refused(NoPlan, 14400):
        write_plan(
            tmp_path / "p", replace(content, motions=Motions(tuple(slow))), {}, lambda _: None
        )
    assert not (tmp_path / "p").exists()


def with_stage(motions, number, **changes):
    stages = list(motions.stages)
    stages[number] = replace(stages[number], **changes)
    return Motions(tuple(stages))


def number_of(motions, name):
    return [stage.name for stage in motions.stages].index(name)


def aside(motions, sweep, by_mm):
    """The instrument moved by this while it cuts in a sweep: smoothly, and far more slowly."""
    number, cell = number_of(motions, f"sweep {sweep}"), ArmCell(CONFIG)
    stage = motions.stages[number]
    joints_rad, times_s = stage.joints_rad.copy(), stage.times_s
    first_s, last_s = times_s[stage.cutting][[0, -1]]
    off_s = np.maximum(first_s - times_s, times_s - last_s)  # from the cut
    lead_s = min(first_s, times_s[-1] - last_s, 1.0)
    for n in np.flatnonzero(off_s < lead_s):
        share = 1.0 - max(off_s[n], 0.0) / lead_s
        pose = cell.tips(joints_rad[n])[CUTTER]
        pose[:3, 3] += share**2 * (3 - 2 * share) * by_mm
        group = PlanningGroup(cell, CUTTER, joints_rad[n])
        solutions = group.inverse_kinematics(pose)
        nearest = np.abs(solutions - group.current_rad).max(1).argmin()
        joints_rad[n] = group.all_joints(solutions[nearest])
    return with_stage(motions, number, joints_rad=joints_rad, times_s=5 * times_s)


def distances(motions, organ):
    """Of each solid of the tools from the tumor."""
    tumor = {"tumor_1": organ.meshes["tumor_1"]}
    return {one.solid: one.least_mm for one in clearances(URDF, motions, tumor, ())}


@pytest.mark.parametrize(("by_mm", "refused"), [(0.2, False), (1.0, True)])
def test_motions_that_were_edited_to_come_nearer_to_the_tumor_are_not_carried_out(
    content, tmp_path, by_mm, refused
):
    """No collision, no jump, no haste: the check of the distances alone can tell."""
    motions = aside(content.motions, 1, -by_mm * content.plan.facets[0, :3])
    assert first_hit(motions, CONFIG, LOCATED.organ) == ""
    nearer_mm = content.plan.least_mm["tumor_1"] - distances(motions, LOCATED)[ELECTRODE]
    assert nearer_mm == pytest.approx(by_mm, abs=0.1)
    write_plan(tmp_path / "plan", replace(content, motions=motions), {}, cell_file)
    read_plan(tmp_path / "plan")
    if refused:
        with pytest.raises(ArtifactError):
            begin_resection(tmp_path / "plan")
    else:
        begin_resection(tmp_path / "plan")


def moved_to(name, mesh, place_mm):
    there = mesh.with_vertices(mesh.vertices_mm - mesh.box_mm.mean(0) + place_mm)
    return lambda folder: write_mesh(folder / f"{name}.ply", there)


@pytest.mark.parametrize(("name", "refused"), [("artery", True), ("vein", False)])
def test_a_structure_in_the_way_of_stored_motions_is_found_if_a_distance_was_asked(
    content, stored, tmp_path, name, refused
):
    """The vein is named as unguarded when it is planned, and again when it is shown."""
    cut = content.plan.cuts[1]
    place_mm = cut.path_mm[len(cut.path_mm) // 2] - 10.0 * cut.axis
    mesh = LOCATED.structures[name]
    folder = changed(stored, tmp_path / "plan", files=moved_to(name, mesh, place_mm))
    if refused:
        with pytest.raises(ArtifactError):
            begin_resection(folder)
    else:
        plan = begin_resection(folder).stored.plan
        assert any(name in warning for warning in plan.warnings)
    near = changed(
        stored, tmp_path / "near",
        files=moved_to(name, mesh, mesh.box_mm.mean(0) + [0.5, 0.0, 0.0]),
    )  # fmt: skip
    begin_resection(near)


def test_distances_that_a_folder_only_claims_are_not_believed(content, stored, tmp_path):
    """The live budget is taken from them."""

    def farther(data):
        for one in data["plan"]["clearances"]:
            one["least_mm"] += 10.0

    found = content.plan.least_mm["tumor_1"]
    for name, change in (
        ("farther", farther),
        ("none", lambda data: data["plan"].update(clearances=[])),
    ):
        folder = changed(stored, tmp_path / name, plan_json=change)
        try:
            session = begin_resection(folder)
        except ArtifactError:
            continue
        assert session.operation.planned.kept_mm["tumor_1"] == pytest.approx(found, abs=1e-3)


def test_collisions_are_looked_for_again_before_motions_are_carried_out(content):
    motions, organ, cell = content.motions, LOCATED.organ, ArmCell(CONFIG, LOCATED.organ)
    assert first_hit(motions, CONFIG, organ) == ""
    # Slowly down to the table and up again, in the middle of the approach
    approach = motions.stages[0]
    pose = level_pose(np.array([350.0, 0, 2]), np.pi)
    low = PlanningGroup(cell, CUTTER, cell.home_rad)
    way = np.linspace(cell.home_rad, low.all_joints(low.inverse_kinematics(pose)[0]), 200)
    joints = np.concatenate([way, way[::-1], approach.joints_rad])
    down = with_stage(
        motions, 0, joints_rad=joints, times_s=0.1 * np.arange(len(joints)),
        cutting=np.zeros(len(joints), bool),
    )  # fmt: skip
    assert "table" in first_hit(down, CONFIG, organ)
    # An organ, or arms, that were exchanged for others
    assert "organ" in first_hit(motions, CONFIG, lying([0.0, 0.0, 40.0]).organ)
    base = msgspec.structs.replace(CONFIG.cutter_base, position_mm=(700.0, 0.0, 100.0))
    assert first_hit(motions, msgspec.structs.replace(CONFIG, cutter_base=base), organ)


def test_the_electrode_goes_through_the_organ_only_as_slowly_as_it_cuts(content):
    number = number_of(content.motions, "sweep 1")
    sweep = content.motions.stages[number]
    hasty = with_stage(content.motions, number, times_s=sweep.times_s * 0.8)
    assert "cutter/electrode would meet organ" in first_hit(hasty, CONFIG, LOCATED.organ)


# Beside the live loop -----------------------------------------------------------------------------


def lying(shift_mm, parts=("kidney", "tumor_1", "tumor_2")):
    """The organ, or these parts of it alone, elsewhere."""
    shift_mm = np.array(shift_mm)
    meshes = {
        name: mesh.with_vertices(mesh.vertices_mm + shift_mm * (name in parts))
        for name, mesh in LOCATED.meshes.items()
    }
    structures = LOCATED.structures
    if "kidney" in parts:
        structures = {
            n: mesh.with_vertices(mesh.vertices_mm + shift_mm) for n, mesh in structures.items()
        }
    labels = [
        n for n, name in enumerate(("kidney", "tumor_1", "tumor_2"), start=1) if name in parts
    ]
    points = LOCATED.points_mm + shift_mm * np.isin(LOCATED.labels, labels)[:, None]
    return replace(LOCATED, points_mm=points, meshes=meshes, structures=structures)


@pytest.fixture
def worker(monkeypatch):
    """Its ``replan``, set up as in the process beside the loop."""
    monkeypatch.setattr(procedure, "_setting", [(PLANNING, CONFIG, URDF)])
    return procedure.replan


def in_the_middle_of(motions, sweep):
    """All joints while it cuts."""
    stage = motions.stages[number_of(motions, f"sweep {sweep}")]
    cutting = np.flatnonzero(stage.cutting)
    return stage.joints_rad[cutting[len(cutting) // 2]]


@pytest.mark.parametrize("sweep", [1, 2])
def test_an_organ_that_moved_is_cut_on_along_the_same_facets(content, worker, sweep):
    before, shift_mm = content.plan, np.array([2.0, -1.5, 2.0])
    organ, joints_rad = lying(shift_mm), in_the_middle_of(content.motions, sweep)
    made = worker(organ, joints_rad, ResectionProgress(True, sweep - 1), before)
    names = [stage.name for stage in made.motions.stages]
    assert names == [
        Stage.WITHDRAW,
        *(f"sweep {n}" for n in range(sweep, before.sweeps + 1)),
        *LAST,
    ]
    assert made.motions.stages[0].joints_rad[0] == pytest.approx(joints_rad)
    assert made.plan.facets[:, :3] == pytest.approx(before.facets[:, :3])
    offsets = before.facets[:, 3] + before.facets[:, :3] @ shift_mm
    assert made.plan.facets[:, 3] == pytest.approx(offsets)
    assert made.plan.least_mm["tumor_1"] >= MARGIN_MM - TOLERANCE_MM  # it was checked
    assert made.plan.least_mm["artery"] >= 3.0 - TOLERANCE_MM
    assert made.meshes is organ.meshes
    for stage in made.motions.stages[: -len(LAST)]:
        assert np.ptp(stage.joints_rad[:, 6:], axis=0).max() == 0  # the cup holds
    # Another place of the same facets is not where those cuts were.
    with pytest.raises(NoPlan):
        checked(before, made.motions, URDF, lying(shift_mm + 6 * before.facets[-1, :3]))


@pytest.mark.parametrize("sweep", [1, 2])
def test_an_organ_that_moves_by_two_millimetres_leaves_every_facet_possible(content, worker, sweep):
    """Or the arms would stand with the electrode in tissue."""
    joints_rad = in_the_middle_of(content.motions, sweep)
    for shift_mm in 2.0 * directions(3):
        progress = ResectionProgress(True, sweep - 1)
        made = worker(lying(shift_mm), joints_rad, progress, content.plan)
        assert made.plan.facets[:, :3] == pytest.approx(content.plan.facets[:, :3])
        assert made.motions.stages[0].name == Stage.WITHDRAW


@pytest.mark.parametrize("others", [0, 1])
def test_facets_that_can_be_cut_no_more_are_given_up_only_if_none_is_cut(content, worker, others):
    lid = np.array([0.0, 0.0, 1.0, 190.0])  # over the piece: the organ does not reach it
    facets = np.stack([lid, *content.plan.facets[:others]])
    hold = content.motions.stages[2].joints_rad[-1]
    before = replace(content.plan, facets=facets)
    made = worker(LOCATED, hold, ResectionProgress(True, 0), before)
    assert made.plan.facets[:, 2].max() < 0.5
    assert made.motions.stages[0].name == "sweep 1"
    with pytest.raises(NoPlan):
        worker(LOCATED, hold, ResectionProgress(True, 1), before)


def test_new_motions_are_checked_before_anything_moves(content, worker, monkeypatch):
    """A planner that is wrong about where the tumor is, or where the arms are."""
    start = np.array(CONFIG.home_rad), ResectionProgress(), content.plan
    monkeypatch.setattr(procedure, "plan_motions", lambda *_: (content.plan, content.motions))
    made = worker(LOCATED, *start)
    assert made.motions is content.motions
    assert made.plan.least_mm == pytest.approx(content.plan.least_mm)
    nearer = lying(3.0 * content.plan.facets[0, :3], parts=("tumor_1",))
    with pytest.raises(NoPlan):
        worker(nearer, *start)
    base = msgspec.structs.replace(CONFIG.cutter_base, position_mm=(700.0, 0.0, 100.0))
    elsewhere = msgspec.structs.replace(CONFIG, cutter_base=base)
    monkeypatch.setattr(procedure, "_setting", [(PLANNING, elsewhere, cell_urdf(elsewhere))])
    with pytest.raises(NoPlan):
        worker(LOCATED, *start)


@pytest.mark.parametrize("left_mm", [2.0, -4.0])
def test_an_instrument_leaves_a_tumor_that_came_to_it_without_coming_nearer(
    content, worker, left_mm
):
    """Less than the margin is left, or nothing: the electrode is in the tumor."""
    joints_rad, cell = in_the_middle_of(content.motions, 2), ArmCell(CONFIG)
    standing = Motions((MotionStage("here", np.zeros(1), joints_rad[None], np.zeros(1, bool)),))
    (found, *_) = (
        one
        for one in clearances(URDF, standing, LOCATED.meshes, ())
        if (one.solid, one.part) == (ELECTRODE, "tumor_1")
    )
    tip = cell.tips(joints_rad)[CUTTER]
    off_mm = tip[:3, 3] - found.place_mm
    off_mm -= (off_mm @ tip[:3, 0]) * tip[:3, 0]
    towards = off_mm / np.linalg.norm(off_mm)
    by_mm = found.least_mm - left_mm + (ELECTRODE_RADIUS_MM if left_mm < 0 else 0.0)
    organ = lying(by_mm * towards, parts=("tumor_1",))
    made = worker(organ, joints_rad, ResectionProgress(True, 1), content.plan)
    withdraw = made.motions.stages[0]
    assert withdraw.name == Stage.WITHDRAW
    assert not withdraw.cutting.any()
    at_first, at_worst = distances(standing, organ), distances(Motions((withdraw,)), organ)
    assert at_first[ELECTRODE] == pytest.approx(left_mm, abs=0.2)
    for solid, mm in at_first.items():
        assert at_worst[solid] >= mm - 0.1  # paths are followed to 0.05 mm
    gone_mm = cell.tips(withdraw.joints_rad[-1])[CUTTER][:3, 3] - tip[:3, 3]
    assert np.cross(gone_mm, tip[:3, 0]) == pytest.approx(np.zeros(3), abs=0.1)  # straight back
    assert gone_mm @ tip[:3, 0] < -10
    assert made.plan.least_mm["tumor_1"] >= MARGIN_MM - TOLERANCE_MM


# For MoveIt ---------------------------------------------------------------------------------------


def test_a_plan_s_motions_are_trajectories_of_all_joints():
    messages, times = Messages(), np.array([0.0, 0.5, 1.25])
    joints = np.zeros((3, 12))
    joints[1:, 0], joints[:, 7] = [0.25, 1.0], 0.5
    still = MotionStage("hold", np.zeros(1), joints[:1], np.zeros(1, bool))
    moving = MotionStage("approach", times, joints, np.zeros(3, bool))
    written = json.loads(ros_trajectories(Motions((still, moving)), "table"))
    (stage,) = written["stages"]
    said = stage["trajectory"]["joint_trajectory"]
    points = [{**one, "positions": np.array(one["positions"]),
               "velocities": np.array(one["velocities"])} for one in said["points"]]  # fmt: skip
    message = messages.make(
        "moveit_msgs/msg/RobotTrajectory", joint_trajectory={**said, "points": points}
    )
    again = messages.from_bytes(messages.to_bytes(message), "moveit_msgs/msg/RobotTrajectory")
    trajectory = again.joint_trajectory
    assert (stage["name"], stage["seconds"]) == ("approach", 1.25)
    assert trajectory.joint_names == list(JOINTS)
    assert trajectory.header.frame_id == "table"
    np.testing.assert_allclose([one.positions for one in trajectory.points], joints, atol=1e-6)
    starts = [one.time_from_start.sec + 1e-9 * one.time_from_start.nanosec
              for one in trajectory.points]  # fmt: skip
    np.testing.assert_allclose(starts, times)
    assert [one.velocities[0] for one in trajectory.points] == [0, pytest.approx(0.7), 0]
