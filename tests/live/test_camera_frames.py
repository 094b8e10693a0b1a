"""Frames of another camera, and a camera or table that moved, give no estimate."""

from __future__ import annotations

import numpy as np
import pytest

from live_objects import STAMP_NS, small_frame
from tumortrack.core.camera import d405, deproject
from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation, PublishedFrame
from tumortrack.live.views import FrameCheck
from tumortrack.segmentation import RegionConfig
from tumortrack.segmentation.watch import TableWatch

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


def still(count=40):
    return [scene(n) for n in range(count)]


def after(frames, watch=None):
    """How many frames it took, and the finding; None: all passed."""
    watch = watch or TableWatch(CONFIG)
    for n, frame in enumerate(frames):
        try:
            watch.check(frame)
        except NoEstimate as error:
            return n, error.finding
    return None


def test_noise_a_breathing_organ_and_a_hand_are_no_motion_of_the_camera():
    watch = TableWatch(CONFIG)
    assert after([*still(), *(scene(n, hand=True) for n in range(40, 240))], watch) is None
    assert watch.table_in_camera == pytest.approx((0, 0, -1, -180), abs=0.6)


@pytest.mark.parametrize(
    "how", [{"off_mm": 2.0}, {"off_mm": -3.0}, {"off_mm": 40.0}, {"tilt_deg": 1.5}]
)
@pytest.mark.parametrize("clouds", [False, True])
def test_a_camera_that_moved_is_noticed_within_half_a_second_and_for_good(how, clouds):
    frames = [*still(), *(scene(n, **how, hand=True) for n in range(40, 56)), scene(99)]
    if clouds:
        frames = [SensorCloud(deproject(frame), frame.stamp_ns) for frame in frames]
    watch = TableWatch(CONFIG)
    count, finding = after(frames, watch)
    assert 40 <= count < 55
    assert finding.kind == "moved"
    key = "degrees" if "tilt_deg" in how else "shift_mm"
    assert finding.values[key] == pytest.approx(abs(next(iter(how.values()))), abs=0.5)
    with pytest.raises(NoEstimate):
        watch.check(frames[-1])  # back again, perhaps turned: who knows


def test_the_table_is_watched_where_results_depend_on_the_cameras_pose():
    seen = [Observation(frame, 0) for frame in (*still(), *(scene(n, 3.0) for n in range(40, 56)))]
    for published in (PublishedFrame(), PublishedFrame(calibrated=True, moves=True)):
        check = FrameCheck(published, CONFIG, 0.0)
        assert [check.check(one) for one in seen] == [""] * len(seen)
    check = FrameCheck(PublishedFrame(calibrated=True), CONFIG, 0.0)
    with pytest.raises(NoEstimate):
        [check.check(one) for one in seen]


def test_what_a_plane_cannot_show_is_not_noticed_and_said():
    check = FrameCheck(PublishedFrame(calibrated=True, camera_frame_id="c"), CONFIG, 0.25)
    for n in range(80):
        check.check(Observation(scene(n, slid_mm=0.0 if n < 40 else 10.0), 0, frame_id="c"))
    (sliding,) = check.notes
    organ = SensorCloud(small_frame().depth_mm[:, :3].copy())  # no table in it
    check = FrameCheck(PublishedFrame(calibrated=True, camera_frame_id="c"), CONFIG, 0.25)
    for _ in range(40):
        check.check(Observation(organ, 0, frame_id="c"))
    (blind,) = check.notes
    assert blind != sliding


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
    assert doubts[-1]


def test_the_calibrations_table_counts_and_until_it_is_found_nothing_is_good():
    same, other = (0.0, 0.0, -1.0, -180.0), (0.0, 0.0, -1.0, -184.0)
    watch = TableWatch(CONFIG, same)
    assert watch.check(scene(0))  # a doubt
    assert after([scene(n) for n in range(1, 80)], watch) is None
    assert watch.check(scene(81)) == ""
    _, finding = after(still(60), TableWatch(CONFIG, other))
    assert finding.values["shift_mm"] == pytest.approx(4, abs=0.4)


@pytest.mark.parametrize(
    ("published", "names", "kind"),
    [
        (PublishedFrame("b", calibrated=True, camera_frame_id="l"), ["l", "r"], "other_frame_id"),
        # A ROS message may leave it out.
        (PublishedFrame("b", calibrated=True, camera_frame_id="l"), ["l", ""], "other_frame_id"),
        (PublishedFrame(), ["a", "b"], "frame_id_changed"),
        (PublishedFrame("b", calibrated=True), ["a", ""], "frame_id_changed"),
    ],
)
def test_frames_of_another_camera_give_no_estimate(published, names, kind):
    check = FrameCheck(published, CONFIG, 0.25)
    right, wrong = (Observation(small_frame(), 0, frame_id=name) for name in names)
    assert check.check(right) == ""
    with pytest.raises(NoEstimate) as refused:
        check.check(wrong)
    assert refused.value.finding.kind == kind
    assert check.check(right) == ""
    assert len(check.notes) == (published.calibrated and not published.camera_frame_id)


def test_what_cannot_be_checked_is_said_once():
    check = FrameCheck(PublishedFrame("b", calibrated=True, camera_frame_id="left"), CONFIG, 0.25)
    for _ in range(3):
        check.check(Observation(small_frame(), 0))
    assert len(check.notes) == 1
