"""A plan as MoveIt reads it: trajectories of all joints."""

import json

import numpy as np
import pytest

from tumortrack_devices.ros.messages import Messages
from tumortrack_resection.files import ros_trajectories
from tumortrack_resection.motions import JOINTS, Motions, MotionStage

MESSAGES = Messages()


def test_a_plan_s_motions_are_trajectories_of_all_joints():
    times = np.array([0.0, 0.5, 1.25])
    joints = np.zeros((3, 12))
    joints[1:, 0], joints[:, 7] = [0.25, 1.0], 0.5
    still = MotionStage("hold", np.zeros(1), joints[:1], np.zeros(1, bool))
    moving = MotionStage("approach", times, joints, np.zeros(3, bool))
    written = json.loads(ros_trajectories(Motions((still, moving)), "table"))
    (stage,) = written["stages"]
    said = stage["trajectory"]["joint_trajectory"]
    points = [{**one, "positions": np.array(one["positions"]),
               "velocities": np.array(one["velocities"])} for one in said["points"]]  # fmt: skip
    message = MESSAGES.make(
        "moveit_msgs/msg/RobotTrajectory", joint_trajectory={**said, "points": points}
    )
    again = MESSAGES.from_bytes(MESSAGES.to_bytes(message), "moveit_msgs/msg/RobotTrajectory")
    trajectory = again.joint_trajectory
    assert (stage["name"], stage["seconds"]) == ("approach", 1.25)
    assert trajectory.joint_names == list(JOINTS)
    assert trajectory.header.frame_id == "table"
    np.testing.assert_allclose([one.positions for one in trajectory.points], joints, atol=1e-6)
    starts = [one.time_from_start.sec + 1e-9 * one.time_from_start.nanosec
              for one in trajectory.points]  # fmt: skip
    np.testing.assert_allclose(starts, times)
    assert [one.velocities[0] for one in trajectory.points] == [0, pytest.approx(0.7), 0]
