"""Where a camera that moves is: tf between processes, a robot's controller that is made up."""

from __future__ import annotations

import json
import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clients
import needs
from clock import until
from live_objects import small_frame
from refused import refused
from rtde_arm import RtdeArm
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid
from tumortrack.live.cameras import camera_setup
from tumortrack.live.spec import POSES
from tumortrack.live.values import Observation
from tumortrack_devices.ur_poses import UrPoses


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
            for asked, one, kind in (
                (poses, seen(time.time_ns() + 10**11), "old_pose"),
                (other, seen(stamps[-1]), "unconnected"),
                (poses, seen(stamps[-1], None), "unconnected"),
            ):
                with pytest.raises(NoEstimate) as raised:
                    asked.at(one)
                assert raised.value.finding.kind == kind
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
    with refused(InputError, "tool_from_camera"):
        camera_setup(["realsense"], None, f"ur:{arm.host}", None)
    setup = camera_setup(["realsense"], None, f"ur:{arm.host}", tool)
    assert setup.published.frame_id == "base"
    poses = setup.poses
    stamps = []

    def now():
        stamps.append(time.time_ns() - 50_000_000)
        return seen(stamps[-1])

    def placed():  # where a busy machine comes between a pose and its stamp, again
        pose = known(poses, now)
        x_mm = 100 * (stamps[-1] * 1e-9 % 100)
        turned = pose[:3, :3] @ way[:3, :3].T  # of the tool
        origin_mm = pose[:3, 3] - turned @ (1000 * way[:3, 3])
        return np.abs(origin_mm - [x_mm, 200, 300]).max() < 5

    until(placed, "the tool's place")

    def kind():
        with pytest.raises(NoEstimate) as raised:
            poses.at(seen(time.time_ns() + 10**11))
        return raised.value.finding.kind

    until(lambda: kind() == "old_pose", "that its last pose is old")
    arm.say("silence")
    until(lambda: kind() == "source", "the arm's silence")
    poses.close()
    assert "ur poses" not in [thread.name for thread in threading.enumerate()]
    arm.say("cut")
    with pytest.raises(InputError):
        POSES.parse(f"ur:{arm.host}").open()


def test_ur_rtde_hears_the_same_arm(arm):
    """Of a tool that turns by 1 rad/s and moves by 100 mm/s, so that each place is one pose."""
    environment = clients.environment("ur-rtde")
    arm.say("turn")
    arm.say("push 3.5")
    theirs = clients.said(environment, "rtde_peer.py", arm.host, 20)
    felt = []
    ours = UrPoses(arm.host, lambda stamp_ns, force: felt.append((stamp_ns, force)))
    try:
        until(lambda: len(felt) > 20, "poses")
        own = [(ours.poses.at(stamp_ns), force) for stamp_ns, force in felt[-20:]]
    finally:
        ours.close()
    places = {said["pose"][0] for said in theirs}
    assert len(places) > 5
    for said in theirs:
        check(posed(said["pose"]))
        assert (said["force"][:3], said["safety"]) == ([0.0, 3.5, -4.0], 1)
    for base_from_tool, force in own:
        check(base_from_tool)
        np.testing.assert_array_equal(force[:3], [0.0, 3.5, -4.0])


def posed(pose_m):
    return rigid(Rotation.from_rotvec(pose_m[3:]).as_matrix(), 1000 * np.array(pose_m[:3]))


def check(base_from_tool):
    x_mm, *others = base_from_tool[:3, 3]
    np.testing.assert_allclose(others, [200, 300], atol=1e-9)
    turn = Rotation.from_rotvec([0, x_mm / 100 % 3, 0]).as_matrix()
    np.testing.assert_allclose(base_from_tool[:3, :3], turn, atol=1e-6)
