"""`inspect` in sentences, with units, of whatever commands write and read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from refused import refused
from tumortrack.core import store
from tumortrack.core.camera import d405
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack.io.depth_files import depth_png, intrinsics_json
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.ply import write_cloud_ply
from tumortrack.report.inspection import describe

PATIENT = {"id": "P1", "side": "left"}
PARTS = {
    "kidney": {"label": 1, "found": True, "volume_ml": 180.06, "center_mm": [1.0, -2.04, 150.0]},
    "tumor_1": {"label": 2, "found": False},
}  # fmt: skip
RUN = {
    "quality": {"verdict": "poor", "reason": "the fit is worse than usual; look from elsewhere"},
    "assessment": {"bounds": {"kidney": {"error_bound95_mm": 2.84}}, "factor": 1.25},
    "patient": PATIENT,
    "parts": PARTS,
}
GOOD = {**RUN, "quality": {"verdict": "good", "reason": ""},
        "assessment": {**RUN["assessment"], "finding": None}}  # fmt: skip
TRACK = {
    "patient": PATIENT, "source": "virtual:CASE", "seconds": 10.0, "updates": 200,
    "sinks": {"viewer": {"delivered": 199, "dropped": 1}},
    "estimates": {"good": 150, "poor": 30}, "no_estimate": 20,
    "reasons": {"no organ": 15, "the frame is # s old": 5}, "dropped": 3, "defects": [],
    "latency_ms": {"count": 200, "p50": 16.04, "p95": 30.0},
    "center_error_mm": {"tumor_1": {"count": 180, "p50": 1.2, "p95": 3.4}},
}  # fmt: skip
PLAN = {
    "table_from_camera": np.eye(4).tolist(), "patient": PATIENT, "seconds": 93.2,
    "plan": {"tumor": "tumor_1", "margin_mm": 9.0, "cuts": [], "notes": ["PLANNED OVER BUDGET"],
             "volumes_ml": {"tumor": 11.6, "piece": 30.0, "healthy": 18.4, "kerf": 2.5}},
    "budgets": [{"part": "tumor_1", "margin_mm": 8.9, "tracking_mm": 4.2}],
}  # fmt: skip
CALIBRATION = {"frame_id": "base", "unit": "mm", "robot_from_camera": [], "error_mm": 0.8}
CAMERA = {"width": 848, "height": 480, "fx": 433.0, "fy": 433.0, "cx": 424, "cy": 240,
          "depth_unit_mm": 0.1, "depth_scale": 1.01, "depth_offset_mm": -0.5}  # fmt: skip


def say(path: Path) -> str:
    """What is said of a file or folder; numbers have units and dicts are none of them."""
    said = "\n".join(describe(path))
    assert said.startswith(f"{path}: ")
    assert "{" not in said
    assert "[" not in said
    return said


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (RUN, ("`locate`", "poor", "(1.0, -2.0, 150.0) mm", "180.1 ml", "tumor_1")),
        (GOOD, ("good", "(1.0, -2.0, 150.0) mm", "2.8 mm", "1.25")),
        ({"quality": {"verdict": "none", "reason": "only 3 points"}, "input": []},
         ("`locate`", "none", "only 3 points")),
        (TRACK, ("200 updates", "10.0 s", "20.0", "75%", "15%", "10%", "15 of 200", "no organ",
                 "16.0 ms", "30.0 ms", "tumor_1", "1.2 mm", "viewer", "199")),
        ({"patient": PATIENT, "resection": {"state": "done", "halts": {"no estimate": 2}}},
         ("`resect`", "done", "2 x", "no estimate")),
        (PLAN, ("tumor_1", "11.6 ml", "30.0 ml", "8.9 mm", "4.2 mm", "18.4 ml", "93 s",
                "PLANNED OVER BUDGET")),
        (CALIBRATION, ("--frame", "base", "0.8 mm")),
        (CAMERA, ("848 x 480", "1.01", "-0.5 mm")),
    ],
)  # fmt: skip
def test_json_files_are_told_by_their_keys(content, told, tmp_path):
    path = tmp_path / "content.json"
    store.write_json(path, content)
    said = say(path)
    assert not [each for each in told if each not in said]


def test_folders_and_what_lies_in_them_are_told_with_their_numbers(phantom_case, tmp_path):
    for path, told in (
        (phantom_case, ("P1", "right")),
        (phantom_case / "labels.nii.gz", ("1.5 x 1.5 x 1.5 mm",)),
        (phantom_case / "kidney.ply", (" ml",)),
    ):
        assert not [each for each in told if each not in say(path)]
    write_cloud_ply(tmp_path / "cloud.ply", np.array([[0.0, 0, 100], [10, 20, 130]], np.float32))
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    (tmp_path / "meshes").mkdir()
    write_mesh(tmp_path / "meshes" / "kidney.ply", Mesh(corners, faces))
    frames, camera = tmp_path / "frames", d405(424, 240)
    frames.mkdir()
    depth_mm = np.full((240, 424), 150.0, np.float32)
    (frames / "1.png").write_bytes(depth_png(DepthFrame(depth_mm, camera)))
    store.write_json(frames / "intrinsics.json", intrinsics_json(camera))
    for name, told in {
        "cloud.ply": ("2 points", "10 x 20 x 30 mm", "(5, 10, 115) mm"),
        "meshes": ("(1)", "`tumortrack prepare`"),
        "meshes/kidney.ply": ("10 x 10 x 10 mm", "(5, 5, 5) mm", "0.2 ml"),
        "frames/1.png": ("424 x 240", "150 to 150 mm"),
        "frames": (f"recording:{frames}",),
    }.items():
        assert not [each for each in told if each not in say(tmp_path / name)]


def test_a_kind_of_another_distribution_is_told_by_what_it_states(tmp_path):
    with store.new_folder(tmp_path / "lens") as aside:
        (aside / "a.txt").write_text("a")
        content = {"report": "report.json", "states": ["D1"], "config": {"not": "inner"}}
        store.seal(aside, "lens", content, frame="camera")
    said = say(tmp_path / "lens")
    assert "report.json" in said
    assert "inner" not in said
    (tmp_path / "lens" / "a.txt").write_text("b")
    with refused(ArtifactError, "a.txt"):
        describe(tmp_path / "lens")


def test_what_lies_in_a_folder_says_what_it_is(tmp_path):
    told = set()
    for name in ("training", "patients.parquet", "scene.mrb", "twin.json"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
        told.add(say(tmp_path / name).replace(str(tmp_path / name), ""))
    assert len(told) == 4


def test_what_is_not_known_is_refused(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "other.json").write_text(json.dumps({"a": 1}))
    (tmp_path / "empty").mkdir()
    for name in ("notes.txt", "other.json", "empty", "nowhere"):
        with refused(InputError, tmp_path / name):
            describe(tmp_path / name)
