"""Boards, lenses, depth and hand-eye: known cameras are found again, and what is wrong is named."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from live_objects import small_frame
from refused import refused
from stories import refusal, succeeded, tumortrack
from tumortrack.core.camera import deproject
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import DepthFrame
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.io.depth_files import depth_png, intrinsics_json, read_depth_png
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.poses import pose_row
from tumortrack.live.values import Observation
from tumortrack_devices.recording.mcap import STRING, McapBag, camera_messages
from tumortrack_devices.ros.messages import Messages, Outgoing
from tumortrack_experiment.calibrate.board import Board, Corners, draw_board, find_boards
from tumortrack_experiment.calibrate.depth import PlaneErrors, depth_report
from tumortrack_experiment.calibrate.hand_eye import HandEyeData, solve
from tumortrack_experiment.calibrate.lens import Lens, fit_lens
from tumortrack_experiment.calibrate.pictures import read_shots, with_poses
from tumortrack_experiment.calibrate.virtual_board import (
    board_depth_mm,
    board_picture,
    looks_at_board,
)
from tumortrack_experiment.record.read import IMAGE, STATE, WHOLE

BOARD = Board(columns=7, rows=5, square_mm=24.0)
OPTIONS = ["--squares", 7, 5, "--square-mm", 24]
LENS = Lens(
    width=424, height=240, fx=223.0, fy=224.0, cx=210.5, cy=121.0,
    distortion=(-0.03, 0.04, 0.0005, -0.0003, 0.0),
)  # fmt: skip
STRAIGHT = Lens(width=424, height=240, fx=223.0, fy=224.0, cx=210.5, cy=121.0)
CAMERA_AT = rigid(Rotation.from_rotvec([0.1, -0.2, 0.4]).as_matrix(), np.array([12.0, -30, 65]))
BOARD_AT = rigid(Rotation.from_rotvec([np.pi, 0.1, 0]).as_matrix(), np.array([400.0, 60, 15]))
ORGAN = np.array([[0.0, 0, 150], [40, 0, 150], [0, -40, 150]])


def corners_of(look, lens, rng, deviation_px=0.08):
    """What a picture shows of the board's corners, without making the picture."""
    on_mm = np.array(BOARD.charuco().getChessboardCorners(), float)
    turn = cv2.Rodrigues(look[:3, :3])[0]
    pixels = cv2.projectPoints(on_mm, turn, look[:3, 3], *lens.opencv)[0].reshape(-1, 2)
    shown = ((pixels > 3) & (pixels < [lens.width - 4, lens.height - 4])).all(1)
    return Corners(on_mm[shown], pixels[shown] + rng.normal(0, deviation_px, (shown.sum(), 2)))


def robot_views(count, rng, tilt_degrees=35.0, off_mm=0.05, off_degrees=0.02):
    """``base_from_tool``, as a robot that errs says it, and ``camera_from_board``."""
    looks = looks_at_board(BOARD, count, rng, (130, 250), tilt_degrees)
    exact = [BOARD_AT @ np.linalg.inv(look) @ np.linalg.inv(CAMERA_AT) for look in looks]
    turns = Rotation.from_rotvec(np.radians(rng.normal(0, off_degrees, (count, 3)))).as_matrix()
    said = [
        one @ rigid(turn, rng.normal(0, off_mm, 3)) for one, turn in zip(exact, turns, strict=True)
    ]
    return np.array(said), looks


def off_mm(found):
    """At the organ."""
    return np.linalg.norm(
        transform_points(found, ORGAN) - transform_points(CAMERA_AT, ORGAN), axis=1
    ).max()


def test_the_printed_board_is_found_and_has_its_true_size(tmp_path):
    draw_board(Board(columns=5, rows=4, square_mm=20.0), tmp_path / "board.png")
    page = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    page = cv2.resize(page, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    (seen,) = find_boards([page], Board(columns=5, rows=4, square_mm=20.0))
    assert len(seen.pixels) == 12  # all corners between four squares
    pixels_per_mm = 150 / 25.4
    turn, *_ = np.linalg.lstsq(
        np.column_stack([seen.board_mm[:, :2], np.ones(12)]), seen.pixels, rcond=None
    )
    np.testing.assert_allclose(turn[:2] / pixels_per_mm, np.eye(2), atol=0.001)


def test_a_camera_is_found_again_with_its_depth_errors(tmp_path):
    rng = np.random.default_rng(0)
    device = {**intrinsics_json(STRAIGHT.camera), "fx": 225.0, "fy": 225.0}
    for n, look in enumerate(looks_at_board(BOARD, 12, rng, (75, 190))):
        true_mm = board_depth_mm(BOARD, STRAIGHT, look)
        grey = board_picture(BOARD, STRAIGHT, look, rng)
        for moment in "ab":
            folder = tmp_path / "seen" / f"{n:02d}{moment}"
            folder.mkdir(parents=True)
            noisy_mm = true_mm * 1.015 - 1.2 + rng.normal(0, 0.3, true_mm.shape)
            frame = DepthFrame(noisy_mm.astype(np.float32), STRAIGHT.camera)
            cv2.imwrite(str(folder / "infrared.png"), grey)
            (folder / "depth.png").write_bytes(depth_png(frame, compress_level=1))
            (folder / "intrinsics.json").write_text(json.dumps(device))
    out = tmp_path / "camera"
    told = succeeded(tumortrack("calibrate", "camera", tmp_path / "seen", out, *OPTIONS))
    said = json.loads((out / "report.json").read_text())
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(said["lens"][name] - getattr(STRAIGHT, name)) < 4 * said["std_px"][name] < 1
    depth = said["depth"]
    assert abs(depth["scale"] - 0.015) < 4 * depth["scale_std"] < 0.006
    assert abs(depth["offset_mm"] + 1.2) < 4 * depth["offset_std_mm"] < 0.4
    assert depth["poses"] == depth["images"] / 2 >= 10
    assert not depth["inside_training"]
    assert "OUTSIDE" in told
    row = depth["by_distance"][-1]
    assert row["noise_mm"] == pytest.approx(0.3, rel=0.1)
    assert row["flatness_mm"] == pytest.approx(0.3, rel=0.1)
    assert said["device_off_mm"]["rms"] > 0.3
    # What was recorded comes out true through the file that was written.
    again = read_depth_png(folder / "depth.png", out / "intrinsics.json")
    error_mm = np.nanmedian(again.depth_mm - true_mm)
    assert abs(error_mm) < depth["left_mm"] < 0.7
    level = transform_points(np.linalg.inv(look), deproject(again).astype(float))
    assert abs(np.median(level[:, 2])) < 0.4  # on the board


@pytest.mark.parametrize(("lens", "model"), [(STRAIGHT, "none"), (LENS, "k1 k2 p1 p2")])
def test_distortion_is_fitted_only_where_there_is_any(lens, model):
    rng = np.random.default_rng(1)
    seen = {
        n: corners_of(look, lens, rng)
        for n, look in enumerate(looks_at_board(BOARD, 24, rng, (75, 190)))
    }
    fit = fit_lens(seen, list(map(str, seen)), (424, 240))
    assert fit.said["model"] in (model, "none" if model == "none" else "k1 k2 p1 p2 k3")
    assert any("not rectified" in one for one in fit.warnings) == (lens is LENS)
    assert abs(fit.lens.fx / 223 - 1) < 4 * fit.lens.focal_std < 0.01


def test_the_stated_bound_holds():
    rng, within = np.random.default_rng(2), []
    for _ in range(3):
        poses, looks = robot_views(10, rng)
        places = [LENS.place(corners_of(look, LENS, rng))[0] for look in looks]
        data = HandEyeData(poses, np.array(places))
        found, said, _ = solve(data, list(map(str, range(10))), 150.0, 1e-4)
        within.append(off_mm(found) <= said["bound_mm"] < 1.5)
    assert all(within)  # 95 % are promised


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    """Pictures of the board by a camera on a tool, and the tool's poses."""
    rng = np.random.default_rng(3)
    poses, looks = robot_views(9, rng)
    tmp_path = tmp_path_factory.mktemp("hand")
    (tmp_path / "seen").mkdir()
    for n, look in enumerate(looks):
        picture = board_picture(BOARD, LENS, look, rng)
        cv2.imwrite(str(tmp_path / "seen" / f"{1000000000000 + n}.png"), picture)
    (tmp_path / "lens.json").write_text(json.dumps(to_builtins(LENS) | {"focal_std": 1e-4}))
    write_poses(tmp_path / "poses.json", poses)
    return tmp_path, poses


def write_poses(path, poses, **more):
    content = {"base_from_tool": poses.tolist(), "unit": "mm", "frame_id": "base", **more}
    path.write_text(json.dumps(content))


def test_hand_eye_as_a_user_does_it(hand):
    folder, poses = hand
    lens = ["--lens", folder / "lens.json", *OPTIONS]
    out = folder / "in_hand"
    command = ["calibrate", "hand-eye", folder / "seen", out, *lens]
    succeeded(tumortrack(*command, "--poses", folder / "poses.json"))
    frame = read_frames(out / "calibration.json", moves=True)
    assert off_mm(frame.published_from_camera) < frame.error_at(150.0) < 1.5
    said = json.loads((out / "report.json").read_text())
    assert said["bound_mm"] <= frame.error_at(150.0) < 1.2 * said["bound_mm"]
    # Turned round, the same pictures are those of a board on the tool before a camera that stands.
    write_poses(folder / "turned.json", np.linalg.inv(poses))
    inverted = refusal(
        tumortrack(*command[:3], folder / "x", *lens, "--poses", folder / "turned.json")
    )
    assert "inverted they do" in inverted
    assert not (folder / "x").exists()
    still = [*command[:3], folder / "to_hand", *lens, "--eye-to-hand"]
    succeeded(tumortrack(*still, "--poses", folder / "turned.json"))
    again = read_frames(folder / "to_hand" / "calibration.json")
    np.testing.assert_allclose(again.published_from_camera, frame.published_from_camera, atol=1e-6)


def test_poses_come_by_stamps_from_a_table_and_in_order_from_json(hand):
    folder, poses = hand
    shots = read_shots(folder / "seen")
    rows = [pose_row(shot.stamp_ns, "base", pose) for shot, pose in zip(shots, poses, strict=True)]
    (folder / "poses.csv").write_text(COLUMNS + "\n" + "".join(rows))
    for name in ("poses.csv", "poses.json"):
        frame_id, posed = with_poses(shots, folder / name)
        assert frame_id == "base"
        np.testing.assert_allclose([shot.base_from_tool for shot in posed], poses, atol=1e-6)
    (folder / "poses.csv").write_text(COLUMNS + "\n" + "".join(rows[:-1]))
    with refused(InputError, 1000000000008):
        with_poses(shots, folder / "poses.csv")
    write_poses(folder / "fewer.json", poses[:-1])
    with refused(InputError, 8, 9):
        with_poses(shots, folder / "fewer.json")
    with refused(InputError, folder / "seen"):
        with_poses(shots, folder / "seen")


def test_a_recording_gives_pictures_depth_and_the_tool_by_state(tmp_path):
    messages, rng = Messages(), np.random.default_rng(4)
    bag, sent = McapBag(tmp_path / "bag", messages, ""), {}
    for n in range(6):
        grey = rng.integers(0, 256, (48, 64)).astype(np.uint8)
        pose = rigid(np.eye(3), np.array([n, 20.0, 300]))
        frame = small_frame(10**18 + n * 10**7)
        out = camera_messages(Observation(frame, 10**18 + n, picture=grey), pose, "base", messages)
        if n % 3 == 0:
            out.append(Outgoing(STATE, STRING, messages.make(STRING, data=f"p{n}")))
        bag.write(10**18 + n, sorted(out, key=lambda one: one.suffix == IMAGE))
        sent[n] = grey
    bag.close()
    (tmp_path / "bag" / "bag.mcap").rename(tmp_path / WHOLE)
    (tmp_path / "recording.json").write_text(json.dumps({"frame_id": "base"}))
    frame_id, shots = with_poses(read_shots(tmp_path), tmp_path)
    assert frame_id == "base"
    assert [shot.name for shot in shots] == ["p0", "p0", "p3", "p3"]
    for shot, n in zip(shots, (0, 1, 3, 4), strict=True):
        np.testing.assert_array_equal(shot.grey, sent[n])
        np.testing.assert_allclose(shot.base_from_tool[:3, 3], [n, 20, 300], atol=1e-6)
        np.testing.assert_allclose(shot.depth.depth_mm, small_frame().depth_mm, rtol=1e-6)


def faulty(poses, looks, fault):
    """What a user may give by mistake, and a number or option that is named for it."""
    rng = np.random.default_rng(5)
    if fault == "metres":
        poses = poses.copy()
        poses[:, :3, 3] /= 1000
        return poses, looks, ""
    if fault == "few":
        return poses[:7], looks[:7], "7"
    if fault == "order":
        return poses[::-1], looks, ""
    if fault == "size":
        larger = [rigid(look[:3, :3], look[:3, 3] * 1.1) for look in looks]
        return poses, larger, "square_mm="
    about = Rotation.from_rotvec(np.outer(rng.uniform(-0.6, 0.6, len(poses)), [0, 0, 1]))
    if fault == "small":
        about = Rotation.from_rotvec(rng.normal(0, 0.02, (len(poses), 3)))
    shifts = rng.normal(0, 40, (len(poses), 3))
    poses = [rigid(t, s) for t, s in zip(about.as_matrix(), shifts, strict=True)]
    from_board = [np.linalg.inv(pose @ CAMERA_AT) @ BOARD_AT for pose in poses]
    return np.array(poses), from_board, "20 degrees"


@pytest.mark.parametrize("fault", ["metres", "few", "order", "size", "one axis", "small"])
def test_poses_that_do_not_determine_the_camera_are_refused_with_what_to_do(fault):
    poses, looks, named = faulty(*robot_views(12, np.random.default_rng(6)), fault)
    data = HandEyeData(poses, np.array(looks))
    with refused(InputError, named):
        solve(data, list(map(str, range(len(looks)))), 150.0)


def test_a_picture_of_another_moment_is_named_and_left_out():
    poses, looks = robot_views(14, np.random.default_rng(7))
    poses[5] = poses[5] @ rigid(np.eye(3), np.array([0, 6.0, 0]))
    names = [f"shot_{n}" for n in range(14)]
    found, said, warnings = solve(HandEyeData(poses, np.array(looks)), names, 150.0, 1e-4)
    assert said["left_out"] == ["shot_5"]
    assert any(one.startswith("shot_5 left out") for one in warnings)
    assert off_mm(found) < said["bound_mm"] < 0.8


def test_a_board_that_is_not_there_mirrored_or_another_one_is_told_apart():
    look = looks_at_board(BOARD, 2, np.random.default_rng(8), (150, 151), 20)[0]
    picture = board_picture(BOARD, LENS, look, np.random.default_rng(9))
    said = set()
    for picture_, board in (
        (np.full((240, 424), 90, np.uint8), BOARD),
        (np.ascontiguousarray(picture[:, ::-1]), BOARD),
        (picture, Board(columns=6, rows=5, square_mm=24.0)),
    ):
        with pytest.raises(InputError) as raised:
            find_boards([picture_], board)
        said.add(str(raised.value))
    assert len(said) == 3


def test_folders_without_usable_pictures_are_refused(tmp_path):
    with refused(InputError, tmp_path):
        read_shots(tmp_path)
    (tmp_path / "a.png").write_bytes(b"\x89PNG not really")
    with refused(InputError, "a.png"):
        read_shots(tmp_path)
    for name, shape in (("a", (20, 30)), ("b", (21, 30))):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros(shape, np.uint8))
    with refused(InputError, "30 x 20", "30 x 21"):
        read_shots(tmp_path)


def test_too_few_flat_or_wrongly_sized_boards_are_refused():
    rng, names = np.random.default_rng(10), list(map(str, range(12)))
    level = {n: corners_of(look, LENS, rng) for n, look in enumerate(
        rigid(np.eye(3), np.array([-60.0, -45, z])) for z in np.linspace(100, 190, 12)
    )}  # fmt: skip
    with refused(InputError, 7):
        fit_lens({n: level[n] for n in range(7)}, names, (424, 240))
    with pytest.raises(InputError):
        fit_lens(level, names, (424, 240))
    far = [
        PlaneErrors(np.arange(600), np.full(600, 0.1 * z), np.full(600, float(z)), n)
        for n, z in enumerate((80, 120, 160))
    ]
    with refused(InputError, "1.10", "square_mm="):
        depth_report(far, LENS)


def test_depth_over_a_narrow_range_is_not_corrected():
    planes = [
        PlaneErrors(np.arange(600), np.full(600, 1.0), np.full(600, 140.0 + n), n)
        for n in range(12)
    ]
    said, warnings = depth_report(planes, LENS)
    assert (said["corrected"], said["error_mm"]) == (False, pytest.approx(1.0))
    assert any("70 to 200 mm" in one for one in warnings)
