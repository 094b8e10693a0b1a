"""Where a camera that moves is: tf between processes, a robot's controller that is made up."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

import needs
from clock import until
from live_objects import small_frame
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.live.cameras import camera_setup
from tumortrack.live.spec import POSES
from tumortrack.live.values import Observation


def seen(stamp_ns, frame_id="optical"):
    return Observation(small_frame(stamp_ns), stamp_ns, frame_id=frame_id)


def known(poses, one):
    """The pose, once there is one."""

    def asked():
        try:
            return [poses.at(one())]
        except NoEstimate as error:
            told.append(str(error))
            return None

    told = []
    return until(asked, f"a pose, not {told}")[0]


def in_mm(pose_m):
    pose_mm = pose_m.copy()
    pose_mm[:3, 3] *= 1000
    return pose_mm


def test_tf_of_another_process_places_the_camera_at_the_frames_stamp():
    needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")
    from ros2_objects import own_graph, peer
    from ros2_peer import TOOL_FROM_CAMERA, tool_pose

    with own_graph(), peer("tf", 25, 600) as sender:
        assert json.loads(sender.line())["static"]  # said before anybody listens
        poses = POSES.parse("ros2:base_link?via=dds").open()
        tool = POSES.parse("ros2:base_link?via=dds&camera=tool0").open()
        other = POSES.parse("ros2:world?via=dds").open()
        try:
            stamps = []

            def now(ago_ns=10**8):
                stamps.append(time.time_ns() - ago_ns)
                return seen(stamps[-1])

            pose = known(poses, now)
            expected = in_mm(tool_pose(stamps[-1]) @ TOOL_FROM_CAMERA)
            np.testing.assert_allclose(pose, expected, atol=0.01)
            np.testing.assert_allclose(known(tool, now), in_mm(tool_pose(stamps[-1])), atol=0.01)
            # A frame just taken waits for what was said after it.
            fresh = known(poses, lambda: now(0))
            np.testing.assert_allclose(
                fresh, in_mm(tool_pose(stamps[-1]) @ TOOL_FROM_CAMERA), atol=0.01
            )
            with pytest.raises(NoEstimate, match="older than the frame"):
                poses.at(seen(time.time_ns() + 10**9))
            with pytest.raises(NoEstimate, match="the camera, 'optical', with 'world'"):
                other.at(seen(stamps[-1]))
            with pytest.raises(NoEstimate, match="does not connect the camera, ''"):
                poses.at(seen(stamps[-1], None))
        finally:
            for one in (poses, tool, other):
                one.close()


class Arm:
    """ur_rtde's receiving half; its tool turns at 1 rad/s and shifts by 100 mm/s."""

    def __init__(self, host):
        if host == "10.0.0.1":
            raise RuntimeError("Could not connect")
        self.silent = self.bye = False

    def getTimestamp(self):  # noqa: N802
        return 7.0 if self.silent else time.time()

    def isConnected(self):  # noqa: N802
        return True

    def getActualTCPPose(self):  # noqa: N802
        seconds = time.time() % 100
        return [0.1 * seconds, 0.2, 0.3, 0.0, seconds % 3, 0.0]

    def disconnect(self):
        self.bye = True


@pytest.fixture
def _rtde(monkeypatch):
    module = ModuleType("rtde_receive")
    module.RTDEReceiveInterface = Arm
    monkeypatch.setitem(sys.modules, "rtde_receive", module)


@pytest.mark.usefixtures("_rtde")
def test_an_arms_tool_and_the_hand_eye_calibration_place_the_camera(tmp_path):
    tool = tmp_path / "tool.json"
    way = np.diag([1.0, -1, -1, 1])
    way[:3, 3] = [0.0, 0.05, 0.02]
    rows = {"frame_id": "base", "unit": "m", "tool_from_camera": way.tolist()}
    tool.write_text(json.dumps(rows))
    with pytest.raises(InputError, match="--frame FILE with tool_from_camera"):
        camera_setup(["realsense"], None, "ur:10.0.0.9", None)
    setup = camera_setup(["realsense"], None, "ur:10.0.0.9", tool)
    assert setup.published.frame_id == "base"
    poses = setup.poses
    stamps = []

    def now():
        stamps.append(time.time_ns() - 50_000_000)
        return replace(seen(stamps[-1]))

    def placed():  # where a busy machine comes between a pose and its stamp, again
        pose = known(poses, now)
        x_mm = 100 * (stamps[-1] * 1e-9 % 100)
        turned = pose[:3, :3] @ way[:3, :3].T  # of the tool
        origin_mm = pose[:3, 3] - turned @ (1000 * way[:3, 3])
        return np.abs(origin_mm - [x_mm, 200, 300]).max() < 5

    until(placed, "the tool's place")
    poses._receive.silent = True
    time.sleep(0.3)
    with pytest.raises(NoEstimate, match="last pose is older"):
        poses.at(seen(time.time_ns()))
    poses.close()
    until(lambda: poses._receive.bye, "the end")
    with pytest.raises(InputError, match="an arm that is on"):
        POSES.parse("ur:10.0.0.1").open()
