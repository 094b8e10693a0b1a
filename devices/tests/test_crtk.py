"""CRTK and dVRK: results that SlicerROS2 and robots read, and an arm as a tool. Who listens and
speaks is a real rclpy."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clients
import needs
from clock import Clock, until
from live_objects import PARTS, STAMP_NS, empty_update, small_anatomy, small_setting, small_update
from refused import refused
from reports import advised, bounded
from ros2_objects import Other, own_graph, process, published_again
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.evidence import Touch
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.live.values import CameraView, PublishedFrame, TrackingResult
from tumortrack_devices.ros.bus import Bus, open_bus
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import JOINTS, ResultMessages
from tumortrack_devices.sinks.ros import Ros2SinkConfig
from tumortrack_devices.tools.crtk import CrtkTool, CrtkToolConfig
from warp_objects import placed

needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")

PEER = Path(__file__).parent / "support" / "crtk_peer.py"
TURN = Rotation.from_euler("xyz", [0.3, -1, 2]).as_matrix()
BASE = PublishedFrame(
    "PSM1_base", rigid(TURN, np.array([50.0, -20, 9])), True, error_mm=0.5, error_deg=0.2
)
MS = 1_000_000


@pytest.fixture(autouse=True)
def _own_graph() -> Iterator[None]:
    with own_graph():
        yield


@contextmanager
def rclpy_peer(*arguments: object) -> Iterator[Other]:
    environment = clients.environment("ros-jazzy-rclpy")
    with process(sys.executable, PEER, *arguments, environment=environment) as other:
        other.line()
        yield other


# --- results -------------------------------------------------------------------------------------


def known() -> TrackingResult:
    """A result whose motion has a covariance, with a bound and advice."""
    update = small_update(frames=BASE)
    mixed = np.random.default_rng(3).normal(size=(26, 26)) * 0.01
    motion = replace(placed(), covariance=mixed @ mixed.T)
    advice = {
        "kind": "touch", "part": "tumor_1", "place_mm": (4.0, -3.0, 105.0), "std_mm": 1.0,
        "direction": (0.0, 0.0, -1.0), "then_std_mm": 0.9, "bound_mm": 2.3, "then_bound_mm": 2.0,
    }  # fmt: skip
    estimate = advised(bounded(update.estimate, tumor_1=2.34), [advice])
    return replace(update, estimate=replace(estimate, motion=motion))


def heard_by(slicer: Other, update: TrackingResult) -> dict[str, dict]:
    """The last message of each topic."""
    last: dict[str, dict] = {}
    verdicts: list[str] = []

    def all_are_there(message: dict) -> bool:
        last[topic := message["topic"].removeprefix("/tumortrack/")] = message
        if topic == "verdict" and message["text"].startswith(update.quality):
            verdicts.append(message["text"])  # topics race: all are of this update with the third
        return len(verdicts) > 2 and len(last) == 3 + 2 * len(PARTS)

    with (
        closing(Ros2SinkConfig(via="dds").open(small_setting())) as sink,
        published_again(sink, update),
    ):
        slicer.lines_until(all_are_there)
    return last


def test_slicer_reads_what_is_known_and_sees_no_valid_pose_of_what_is_not_good() -> None:
    update = known()
    with rclpy_peer("slicer") as slicer:
        heard = heard_by(slicer, update)
        doubtful = [replace(update, quality="poor"), replace(empty_update(), published_frame=BASE)]
        not_good = [heard_by(slicer, each) for each in doubtful]
    for name in PARTS:
        said = heard[f"{name}/measured_cp"]
        assert (said["stamp_ns"], said["frame"]) == (STAMP_NS, "PSM1_base")
        np.testing.assert_allclose(said["matrix"], update.part_pose(name), atol=1e-9)
        covariance = np.reshape(heard[f"{name}/measured_cp_covariance"]["covariance"], (6, 6))
        np.testing.assert_allclose(covariance, covariance.T)
        motion = update.estimate.motion
        camera_mm = small_anatomy().parts[PARTS.index(name)].box_mm.mean(0)[None]
        of_motion = motion.covariance_mm2(motion.inverse(camera_mm))[0]
        error_mm = 0.5 + np.linalg.norm(camera_mm) * np.radians(0.2)
        expected = TURN @ of_motion @ TURN.T + error_mm**2 * np.eye(3)  # and the calibration's
        np.testing.assert_allclose(covariance[:3, :3] * 1e6, expected, rtol=1e-6)
        turns = np.linalg.eigvalsh(covariance[3:, 3:] - np.radians(0.2) ** 2 * np.eye(3))
        own = np.linalg.eigvalsh(motion.covariance[3:6, 3:6])
        np.testing.assert_allclose(turns, own, rtol=1e-6)
    (touch,) = heard["next_touch"]["matrices"]
    place_mm = transform_points(BASE.published_from_camera, np.array([[4.0, -3.0, 105.0]]))[0]
    np.testing.assert_allclose(np.array(touch)[:3, 3], place_mm, atol=1e-3)
    bounds = heard["bounds"]
    assert (bounds["label"].split(","), bounds["size"]) == (list(PARTS), 3)
    np.testing.assert_allclose(bounds["numbers"], [np.nan, 0.00234, np.nan])

    for heard in not_good:
        for name in PARTS:
            pose, stated = (heard[f"{name}/measured_cp{end}"] for end in ("", "_covariance"))
            assert (pose["stamp_ns"], stated["stamp_ns"]) == (0, 0)  # invalid, as CRTK has it
            assert np.isnan(np.array(pose["matrix"])[:3]).all()
            assert np.isnan(stated["covariance"]).all()
        assert np.isnan(heard["bounds"]["numbers"]).all()
        assert heard["next_touch"]["matrices"] == []


def test_a_method_that_knows_no_covariance_says_so() -> None:
    messages = Messages()
    out = ResultMessages(messages, small_setting()).messages(small_update())
    by_suffix = {one.suffix: one.message for one in out}
    stated = by_suffix["kidney/measured_cp_covariance"]
    assert np.isnan(stated.pose.covariance).all()
    assert stated.pose.pose == by_suffix["kidney/measured_cp"].pose
    assert np.isfinite(stated.pose.pose.position.x)


# --- an arm as a tool ----------------------------------------------------------------------------


class Arm:
    """Sends what a CRTK arm sends, on request, on a bus of its own."""

    def __init__(self, bus: Bus) -> None:
        self._messages = bus.messages
        self._pose = bus.publisher("/PSM1/measured_cp", "geometry_msgs/msg/PoseStamped")
        self._jaw = bus.publisher("/PSM1/jaw/measured_js", JOINTS)
        self._pedal = bus.publisher("/footpedals/coag", "sensor_msgs/msg/Joy")

    def place(self, stamp_ns: int, x_mm: float, frame: str = "PSM1_base", w: float = 1.0) -> None:
        header = self._messages.header(stamp_ns, frame)
        pose = {"position": {"x": x_mm / 1000}, "orientation": {"w": w}}
        kind = "geometry_msgs/msg/PoseStamped"
        self._pose(self._messages.to_bytes(self._messages.make(kind, header=header, pose=pose)))

    def press(self, stamp_ns: int, *buttons: int) -> None:
        header, pressed = self._messages.header(stamp_ns, ""), np.array(buttons, np.int32)
        message = self._messages.make("sensor_msgs/msg/Joy", header=header, buttons=pressed)
        self._pedal(self._messages.to_bytes(message))

    def jaw(self, stamp_ns: int, *angles_deg: float) -> None:
        header, position = self._messages.header(stamp_ns, ""), np.radians(angles_deg)
        message = self._messages.make(JOINTS, header=header, position=position)
        self._jaw(self._messages.to_bytes(message))


@pytest.fixture
def arm() -> Iterator[Arm]:
    bus = open_bus("dds")
    yield Arm(bus)
    bus.close()


@pytest.fixture
def tool() -> Iterator[CrtkTool]:
    context = replace(small_setting(), anatomy_ct=small_anatomy(), published_frame=BASE)
    made = CrtkToolConfig(namespace="/PSM1", via="dds").open(context, "psm1")
    yield made
    made.close()


def x_mm(tool: CrtkTool, stamp_ns: int) -> float | None:
    tool.refresh(stamp_ns)
    try:
        return float(tool.pose(stamp_ns)[0, 3])
    except NoEstimate:
        return None


def test_a_jaw_that_closes_touches_until_it_opens_wide(arm: Arm, tool: CrtkTool) -> None:
    """From 10 to 15 degrees it stays what it was; one that was never seen open does not count."""
    angles = {0: 0, 200: 40, 300: 9, 400: 12, 500: 9, 600: 20, 700: 12, 800: 9}
    for ms in range(0, 1001, 20):
        now_ns = STAMP_NS + ms * MS

        def both_came(ms: int = ms, now_ns: int = now_ns) -> bool:
            if ms in angles:
                arm.jaw(now_ns, angles[ms])
            arm.place(now_ns, ms / 10)
            return x_mm(tool, now_ns) == pytest.approx(ms / 10)

        until(both_came)
        until(both_came)  # what was sent before the first one has come as well
    view = CameraView(1, small_update(stamp_ns=now_ns).observation, BASE.published_from_camera)
    touches = tool.evidence(view)
    assert [type(piece) for piece in touches] == [Touch, Touch]
    assert [(piece.stamp_ns - STAMP_NS) // MS for piece in touches] == [300, 800]
    places_mm = np.array([piece.place_mm for piece in touches])
    there_mm = transform_points(BASE.published_from_camera, places_mm)
    np.testing.assert_allclose(there_mm, [[35, 0, 0], [85, 0, 0]], atol=1e-6)  # of 0.1 s


def test_an_electrode_cuts_while_its_pedal_is_pressed(arm: Arm) -> None:
    """A jaw that closes, and a tap that has ended, energise nothing."""
    context = replace(small_setting(), anatomy_ct=small_anatomy(), published_frame=BASE)
    options = {"namespace": "/PSM1", "via": "dds", "electrode_mm": 6.0, "pedal": "/footpedals/coag"}
    tool = CrtkToolConfig(**options).open(context, "hook")
    said = {0: (), 200: (2,), 300: (1, 1), 500: (0, 1), 700: (2,)}
    try:
        for ms in range(0, 1001, 20):
            now_ns = STAMP_NS + ms * MS

            def both_came(ms: int = ms, now_ns: int = now_ns) -> bool:
                arm.jaw(now_ns, 40 if ms < 600 else 0)
                if ms in said:
                    arm.press(now_ns, *said[ms])
                arm.place(now_ns, ms / 10)
                return x_mm(tool, now_ns) == pytest.approx(ms / 10)

            until(both_came)
            until(both_came)
        view = CameraView(1, small_update(stamp_ns=now_ns).observation, BASE.published_from_camera)
        (cut,) = tool.evidence(view)
    finally:
        tool.close()
    there_mm = transform_points(BASE.published_from_camera, np.array(cut.places_mm))
    low, high = there_mm.min(0), there_mm.max(0)
    np.testing.assert_allclose([low, high], [[30, 0, -6], [50, 0, 0]], atol=1e-6)


def test_what_is_invalid_or_in_another_frame_is_no_pose(arm, tool, monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr("tumortrack_devices.tools.crtk.time", clock)
    tool.refresh(0)  # by that clock it has heard nothing for long
    assert "/PSM1/measured_cp" in tool.trouble

    def came() -> bool:
        arm.place(0, 7.0)
        arm.place(STAMP_NS, np.nan)
        arm.place(STAMP_NS + MS, 8.0, w=0.5)
        arm.jaw(STAMP_NS)
        arm.place(STAMP_NS + 2 * MS, 9.0)
        return x_mm(tool, STAMP_NS + 2 * MS) == pytest.approx(9)

    until(came)
    for stamp_ns in (0, STAMP_NS, STAMP_NS + MS):
        assert x_mm(tool, stamp_ns) is None

    def refused_now() -> bool:
        arm.place(STAMP_NS + 5 * MS, 9.0, "ECM")
        try:
            tool.refresh(0)
        except InputError as error:
            return "ECM" in str(error) and "PSM1_base" in str(error)
        return False

    until(refused_now)
    assert x_mm(tool, STAMP_NS + 5 * MS) is None


@pytest.mark.parametrize(
    "options",
    [
        *({"namespace": "PSM1"}, {"pose": "measured cp"}, {"jaw": "/jaw"}, {"closed_deg": 100}),
        {"pedal": "coag"},
    ],
)
def test_a_topic_that_ros_does_not_take_and_an_impossible_angle_are_refused(options) -> None:
    with refused(InputError, *options.values()):
        CrtkToolConfig(**({"namespace": "/PSM1"} | options))


@pytest.mark.parametrize("options", [{"electrode_mm": 6.0}, {"pedal": "/footpedals/coag"}])
def test_a_cutter_has_an_electrode_and_a_pedal(options) -> None:
    with refused(InputError, "pedal"):
        CrtkToolConfig(namespace="/PSM1", **options)


def test_an_arm_needs_to_be_told_where_the_camera_is() -> None:
    with refused(InputError, "--frame"):
        CrtkToolConfig(namespace="/PSM1", via="dds").open(small_setting(), "psm1")
