"""Where a camera that moves is: tf between processes, a robot's controller that is made up."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import needs
from clock import until
from live_objects import small_frame
from rtde_arm import RtdeArm
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


@pytest.fixture
def arm():
    made = RtdeArm()
    yield made
    made.close()


def test_an_arms_tool_and_the_hand_eye_calibration_place_the_camera(tmp_path, arm):
    arm.say("turn")
    tool = tmp_path / "tool.json"
    way = np.diag([1.0, -1, -1, 1])
    way[:3, 3] = [0.0, 0.05, 0.02]
    rows = {"frame_id": "base", "unit": "m", "tool_from_camera": way.tolist()}
    tool.write_text(json.dumps(rows))
    with pytest.raises(InputError, match="--frame FILE with tool_from_camera"):
        camera_setup(["realsense"], None, f"ur:{arm.host}", None)
    setup = camera_setup(["realsense"], None, f"ur:{arm.host}", tool)
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
    arm.say("silence")
    kinds = set()

    def named():  # first that its last pose is old, then that the arm is silent
        with pytest.raises(NoEstimate) as raised:
            poses.at(seen(time.time_ns() + 50_000_000))
        kinds.add(raised.value.finding.kind)
        return "source" in kinds

    until(named, "the arm's silence")
    assert kinds == {"old_pose", "source"}
    poses.close()
    assert "ur poses" not in [thread.name for thread in threading.enumerate()]
    arm.say("cut")
    with pytest.raises(InputError):
        POSES.parse(f"ur:{arm.host}").open()
