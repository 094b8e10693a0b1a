"""Poses of an arm, from the simulated controller: the maker's interface hears what ours does."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clients
from clock import until
from rtde_arm import RtdeArm
from tumortrack.core.geometry import rigid
from tumortrack_devices.ur_poses import UrPoses


@pytest.fixture
def arm():
    made = RtdeArm()
    yield made
    made.close()


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
