"""Calibration files: the robot's frame, and results in it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_objects import ASIDE, BASE, seen_at
from dvrk_files import CAMERA_FROM_BASE_M, dvrk, of_ecm, open_cv
from live_objects import STAMP_NS, small_update
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.cameras import camera_setup
from tumortrack.live.values import PublishedFrame

PSM2_OPEN_CV, PSM2_DVRK = (f"PSM2-registration-{axes}.json" for axes in ("open-cv", "dVRK"))
EYE = np.eye(4).tolist()


@pytest.fixture
def read(tmp_path):
    def written(**content):
        path = tmp_path / "hand_eye.json"
        path.write_text(json.dumps({"frame_id": "base_link", "unit": "mm", **content}))
        return read_frames(path)

    return written


def test_the_robots_frame_follows_from_any_of_three_files(read):
    marker = rigid(
        Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([10.0, 20, 300])
    )
    metres, camera_from_robot = BASE.copy(), np.linalg.inv(BASE)
    metres[:3, 3] /= 1000
    camera_from_robot[3] = [0, 0, 0, 1]  # the inverse leaves 1e-17 there; files have it exact
    for content in (
        {"camera_from_robot": camera_from_robot.tolist()},
        {"unit": "m", "robot_from_camera": metres.tolist()},
        {
            "camera_from_marker": marker.tolist(),
            "robot_from_marker": (BASE @ marker).tolist(),
        },
    ):
        frames = read(**content)
        assert (frames.frame_id, frames.calibrated) == ("base_link", True)
        np.testing.assert_allclose(frames.published_from_camera, BASE, atol=1e-9)


def test_a_calibration_names_the_camera_and_the_table(read):
    frames = read(
        unit="m",
        robot_from_camera=EYE,
        camera_frame_id="/left_optical",
        table_in_camera=[0, 0.6, -0.8, -0.18],
    )
    assert frames.camera_frame_id == "left_optical"
    assert frames.table_in_camera == pytest.approx((0, 0.6, -0.8, -180))


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"unit": "inch", "camera_from_robot": EYE},
        {"camera_from_robot": np.diag([1, 1, -1, 1.0]).tolist()},
        {"camera_from_robot": (2 * np.eye(4)).tolist()},
        {"camera_from_robot": np.eye(4)[:3].tolist()},
        {"camera_from_robot": np.eye(4).T[::-1].tolist()},
        {"camera_from_marker": EYE},
        {"camera_from_base": EYE},
        {"robot_from_camera": EYE, "frame_id": " "},
        {"robot_from_camera": EYE, "error_mm": 200},
        {"robot_from_camera": EYE, "error_deg": 1},
        {"robot_from_camera": EYE, "table_in_camera": [0, 0, -2, -0.18]},
        {"robot_from_camera": EYE, "table_in_camera": [0, 0, -1]},
        {"tool_from_camera": EYE},  # of a camera that moves
    ],
)
def test_a_wrong_calibration_is_refused(read, content):
    with refused(InputError, *(content.keys() & {"error_mm", "error_deg"} or ["hand_eye.json"])):
        read(**content)


def test_estimates_are_published_in_the_robots_frame():
    turn = rigid(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.array([1.0, 2, 3]))
    update = small_update(frames=PublishedFrame("base_link", turn))
    camera = update.estimate.cloud.points_mm
    expected = np.stack([camera[:, 2] + 1, camera[:, 1] + 2, -camera[:, 0] + 3], 1)
    np.testing.assert_allclose(update.transformed.points_mm, expected, atol=1e-4)
    mesh, moved = update.estimate.meshes["tumor_1"], update.transformed.meshes["tumor_1"]
    assert moved.volume_mm3 == pytest.approx(mesh.volume_mm3)
    assert moved.vertices_mm[0, 0] == pytest.approx(mesh.vertices_mm[0, 2] + 1)


def test_a_camera_on_a_tool_is_placed_by_its_calibration(tmp_path):
    tool, poses = tmp_path / "tool.json", tmp_path / "poses.csv"
    poses.write_text(f"{COLUMNS}\n{STAMP_NS},base,10,20,30,0,1,0,0\n")

    def setup(**content):
        tool.write_text(json.dumps({"frame_id": "base", "unit": "mm", **content}))
        return camera_setup(["virtual:x"], None, f"file:{poses}", tool)

    made = setup(tool_from_camera=ASIDE.tolist())
    tool_pose = rigid(np.diag([1.0, -1, -1]), np.array([10.0, 20, 30]))
    np.testing.assert_allclose(made.poses.at(seen_at(0)), tool_pose @ ASIDE, atol=1e-9)
    assert made.published.moves
    for wrong in (
        {"tool_from_camera": ASIDE.tolist(), "frame_id": "other"},
        {"robot_from_camera": ASIDE.tolist()},
    ):
        with pytest.raises(InputError):
            setup(**wrong)


@pytest.mark.parametrize(("name", "text"), [(PSM2_OPEN_CV, open_cv()), (PSM2_DVRK, dvrk())])
def test_both_files_of_a_dvrk_say_where_the_arms_base_is_before_the_camera(name, text, tmp_path):
    """In either, dVRK's own use of it: a place in the arm's base, m, to OpenCV's camera."""
    (tmp_path / name).write_text(text)
    frames = read_frames(tmp_path / name)
    assert (frames.frame_id, frames.camera_frame_id) == ("PSM2_base", "decklink_frame")
    base_m = np.array([0.02, -0.07, -0.11, 1.0])
    camera_mm = 1000 * (CAMERA_FROM_BASE_M @ base_m)[:3]
    there_mm = frames.published_from_camera @ [*camera_mm, 1.0]
    np.testing.assert_allclose(there_mm[:3], 1000 * base_m[:3], atol=1e-5)


def test_a_dvrks_file_is_refused_where_it_does_not_say_what_it_means(tmp_path):
    def refused_as(name, text, *data):
        (tmp_path / name).write_text(text)
        with refused(InputError, *data):
            read_frames(tmp_path / name)

    refused_as("PSM2_registration.json", open_cv(), "PSM2_registration.json")  # which axes?
    refused_as(PSM2_DVRK, of_ecm(), "ECM", PSM2_OPEN_CV)
    refused_as(PSM2_OPEN_CV, open_cv().replace("0.058", "58.0"), PSM2_OPEN_CV)  # mm
    refused_as(PSM2_OPEN_CV, open_cv().replace("0.6454", "0.9"), PSM2_OPEN_CV)
    refused_as(PSM2_OPEN_CV, open_cv().replace('"reference-frame"', '"x"'), PSM2_OPEN_CV)
    refused_as(PSM2_OPEN_CV, "{" + open_cv(), PSM2_OPEN_CV)
    (tmp_path / PSM2_OPEN_CV).write_text(open_cv("camera"))  # its messages named no frame
    assert read_frames(tmp_path / PSM2_OPEN_CV).camera_frame_id == ""
    with refused(InputError, "tool_from_camera"):
        read_frames(tmp_path / PSM2_OPEN_CV, moves=True)
