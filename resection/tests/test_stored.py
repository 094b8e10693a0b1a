"""Stored motions are not believed: what the planner would not have made is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from arm_objects import organ, plan
from plan_objects import RADIUS_MM, TUMOR_MM, located, sphere
from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, NoPlan
from tumortrack.live.values import PublishedFrame
from tumortrack_resection.arms import procedure
from tumortrack_resection.arms.cell import ArmCell, PlanningGroup
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.arms.kinematics import level_pose
from tumortrack_resection.arms.procedure import plan_motions
from tumortrack_resection.arms.trajectory import first_hit
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.files import PlanFolder, read_plan, write_plan
from tumortrack_resection.motions import CUTTER, JOINTS, Motions
from tumortrack_resection.operation import ResectionProgress
from tumortrack_resection.values import ResectionConfig

CONFIG = CellConfig()
FIRST, LAST = ("approach", "grasp", "hold"), ("lift", "release", "home")


@pytest.fixture(scope="module")
def content():
    motions = plan_motions(plan(), ArmCell(CONFIG, organ()), organ())
    meshes = {"kidney": organ(), "tumor_1": sphere(TUMOR_MM, RADIUS_MM)}
    return PlanFolder(
        plan(), ResectionConfig(), PublishedFrame("base"), meshes, ErrorBudget(margin_mm=5.0),
        CONFIG, motions, "c" * 64, "f" * 64, "e" * 64,
    )  # fmt: skip


@pytest.fixture(scope="module")
def stored(content, tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored") / "plan"
    write_plan(folder, content, {}, lambda _: None)
    return folder


def changed(stored, folder, tensors=None, plan_json=None):
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
    store.seal(folder, "plan", {}, "base")
    return folder


def test_a_plan_keeps_its_motions_and_where_its_frame_and_cell_come_from(content, stored, tmp_path):
    read = read_plan(stored)
    for one, other in zip(read.motions.stages, content.motions.stages, strict=True):
        assert np.array_equal(one.joints_rad, other.joints_rad)
    assert (read.frame_source, read.cell_source) == ("f" * 64, "e" * 64)
    assert (read.budget, read.cell) == (content.budget, CONFIG)


@pytest.mark.parametrize("lacking", ["frame_source", "cell_source", "budget", "patient", "cell"])
def test_a_plan_that_lacks_what_arms_are_judged_by_is_refused(stored, tmp_path, lacking):
    folder = changed(stored, tmp_path / "plan", plan_json=lambda data: data.pop(lacking))
    with pytest.raises(ArtifactError, match=f"lacks or spoils '{lacking}'; plan again"):
        read_plan(folder)


def test_motions_without_the_cell_that_they_are_for_are_refused(stored, tmp_path):
    folder = changed(stored, tmp_path / "plan", plan_json=lambda data: data.update(cell=None))
    with pytest.raises(ArtifactError, match="no cell that they are for"):
        read_plan(folder)


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
    ("change", "said"),
    [
        (put("1.joints_rad", np.nan), "grasp has times or joints that are no numbers"),
        (put("1.joints_rad", 3.0), "cutter_wrist_1_joint turns 9.* times as fast"),
        (put("1.joints_rad", 0.1), "times as fast as planned with in grasp"),
        (stretch(1e300), r"it takes 3\.\S+ s; allowed: 14400"),
        (stretch(1e3), "allowed: 14400"),
        (stretch(-1.0), "times must rise from 0"),
        (stretch(0.1), "times as fast"),
        (lambda a: a.update({n: v[:0] for n, v in a.items()}), "must match"),
        (turn, "cutter_elbow_joint turns beyond its limit in approach"),
        (shift, r"jumps by 0\.001 rad at sweep 1"),
        (rename(*FIRST, "sweep 2", "sweep 1", *LAST), "stages"),
        (rename(*FIRST, "sweep x", "sweep 2", *LAST), "stages"),
        (rename("approach"), "stages are approach"),
    ],
)
def test_motions_that_were_not_planned_so_are_refused_when_read(
    stored, tmp_path, unchecked, change, said
):
    folder = changed(stored, tmp_path / "plan", change)
    with pytest.raises(ArtifactError, match=f"(?i){said}.*Plan again"):
        read_plan(folder)


def test_what_would_be_refused_is_not_written(content, tmp_path):
    slow = [replace(stage, times_s=stage.times_s * 1000) for stage in content.motions.stages]
    with pytest.raises(NoPlan, match="allowed: 14400"):
        write_plan(
            tmp_path / "p", replace(content, motions=Motions(tuple(slow))), {}, lambda _: None
        )
    assert not (tmp_path / "p").exists()


def with_stage(motions, number, **changes):
    stages = list(motions.stages)
    stages[number] = replace(stages[number], **changes)
    return Motions(tuple(stages))


def test_collisions_are_looked_for_again_before_motions_are_carried_out(content):
    motions, cell = content.motions, ArmCell(CONFIG, organ())
    assert first_hit(motions, CONFIG, organ()) == ""
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
    assert "table" in first_hit(down, CONFIG, organ())
    # An organ, or arms, that were exchanged for others
    assert "organ" in first_hit(motions, CONFIG, organ((0.0, 0.0, 40.0)))
    base = msgspec.structs.replace(CONFIG.cutter_base, position_mm=(700.0, 0.0, 100.0))
    assert first_hit(motions, msgspec.structs.replace(CONFIG, cutter_base=base), organ())


def test_motions_planned_beside_the_live_loop_are_tested_for_collisions_too(content, monkeypatch):
    monkeypatch.setattr(procedure, "plan_motions", lambda *_, **__: content.motions)
    base = msgspec.structs.replace(CONFIG.cutter_base, position_mm=(700.0, 0.0, 100.0))
    elsewhere = msgspec.structs.replace(CONFIG, cutter_base=base)
    seen = replace(located(), meshes=content.meshes)
    call = seen, np.array(CONFIG.home_rad), ResectionProgress()
    monkeypatch.setattr(procedure, "_setting", [(ResectionConfig(), ArmCell(CONFIG))])
    assert procedure.replan(*call).motions is content.motions
    monkeypatch.setattr(procedure, "_setting", [(ResectionConfig(), ArmCell(elsewhere))])
    with pytest.raises(NoPlan, match="would meet"):
        procedure.replan(*call)


def test_the_electrode_goes_through_the_organ_only_as_slowly_as_it_cuts(content):
    sweep = content.motions.stages[3]
    hasty = with_stage(content.motions, 3, times_s=sweep.times_s * 0.8)
    assert "cutter/electrode would meet organ" in first_hit(hasty, CONFIG, organ())
