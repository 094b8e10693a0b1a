"""`tumortrack plan` and `tumortrack resect` as a user runs them."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from PIL import Image
from rosbags.highlevel import AnyReader
from safetensors import safe_open

import clients
from plan_objects import located, sphere
from refused import refused
from reports import bounded, poor, report_of
from ros2_objects import own_graph, process
from stories import (
    COMMAND,
    answered,
    cloud_by_rays,
    environment,
    looking_down,
    refusal,
    succeeded,
    tumortrack,
)
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.estimate import Estimate
from tumortrack.core.patient import Patient
from tumortrack.core.types import CameraLabels, OccupancyCloud
from tumortrack.io.case import load_case
from tumortrack.io.mesh_files import read_mesh, write_mesh
from tumortrack.io.ply import parse_ply_properties, write_cloud_ply
from tumortrack.io.run_folder import write_estimate
from tumortrack_devices.ros.messages import stamp_of
from tumortrack_resection import begin_plan, begin_resection, plan_resection
from tumortrack_resection.arms.body import cell_urdf
from tumortrack_resection.arms.cell import tip_places
from tumortrack_resection.files import read_plan
from tumortrack_resection.motions import JOINTS
from tumortrack_resection.values import CUTS_TUMOR, ELECTRODE, OVER_BUDGET, POOR_ESTIMATE, UNCHECKED

pytestmark = pytest.mark.slow

CRTK_PEER = Path(__file__).parents[2] / "devices" / "tests" / "support" / "crtk_peer.py"
WIDE = ("--margin", 8)
TUMOR = sphere((12.0, -14.0, 165.0), 12.0)  # half sunk in the organ's upper side
NEIGHBOUR = sphere((-21.0, -4.0, 168.0), 8.0)  # 14.6 mm beside it
BOUND_MM = 4.2  # of the tumors' error, by the estimate
ERRORS_MM = 2.0 + np.sqrt(BOUND_MM**2 + 2.0**2 + 3.0**2)  # motion; tracking, hand-eye and tool
CASE, WHOSE = "c" * 64, {"id": "P1", "side": "left"}
STATED = ("--patient", "P1", "--side", "left")
CAMERA_FROM_TABLE = np.array([[1.0, 0, 0, 5.0], [0, -1, 0, -8.0], [0, 0, -1, 300.0], [0, 0, 0, 1]])


def write_run(folder, tumors=(TUMOR,), doubt=None, **bounds_mm):
    """What `locate` would write of these tumors, the camera straight above."""
    organ = located(*tumors, n=20_000)
    camera = {
        name: mesh.with_vertices(
            mesh.vertices_mm @ CAMERA_FROM_TABLE[:3, :3].T + CAMERA_FROM_TABLE[:3, 3]
        )
        for name, mesh in organ.meshes.items()
    }
    points = organ.points_mm @ CAMERA_FROM_TABLE[:3, :3].T + CAMERA_FROM_TABLE[:3, 3]
    cloud = OccupancyCloud(points, organ.labels, np.ones(len(points)))
    volume = CameraLabels(np.ones((3, 3, 3), np.uint8), np.eye(4))
    parts = {
        name: {
            "volume_ml": mesh.volume_ml,
            "center_mm": mesh.box_mm.mean(0).tolist(),
            "box_mm": mesh.box_mm.tolist(),
        }
        for name, mesh in camera.items()
    }
    estimate = bounded(Estimate(cloud, volume, camera, report_of(parts=parts)), **bounds_mm)
    estimate = estimate.assessed(finding=doubt)
    estimate = replace(estimate, patient=Patient(**WHOSE))
    write_estimate(folder, estimate, about={"model": {"case_sha256": CASE}})
    return organ


@pytest.fixture(scope="module")
def story(tmp_path_factory):
    """A run, and the plan that the command made of it."""
    folder = tmp_path_factory.mktemp("resect")
    write_run(folder / "run", tumor_1=BOUND_MM)
    output = succeeded(tumortrack("plan", folder / "run", folder / "plan", *WIDE))
    return folder, output


def test_a_plan_is_written_in_the_tables_frame(story):
    folder, output = story
    assert "tumor_1 (7" in output
    stored = read_plan(folder / "plan")
    assert stored.frames.frame_id == "table"
    # Straight above, 120 mm over the table by default, its middle over the origin.
    kidney = stored.meshes["kidney"]
    assert kidney.box_mm[0, 2] == pytest.approx(120, abs=0.01)
    assert kidney.box_mm.mean(0)[:2] == pytest.approx([0, 0], abs=0.01)
    assert stored.frames.published_from_camera[:3, :3] == pytest.approx(np.diag([1, -1, -1]))
    plan = stored.plan
    assert plan.volumes_ml["tumor"] == pytest.approx(4 / 3 * np.pi * 1.2**3, rel=0.06)
    assert plan.warnings == ()
    assert len(plan.facets) == plan.sweeps == len(plan.cuts)
    piece = read_mesh(folder / "plan" / "piece.ply")
    assert piece.volume_ml == pytest.approx(plan.volumes_ml["piece"], rel=0.05)
    assert (plan.facets[:, :3] @ piece.vertices_mm.T <= plan.facets[:, 3:] + 1e-3).all()
    table = parse_ply_properties(
        (folder / "plan" / "strokes.ply").read_bytes(),
        "strokes",
        ("x", "y", "z", "sweep", "stroke"),
    )
    assert table[-1, :3] == pytest.approx(plan.grasp_mm, abs=1e-3)
    assert len(table) == sum(len(cut.path_mm) for cut in plan.cuts) + 1
    assert table[0, :3] == pytest.approx(plan.cuts[0].path_mm[0], abs=1e-3)
    assert set(table[:, 4]) == set(range(len(plan.cuts) + 1))
    assert Image.open(folder / "plan" / "plan.png").width == 1200
    assert (folder / "plan" / "cell.urdf").read_text() == cell_urdf(stored.cell)
    stages = json.loads((folder / "plan" / "trajectories.json").read_text())["stages"]
    assert (stages[0]["name"], stages[-1]["name"]) == ("approach", "home")
    with safe_open(folder / "plan" / "motions.safetensors", "np") as tensors:
        assert json.loads(tensors.metadata()["joints"]) == list(JOINTS)


def test_a_distance_that_does_not_cover_the_errors_is_no_plan_unless_a_person_accepts_it(
    story, tmp_path
):
    folder, _ = story
    (budget,) = read_plan(folder / "plan").budgets
    assert budget.terms == pytest.approx(
        {"tracking": BOUND_MM, "hand-eye": 2.0, "tool": 3.0, "motion": 2.0, "lag": 0.0}
    )
    assert budget.sum_mm == pytest.approx(ERRORS_MM)
    assert set(budget.assumed) == {"hand-eye", "tool"}
    plan = ("plan", folder / "run", tmp_path / "plan", "--no-arms", "--overwrite")
    for more in ((), ("--moved", 0.5)):  # the paper's margin is too little for less motion, too
        done = tumortrack(*plan, *more)
        assert done.returncode == 3
        line = refusal(done)
        assert f"{ERRORS_MM - (1.5 if more else 0):.1f} mm" in line
        assert not (tmp_path / "plan").exists()
    enough_mm = re.search(r"([\d.]+) mm would cover", refusal(tumortrack(*plan)))
    assert enough_mm is not None
    succeeded(tumortrack(*plan, "--margin", enough_mm.group(1)))
    # From Python the same: the same table, the same errors.
    with pytest.raises(NoPlan):
        plan_resection(folder / "run")
    here = plan_resection(folder / "run", margin_mm=float(enough_mm.group(1)))
    stored = read_plan(tmp_path / "plan").plan
    assert here.grasp_mm == pytest.approx(stored.grasp_mm)
    assert here.facets == pytest.approx(stored.facets, abs=1e-4)
    assert set(here.notes) <= set(stored.notes)
    accepted = plan_resection(folder / "run", accept_budget=True)
    assert any(note.startswith(OVER_BUDGET) for note in accepted.warnings)
    shown = succeeded(tumortrack(*plan, "--accept-budget")).splitlines()
    warning = next(n for n, line in enumerate(shown) if line.startswith(f"WARNING: {OVER_BUDGET}"))
    assert warning < next(n for n, line in enumerate(shown) if line.startswith("tumor_1 ("))
    stored = read_plan(tmp_path / "plan")
    assert stored.budgets[0].tracking_mm == pytest.approx(BOUND_MM)
    assert stored.budgets[0].left_mm < 0
    assert any(note.startswith(OVER_BUDGET) for note in stored.plan.warnings)


def test_a_plan_that_comes_too_near_to_another_tumor_is_over_its_budget(tmp_path):
    """What is kept from the planned tumor covers all errors; there is no room beside it."""
    write_run(tmp_path / "run", (TUMOR, NEIGHBOUR), tumor_1=BOUND_MM, tumor_2=BOUND_MM)
    plan = ("plan", tmp_path / "run", tmp_path / "plan", "--no-arms", "--tumor", "tumor_1", *WIDE)
    plan = (*plan, "--keep-away", "tumor_2=2")
    done = tumortrack(*plan)
    assert done.returncode == 3
    assert "tumor_2" in refusal(done)
    assert not (tmp_path / "plan").exists()
    succeeded(tumortrack(*plan, "--accept-budget"))
    stored = read_plan(tmp_path / "plan")
    budgets = {budget.part: budget for budget in stored.budgets}
    assert list(budgets) == ["tumor_1", "tumor_2"]
    assert budgets["tumor_1"].left_mm > 0
    assert 2.0 <= budgets["tumor_2"].margin_mm < 4.5
    assert budgets["tumor_2"].left_mm < 0
    (over,) = (note for note in stored.plan.warnings if note.startswith(OVER_BUDGET))
    assert "tumor_2" in over
    assert stored.plan.taken == ("tumor_1",)
    assert stored.plan.keep_mm == {"tumor_2": 2.0}


def test_what_was_planned_without_arms_is_unchecked_and_not_carried_out(story, tmp_path):
    folder, _ = story
    plan = ("plan", folder / "run", tmp_path / "plan", "--no-arms", *WIDE)
    output = succeeded(tumortrack(*plan))
    assert f"WARNING: {UNCHECKED}" in output
    stored = read_plan(tmp_path / "plan")
    assert [note.startswith(UNCHECKED) for note in stored.plan.warnings] == [True]
    assert (stored.plan.clearances, stored.motions) == ((), None)
    for more in ((), ("--film", tmp_path / "film.gif"), ("ur:10.0.0.9",)):
        done = tumortrack("resect", tmp_path / "plan", *more)
        assert done.returncode == 2
        assert "--no-arms" in refusal(done)
    assert not (tmp_path / "film.gif").exists()


def test_no_option_makes_a_plan_of_motions_that_fail_the_check(story, monkeypatch):
    """A planner that believes to keep 10 mm where it keeps 8."""
    folder, _ = story
    stored = read_plan(folder / "plan")
    claimed = replace(stored.plan, margin_mm=10.0)
    monkeypatch.setattr(
        "tumortrack_resection.arms.procedure.search_bases",
        lambda *_, **__: (stored.cell, claimed, stored.motions, ""),
    )
    accepting = {"accept_poor": True, "accept_budget": True}
    planning = begin_plan(folder / "run", margin=10.0, **accepting)
    with pytest.raises(NoPlan):
        planning.with_motions()
    claimed = stored.plan
    made = begin_plan(folder / "run", margin=8.0).with_motions().content.plan
    assert made.least_mm == pytest.approx(stored.plan.least_mm)


@pytest.fixture(scope="module")
def published(story, given):
    """By the paper's method, with all that real arms ask for but that."""
    folder, _ = story
    command = ("plan", folder / "run", given / "published", "--frame", given / "frame.json")
    command += ("--cell", given / "cell.json", "--method", "published")
    assert tumortrack(*command).returncode == 3  # over its budget
    return given / "published", succeeded(tumortrack(*command, "--accept-budget"))


def test_the_papers_method_says_how_deep_it_cuts_the_tumor_and_moves_no_real_arm(published, given):
    folder, output = published
    stored = read_plan(folder)
    (deep_mm,) = (
        -one.least_mm
        for one in stored.plan.clearances
        if (one.solid, one.part) == (ELECTRODE, "tumor_1")
    )
    assert 5 < deep_mm < 12.1  # below the middle of a tumor of that radius
    (warning,) = (note for note in stored.plan.warnings if note.startswith(CUTS_TUMOR))
    assert f"{deep_mm:.1f} mm" in warning
    assert warning in output
    (budget,) = stored.budgets
    assert budget.margin_mm == -deep_mm
    assert begin_resection(folder).operation.summary()["resection"]["note"].startswith(CUTS_TUMOR)
    live = ("--live", given / "model", "realsense")
    done = tumortrack("resect", folder, REAL, *STATED, *live)
    assert missing(done) == {"method", "budget", "person"}


def test_a_plan_is_carried_out_and_recorded(story, tmp_path):
    folder, _ = story
    report = tmp_path / "report.json"
    output = succeeded(
        tumortrack(
            "resect", folder / "plan", f"recording:{tmp_path / 'seen'}", "--speed", 20,
            "--report", report,
        )
    )  # fmt: skip
    stages = [stage.name for stage in read_plan(folder / "plan").motions.stages]
    assert stages[:4] == ["approach", "grasp", "hold", "sweep 1"]
    assert stages[-3:] == ["lift", "release", "home"]
    lines = output.splitlines()
    assert lines[-1] == "done: both virtual arms are home."
    content = json.loads(report.read_text())["resection"]
    assert content["state"] == "done"
    assert content["halts"] == {}
    passed = [entry["state"] for entry in content["log"]]
    assert passed == [
        stage for stage in [*stages, "done"] if stage in passed
    ]  # short ones are missed
    assert {"approach", "sweep 1", "home", "done"} <= set(passed)
    assert (tmp_path / "seen").is_dir()


REAL = "ur:127.0.0.1?execute=true"  # where nothing answers
NEEDS = {
    "live": "--live MODEL SOURCE",
    "source": "a source that shows the present",
    "model": "a model that says which case",
    "plan": "a plan that says which case",
    "frame": "--frame FILE (this one's frame is invented)",
    "camera": "--frame FILE that has camera_frame_id",
    "cell": "--cell FILE that gives both bases",
    "good": "a plan made on a good estimate",
    "speed": "--speed up to 1, not 2",
    "method": "a plan of the method margin",
    "budget": "a plan whose distances cover its errors",
    "calibration": "the calibration's error (error_mm in the --frame file)",
    "tool": "the tools' error (tool_error_mm in the --cell file)",
    "unsure": "a plan on an estimate that knows how far off",
    "moved": "--moved as planned with, not 7",
    "person": "a person at a terminal",
    "stated": "--patient ID and --side, as you know them",
    "whose": "a plan that says whose organ it is",
    "model's": "a model that says whose organ it is",
}


def missing(done):
    line = refusal(done)
    assert "the arm at 127.0.0.1 may not move. It needs: " in line
    return {name for name, output in NEEDS.items() if output in line}


def model_of(folder, case, whose):
    folder.mkdir()
    about = {"provenance": {"case_sha256": case, "patient": whose}}
    (folder / "manifest.json").write_text(json.dumps(about))
    return folder


@pytest.fixture(scope="module")
def given(story, tmp_path_factory):
    """Plans in a robot's frame, with and without the arms' places; models of three cases."""
    folder, _ = story
    here, place = read_plan(folder / "plan"), tmp_path_factory.mktemp("given")
    rows = here.frames.published_from_camera.tolist()
    frame = {"frame_id": "base_link", "unit": "mm", "robot_from_camera": rows}
    (place / "unstated.json").write_text(json.dumps(frame))
    (place / "frame.json").write_text(json.dumps({**frame, "error_mm": 1.0, "error_deg": 0.2}))
    bases = {f"{arm}_base": to_builtins(here.cell.base(arm)) for arm in ("cutter", "holder")}
    (place / "cell.json").write_text(json.dumps({**bases, "tool_error_mm": 0.8}))
    (place / "empty.json").write_text("{}")
    for name, cell in (("plan", "cell"), ("anywhere", "empty")):
        command = ("plan", folder / "run", place / name, "--frame", place / "frame.json")
        succeeded(tumortrack(*command, "--cell", place / f"{cell}.json", *WIDE))
    for name, case in (("model", CASE), ("other", "d" * 64), ("unknown", "")):
        model_of(place / name, case, WHOSE)
    model_of(place / "nobody", CASE, None)
    for name, whose in (("patient", {**WHOSE, "id": "P2"}), ("side", {**WHOSE, "side": "right"})):
        model_of(place / name, CASE, whose)
    return place


def test_a_real_arm_moves_only_with_all_that_it_needs_and_nothing_is_connected_before(story, given):
    folder, _ = story
    plan = given / "plan"
    resect = lambda *rest: missing(tumortrack("resect", *rest))  # noqa: E731
    everything = resect(folder / "plan", REAL, "--speed", 2, "--moved", 7)
    unstated = {"calibration", "tool"}
    asked = {"live", "frame", "cell", "speed", "moved", "person", "stated"}
    assert everything == asked | unstated
    assert resect(given / "anywhere", REAL, *STATED) == {"live", "cell", "person", "tool"}
    for half in (STATED[:2], STATED[2:]):
        content = resect(given / "anywhere", REAL, *half)
        assert content == {"live", "cell", "person", "tool", "stated"}
    live = (plan, REAL, *STATED, "--live")
    assert resect(*live, given / "nobody", "realsense") == {"model's", "person"}
    for name in ("patient", "side"):
        assert f"{given / name} is of" in refusal(
            tumortrack("resect", *live, given / name, "ros2:/d")
        )
    assert resect(*live, given / "unknown", "realsense") == {"model", "person"}
    other = refusal(tumortrack("resect", *live, given / "other", "ros2:/depth"))
    assert "is of another case" in other
    assert resect(*live, given / "model", "ros2:/depth") == {"camera", "person"}
    for source in (f"virtual:{given}", "recording:seen", "realsense:seen.bag",
                   "realsense?device=seen.bag"):  # fmt: skip
        assert resect(*live, given / "model", source) == {"source", "person"}
    assert resect(*live, given / "model", "realsense") == {"person"}


@pytest.mark.parametrize(
    ("second", "once"),
    [
        ("ur:10.0.0.9?execute=true", False),  # two cutters: the default
        ("ur:127.0.0.1?execute=true&arm=holder", False),
        ("ur:10.0.0.9?execute=true&arm=holder", True),
        ("ur:10.0.0.9", True),  # which moves nothing
    ],
)
def test_no_two_real_arms_follow_one_arms_joints(given, second, once):
    live = ("--live", given / "model", "realsense")
    line = refusal(tumortrack("resect", given / "plan", REAL, second, *STATED, *live))
    assert ("each arm once, at an address of its own" not in line) == once
    assert "a person at a terminal" in line


def test_a_plan_over_its_budget_or_with_assumed_errors_moves_no_real_arm(story, given, tmp_path):
    folder, _ = story
    live = (REAL, *STATED, "--live", given / "model", "realsense")
    cell = ("--cell", given / "cell.json")
    for name, frame, margin in (("narrow", "frame", 5), ("unstated", "unstated", 8)):
        command = ("plan", folder / "run", tmp_path / name, "--frame", given / f"{frame}.json")
        succeeded(tumortrack(*command, *cell, "--margin", margin, "--accept-budget"))
    assert missing(tumortrack("resect", tmp_path / "narrow", *live)) == {"budget", "person"}
    path = tmp_path / "narrow" / "plan.json"
    data = json.loads(path.read_text())
    data["budgets"][0]["margin_mm"] = 20.0  # which the motions do not keep
    path.write_text(json.dumps(data))
    store.seal(path.parent, "plan", {}, "base_link")
    assert missing(tumortrack("resect", tmp_path / "narrow", *live)) == {"budget", "person"}
    assert missing(tumortrack("resect", tmp_path / "unstated", *live)) == {"calibration", "person"}
    # The error of the direction counts at the tumor's distance, about 180 mm.
    (stated,) = read_plan(given / "plan").budgets
    assert stated.hand_eye_mm == pytest.approx(1 + 180 * np.radians(0.2), abs=0.2)
    assert stated.tool_mm == pytest.approx(2.8)
    assert stated.assumed == ()


@pytest.fixture
def edited(given, tmp_path):
    """A copy of the plan with another plan.json, sealed again."""

    def made(**changes):
        plan = tmp_path / "plan"
        shutil.copytree(given / "plan", plan, dirs_exist_ok=True)
        data = json.loads((plan / "plan.json").read_text())
        (plan / "plan.json").write_text(json.dumps({**data, **changes}))
        store.seal(plan, "plan", {}, "base_link")
        return plan

    return made


def test_what_a_plan_does_not_say_moves_no_real_arm(given, edited):
    live = (REAL, *STATED, "--live", given / "model", "realsense")
    assert missing(tumortrack("resect", edited(case_sha256=""), *live)) == {"plan", "person"}
    # A tumor whose place is a guess, however far it is
    (stated,) = json.loads((given / "plan" / "plan.json").read_text())["budgets"]
    unsure = {**stated, "part": "tumor_2", "margin_mm": 40.0, "assumed": ["tracking"]}
    plan = edited(budgets=[stated, unsure])
    write_mesh(plan / "tumor_2.ply", sphere((-40.0, 10.0, 140.0), 3.0))
    store.seal(plan, "plan", {}, "base_link")
    assert missing(tumortrack("resect", plan, *live)) == {"unsure", "person"}


def test_a_ros_camera_moves_a_real_arm_only_if_the_calibration_names_its_frame(given, edited):
    live = ("--live", given / "model", "ros2:/depth", *STATED)
    assert "camera" in missing(tumortrack("resect", given / "plan", REAL, *live))
    plan = edited(camera_frame_id="left", table_in_camera=[0.0, 0.0, -1.0, -180.0])
    assert missing(tumortrack("resect", plan, REAL, *live)) == {"person"}
    frames = read_plan(plan).frames
    assert (frames.calibrated, frames.camera_frame_id) == (True, "left")
    assert frames.table_in_camera == (0.0, 0.0, -1.0, -180.0)


def test_a_plan_of_nobody_moves_no_real_arm_and_one_of_another_nothing(given, edited):
    plan = edited(patient={})  # nobody is known
    live = ("--live", given / "model", "realsense")
    assert missing(tumortrack("resect", plan, REAL, *live)) == {"whose", "stated", "person"}
    assert "is of patient unknown" in refusal(tumortrack("resect", plan, REAL, *STATED, *live))
    for stated in (("--patient", "P2"), ("--side", "right")):  # nor virtual ones
        line = refusal(tumortrack("resect", given / "plan", *stated))
        assert "is of patient P1, left side; you stated patient" in line
    for name in ("patient", "side"):
        line = refusal(tumortrack("resect", given / "plan", "--live", given / name, "virtual:x"))
        assert "is of patient P" in line
        assert "the plan of patient P1, left side" in line


def test_a_plan_on_a_poor_estimate_moves_no_real_arm(given, tmp_path):
    write_run(tmp_path / "run", doubt=poor("it lies elsewhere"), tumor_1=BOUND_MM)
    command = ("plan", tmp_path / "run", tmp_path / "plan", "--frame", given / "frame.json")
    command += ("--cell", given / "cell.json", "--accept-poor", *WIDE)
    assert f"{POOR_ESTIMATE}: it lies elsewhere" in succeeded(tumortrack(*command))
    live = ("--live", given / "model", "realsense")
    done = tumortrack("resect", tmp_path / "plan", REAL, *STATED, *live)
    assert missing(done) == {"good", "unsure", "person"}


@pytest.mark.parametrize("typed", ["127.0.0.1", "yes", ""])
def test_a_person_types_the_address_of_the_arm_that_will_move(given, typed):
    terminal, stdin = pty.openpty()
    os.write(terminal, b"127.0.0.1\n")  # before it is asked for: does not count
    sinks = (REAL, "ur:10.0.0.9?arm=holder", *STATED)
    arguments = ("resect", given / "plan", *sinks, "--live", given / "model", "realsense")
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)], stdin=stdin, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    assert process.stdout is not None
    output = ""
    while not output.endswith("to let it begin: "):
        letter = process.stdout.read(1)
        assert letter, process.communicate()  # it ended without a question
        output += letter
    os.write(terminal, f"{typed}\n".encode())
    rest, error = process.communicate(timeout=300)
    os.close(terminal)
    os.close(stdin)
    assert "The cutter at 127.0.0.1 is about to move: as soon as an estimate is good" in output
    assert "It cuts in patient P1, left side: is that who lies here?" in output
    assert ("127.0.0.1 was not confirmed" in error) == (typed != "127.0.0.1")
    dry = "DRY RUN of the holder at 10.0.0.9: it is not connected"
    assert rest.count(dry) == (2 if typed == "127.0.0.1" else 0)
    assert process.returncode == 2  # confirmed: the model has nothing but its case


def test_without_an_arm_it_is_a_dry_run_from_the_first_line_to_the_last(story, tmp_path):
    folder, _ = story
    output = succeeded(
        tumortrack(
            "resect", folder / "plan", "ur:10.0.0.9", "--speed", 20,
            "--report", tmp_path / "report.json",
        )
    )  # fmt: skip
    lines = output.splitlines()
    assert lines[0] == lines[-1] == "DRY RUN: no arm is connected"
    assert "done: nothing moved." in lines
    assert "home" not in output


def test_motions_that_were_edited_are_neither_carried_out_nor_filmed(story, tmp_path):
    """A table that stands higher than the one planned with: only the collision test can tell."""
    folder, _ = story
    plan, cell = tmp_path / "plan", read_plan(folder / "plan").cell
    shutil.copytree(folder / "plan", plan)
    data = json.loads((plan / "plan.json").read_text())
    data["cell"]["middle_mm"][2] += 100.0
    (plan / "plan.json").write_text(json.dumps(data))
    x, y, z = cell.middle_mm
    for middle_mm, met in (((x, y, z), False), ((x, y, z + 100.0), True)):
        higher = msgspec.structs.replace(cell, middle_mm=middle_mm)
        (plan / "cell.urdf").write_text(cell_urdf(higher))
        store.seal(plan, "plan", {}, "table")
        for more in ((), ("--film", tmp_path / "film.gif")):
            done = tumortrack("resect", plan, *more)
            assert done.returncode == 2
            assert ("would meet" in refusal(done)) == met


def test_ctrl_c_stops_the_arms_and_says_so(story, tmp_path):
    folder, _ = story
    report = tmp_path / "report.json"
    process = subprocess.Popen(
        [*COMMAND, "resect", str(folder / "plan"), "--report", str(report)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "grasp":
            break
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=300)
    assert process.returncode == 130
    assert output == "tumortrack: stopped.\n"
    content = json.loads(report.read_text())["resection"]
    assert content["state"] == "aborted"
    assert content["halted"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--margin", 40], "margin_mm"),
        (["--config", "CONFIG"], "margn"),
        (["--frame", "UP"], ""),
        (["--tumor", "tumor_4"], "tumor_4"),
        (["--cell", "NARROW"], "clearance_mm"),
        (["--cell", "CELL"], "legs"),
        (["--frame", "FRAME"], "camera_from_robot"),
        (["--cell", "LOOSE"], "tool_error_mm"),
        (["--moved", 0], "moved_mm"),
        (["--config", "SIGMAS"], "sigmas"),
    ],
)
def test_what_cannot_be_planned_is_said_in_one_line_and_nothing_is_written(
    story, tmp_path, arguments, named
):
    folder, _ = story
    frame = {"frame_id": "base", "unit": "mm"}
    for name, content in {
        "CELL": {"legs": 4}, "FRAME": frame, "LOOSE": {"tool_error_mm": -1},
        "NARROW": {"clearance_mm": -8}, "CONFIG": {"margn": 4}, "SIGMAS": {"sigmas": 2},
        "UP": {**frame, "robot_from_camera": np.eye(4).tolist()},
    }.items():  # fmt: skip
        (tmp_path / name).write_text(json.dumps(content))
    arguments = [tmp_path / a if str(a).isupper() else a for a in arguments]
    done = tumortrack("plan", folder / "run", tmp_path / "plan", *arguments)
    assert named in refusal(done)
    assert not (tmp_path / "plan").exists()


def test_with_a_calibration_plan_and_arms_are_in_the_robots_frame(story, tmp_path):
    """The same cell in another frame has the same motions."""
    folder, _ = story
    here = read_plan(folder / "plan")
    robot_from_table = np.eye(4)
    robot_from_table[:3, :3] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]
    robot_from_table[:3, 3] = [430.0, -120.0, -60.0]
    frame, cell = tmp_path / "frame.json", tmp_path / "cell.json"
    rows = (robot_from_table @ here.frames.published_from_camera).tolist()
    frame.write_text(json.dumps({"frame_id": "base_link", "unit": "mm", "robot_from_camera": rows}))
    done = tumortrack("plan", folder / "run", tmp_path / "plan", "--frame", frame)
    assert "where do the arms stand" in refusal(done)
    bases = {}
    for arm in ("cutter", "holder"):
        base = here.cell.base(arm)
        place = robot_from_table @ [*base.position_mm, 1.0]
        bases[f"{arm}_base"] = {"position_mm": place[:3].tolist(), "yaw_deg": base.yaw_deg + 90.0}
    cell.write_text(json.dumps(bases))
    command = ("plan", folder / "run", tmp_path / "plan", "--frame", frame, "--cell", cell)
    succeeded(tumortrack(*command, *WIDE))
    there = read_plan(tmp_path / "plan")
    assert there.frames.frame_id == "base_link"
    expected = robot_from_table @ [*here.plan.grasp_mm, 1.0]
    assert there.plan.grasp_mm == pytest.approx(expected[:3], abs=1.6)
    assert there.cell.middle_mm == pytest.approx(robot_from_table[:3, 3].tolist(), abs=1.5)
    assert there.motions.stages[0].joints_rad[0] == pytest.approx(
        here.motions.stages[0].joints_rad[0]
    )
    assert there.motions.seconds == pytest.approx(here.motions.seconds, rel=0.3)


@pytest.mark.parametrize(
    ("method", "warned"), [("published", (CUTS_TUMOR, OVER_BUDGET)), ("margin", (OVER_BUDGET,))]
)
def test_a_live_world_that_lies_elsewhere_is_planned_anew_and_cut(
    phantom_case, elastic_model, tmp_path, method, warned
):
    case = load_case(phantom_case)
    cloud = cloud_by_rays(case, looking_down(case))
    write_cloud_ply(tmp_path / "cloud.ply", cloud)
    answered(
        tumortrack(
            "locate", elastic_model, tmp_path / "cloud.ply", "--out", tmp_path / "run", "--grid", 32
        )
    )
    command = ("plan", tmp_path / "run", tmp_path / "plan", "--method", method)
    succeeded(tumortrack(*command, "--accept-poor", "--accept-budget"))
    world = f"virtual:{phantom_case}?breathing=false&instrument=false&camera_motion=false&fps=10"
    report, seen = tmp_path / "report.json", tmp_path / "seen"
    with own_graph(), ExitStack() as running:
        peer = sys.executable, CRTK_PEER, "simulator"
        environment = clients.environment("ros-jazzy-rclpy")
        simulator = running.enter_context(process(*peer, environment=environment))
        simulator.line()
        sinks = "crtk:/PSM1?simulator=true&via=dds", f"recording:{seen}"
        output = succeeded(
            tumortrack(
                "resect", tmp_path / "plan", *sinks, "--live", elastic_model, world, "--speed", 10,
                "--report", report,
            )
        )  # fmt: skip
        end = read_plan(tmp_path / "plan").motions.stages[-1].joints_rad[-1, :6]
        tip_mm = tip_places(read_plan(tmp_path / "plan").cell)
        off_mm: list[float] = []

        def home_again(said):
            off_mm.append(float(np.linalg.norm(place_of(said) - tip_mm("cutter", end))))
            return off_mm[-1] < 1e-3 and max(off_mm) > 50

        heard = simulator.lines_until(home_again)
    follows_the_arm(heard, seen, tip_mm)
    assert "done: both virtual arms are home." in output
    content = json.loads(report.read_text())
    passed = content["resection"]["log"]
    assert passed[-1]["state"] == "done"
    note = content["resection"]["note"]
    for warning in warned:  # what the plan warned of stays
        assert warning in note
    assert any(entry.get("event") == "planned anew" for entry in passed)
    assert any("has moved by" in halt for halt in content["resection"]["halts"])
    assert content["frame"]["frame_id"] == "table"
    budgets = content["resection"]["budget"]
    assert budgets["worst"]["left_mm"] < 0  # accepted when it was planned
    assert budgets["worst"]["tracking_mm"] > 0


def test_a_model_that_cannot_know_what_is_cut_is_refused_before_anything_moves(
    quick_model, phantom_case, tmp_path, monkeypatch
):
    monkeypatch.setitem(WHOSE, "side", "right")
    monkeypatch.setitem(globals(), "CASE", store.sha256_of(phantom_case / store.MANIFEST))
    write_run(tmp_path / "run", tumor_1=BOUND_MM)
    succeeded(tumortrack("plan", tmp_path / "run", tmp_path / "plan", *WIDE))
    live = quick_model, f"virtual:{phantom_case}"
    resection = begin_resection(tmp_path / "plan", live=live)
    with refused(InputError, quick_model), resection.following():
        pass


def place_of(said):
    return np.array(said["matrix"])[:3, 3]


BEFORE_ALL_IS_CUT = "approach", "grasp", "hold", "pull", "taut", "sweep"


def follows_the_arm(heard, recording, tip_mm):
    """A simulator was sent where the tip is by the joints of the same moment, in good results that
    do not halt the arms, or on their way home once all is cut, and in no others."""
    with AnyReader([recording]) as reader:
        wanted = {"/tumortrack/joint_states": {}, "/tumortrack/diagnostics": {}}
        connections = [c for c in reader.connections if c.topic in wanted]
        for connection, _, raw in reader.messages(connections):
            message = reader.deserialize(raw, connection.msgtype)
            wanted[connection.topic][stamp_of(message.header)] = message
    joints, states = wanted.values()
    for said in heard:
        at = joints[said["stamp_ns"]]
        joint = dict(zip(at.name, at.position, strict=True))
        own = np.array([joint[name] for name in JOINTS if name.startswith("cutter")])
        np.testing.assert_allclose(place_of(said), tip_mm("cutter", own), atol=1e-3)
        answer, arms = states[said["stamp_ns"]].status[:2]
        assert arms.level == 0
        assert answer.level == 0 or not any(word in arms.message for word in BEFORE_ALL_IS_CUT)
    stopped = sum(states[at].status[1].level > 0 for at in states)
    assert 10 < len(heard) <= len(states) - stopped
    assert stopped  # the world lies elsewhere


def test_from_python_too_a_real_arm_needs_the_live_loop_and_a_person(given, monkeypatch, unchecked):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("termios.tcflush", lambda *_: None)
    monkeypatch.setattr("builtins.input", lambda _: "yes")
    live = {"live": (given / "model", "realsense"), "patient": "P1", "side": "left"}
    resection = begin_resection(given / "plan", [REAL], **live)
    with pytest.raises(InputError):
        resection.opened().__enter__()
    with refused(InputError, "127.0.0.1"):
        resection.following().__enter__()
    with refused(InputError, "live=(MODEL, SOURCE)"):
        begin_resection(given / "plan", [REAL])
    with pytest.raises(InputError):
        begin_resection(given / "plan", [object()])
