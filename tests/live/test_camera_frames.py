"""Frames of another camera, and a camera or table that moved, give no estimate."""

from __future__ import annotations

import json

import numpy as np
import pytest

from live_objects import STAMP_NS, small_frame
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.calibration_file import read_frames
from tumortrack.live.frames import UNNAMED, FrameCheck
from tumortrack.live.values import Observation, PublishedFrame
from tumortrack.sense.camera import d405, deproject
from tumortrack.sense.region import RegionConfig
from tumortrack.sense.region.watch import TableWatch

CAMERA = d405(424, 240)
CONFIG = RegionConfig()
V, U = np.mgrid[: CAMERA.height, : CAMERA.width]
RAY_X, RAY_Y = (U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy


def scene(n, off_mm=0.0, tilt_deg=0.0, slid_mm=0.0, hidden=0.0, hand=False) -> DepthFrame:
    """A table 180 mm away with D405-like noise, on it a bump that breathes, over it a hand; frame
    number ``n``. The camera is ``off_mm`` nearer and tilted; ``hidden``: this share of the rows is
    covered."""
    slope = np.tan(np.deg2rad(tilt_deg))
    z = (180 - off_mm) / (1 - slope * RAY_X)
    x, y = z * RAY_X - slid_mm - 6 * np.sin(n / 20), z * RAY_Y
    z = z - 40 * np.sqrt(np.clip(1 - (x / 45) ** 2 - (y / 30) ** 2, 0, None))
    if hand:
        at = 200 + 150 * np.sin(n / 25)
        z = np.where((np.abs(U - at) < 40) & (V < 150), z - 30, z)
    z[: round(hidden * len(z))] -= 50
    rng = np.random.default_rng(n)
    z = z + rng.normal(0, 0.3, z.shape) + rng.normal(0, 0.3)  # of pixels; of the whole frame
    return DepthFrame(z.astype(np.float32), CAMERA, STAMP_NS + n)


def after(frames, watch=None):
    """How many frames it took, and what was said then; None: nothing was."""
    watch = watch or TableWatch(CONFIG)
    for n, frame in enumerate(frames):
        try:
            watch.check(frame)
        except NoEstimate as error:
            return n, str(error), watch
    return None, "", watch


def still(count=40):
    return [scene(n) for n in range(count)]


# The table


def test_noise_a_breathing_organ_and_a_hand_are_no_motion_of_the_camera():
    count, _, watch = after([*still(), *(scene(n, hand=True) for n in range(40, 240))])
    assert count is None
    assert watch.table_in_camera == pytest.approx((0, 0, -1, -180), abs=0.6)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"off_mm": 2.0}, "2.0 mm off"),
        ({"off_mm": -3.0}, "3.0 mm off"),
        ({"off_mm": 40.0}, "40.0 mm off"),
        ({"tilt_deg": 1.5}, "1.5 degrees tilted"),
    ],
)
def test_a_camera_that_moved_is_noticed_within_half_a_second_and_for_good(how, said):
    moved = [scene(n, **how, hand=True) for n in range(40, 56)]
    count, text, watch = after([*still(), *moved])
    assert count is not None
    assert count < 55
    assert "moved since the start" in text
    number = float(said.split()[0])
    found = float(text.split(" mm off")[0].split()[-1])
    if "tilt" in said:
        found = float(text.split(" degrees")[0].split()[-1])
    assert found == pytest.approx(number, abs=0.5)
    with pytest.raises(NoEstimate, match="has moved"):
        watch.check(scene(99))  # back again, perhaps turned: who knows


def test_a_cloud_of_the_whole_scene_is_watched_too():
    def clouds(frames):
        return [SensorCloud(deproject(frame), frame.stamp_ns) for frame in frames]

    moved = [scene(n, off_mm=3.0) for n in range(40, 56)]
    count, text, _ = after(clouds([*still(), *moved]))
    assert count is not None
    assert "moved since the start" in text


def test_a_camera_that_is_meant_to_move_may():
    frames = [*still(), *(scene(n, off_mm=3.0) for n in range(40, 56))]
    for moves in (False, True):
        check = FrameCheck(PublishedFrame(calibrated=True, moves=moves), CONFIG, 0.0)
        seen = [Observation(frame, 0) for frame in frames]
        if moves:
            assert [check.check(one) for one in seen] == [""] * len(seen)
        else:
            with pytest.raises(NoEstimate, match="moved since"):
                [check.check(one) for one in seen]


def test_what_a_plane_cannot_show_is_not_noticed_and_said():
    check = FrameCheck(PublishedFrame(calibrated=True, camera_frame_id="c"), CONFIG, 0.25)
    for n in range(80):
        check.check(Observation(scene(n, slid_mm=0.0 if n < 40 else 10.0), 0, frame_id="c"))
    assert any("slides along it" in note for note in check.notes)
    organ = SensorCloud(small_frame().depth_mm[:, :3].copy())  # no table in it
    check = FrameCheck(PublishedFrame(calibrated=True), CONFIG, 0.25)
    for _ in range(40):
        check.check(Observation(organ, 0))
    assert any("no table is seen" in note for note in check.notes)


def test_a_table_that_is_seen_too_seldom_to_be_learned_is_none():
    watch = TableWatch(CONFIG)
    organ = np.where(np.hypot(RAY_X, RAY_Y) < 0.1, scene(0).depth_mm, np.nan).astype(np.float32)
    for n in range(70):
        watch.check(scene(n) if n < 10 else DepthFrame(organ, CAMERA, STAMP_NS + n))
    assert watch.blind
    for n in range(70, 90):  # there it is: it is learned as quickly as ever
        watch.check(scene(n))
    assert watch.table_in_camera is not None
    assert not watch.blind


def test_a_table_that_stays_hidden_is_doubted():
    watch = TableWatch(CONFIG)
    doubts = [watch.check(frame) for frame in still()]
    doubts += [watch.check(scene(n, hidden=0.8)) for n in range(40, 160)]
    assert not any(doubts[:100])
    assert "hidden" in doubts[-1]


def test_the_calibrations_table_counts_and_until_it_is_found_nothing_is_good():
    same, other = (0.0, 0.0, -1.0, -180.0), (0.0, 0.0, -1.0, -184.0)
    watch = TableWatch(CONFIG, same)
    assert "is not found" in watch.check(scene(0))
    assert after([scene(n) for n in range(1, 80)], watch)[0] is None
    assert watch.check(scene(81)) == ""
    count, text, _ = after(still(60), TableWatch(CONFIG, other))
    assert count is not None
    assert "moved since the calibration: the table lies" in text
    assert float(text.split(" mm off")[0].split()[-1]) == pytest.approx(4, abs=0.4)


def test_results_in_the_cameras_own_frame_let_the_camera_move():
    check = FrameCheck(PublishedFrame(), CONFIG, 0.25)
    for n in range(80):
        check.check(Observation(scene(n, off_mm=n / 4), 0))
    assert check.notes == []


# Names of frames


def seen(name: str | None) -> Observation:
    return Observation(small_frame(), 0, frame_id=name)


def test_frames_of_another_camera_give_no_estimate():
    check = FrameCheck(
        PublishedFrame("base", calibrated=True, camera_frame_id="left"), CONFIG, 0.25
    )
    assert check.check(seen("left")) == ""
    with pytest.raises(NoEstimate, match="in 'right', and the calibration is for 'left'"):
        check.check(seen("right"))
    with pytest.raises(NoEstimate, match="in '', and the calibration is for 'left'"):
        check.check(seen(""))  # a ROS message may leave it out
    assert check.check(seen("left")) == ""
    assert check.notes == []


@pytest.mark.parametrize("published", [PublishedFrame(), PublishedFrame("b", calibrated=True)])
def test_a_frame_that_changes_in_the_middle_gives_no_estimate(published):
    check = FrameCheck(published, CONFIG, 0.25)
    check.check(seen("a"))
    with pytest.raises(NoEstimate, match="changed from 'a' to 'b'"):
        check.check(seen("b"))
    with pytest.raises(NoEstimate, match="changed from 'a' to ''"):
        check.check(seen(""))
    assert check.notes == ([UNNAMED] if published.calibrated else [])


def test_what_nobody_checks_is_said_once():
    check = FrameCheck(PublishedFrame("b", calibrated=True, camera_frame_id="left"), CONFIG, 0.25)
    for _ in range(3):
        check.check(seen(None))
    assert len(check.notes) == 1
    assert "does not say whose frames" in check.notes[0]


def test_a_calibration_names_the_camera_and_the_table(tmp_path):
    path = tmp_path / "hand_eye.json"
    given = {
        "frame_id": "base",
        "unit": "m",
        "robot_from_camera": np.eye(4).tolist(),
        "camera_frame_id": "/left_optical",
        "table_in_camera": [0, 0.6, -0.8, -0.18],
    }
    path.write_text(json.dumps(given))
    frames = read_frames(path)
    assert (frames.calibrated, frames.camera_frame_id) == (True, "left_optical")
    assert frames.table_in_camera == pytest.approx((0, 0.6, -0.8, -180))
    for wrong in ([0, 0, -2, -0.18], [0, 0, -1]):
        path.write_text(json.dumps(given | {"table_in_camera": wrong}))
        with pytest.raises(InputError, match="table_in_camera"):
            read_frames(path)
