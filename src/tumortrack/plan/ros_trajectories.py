"""Motions as trajectories that MoveIt executes: moveit_msgs/RobotTrajectory, in ROS's own words."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from tumortrack.plan.motions import JOINTS, Motions, MotionStage


def ros_trajectories(motions: Motions, frame_id: str) -> bytes:
    """JSON, which ROS 2 reads as YAML: ``stages``, each with its ``name``, ``seconds`` and the
    ``trajectory`` of all joints, where any moves; radians, seconds. Each begins where the one
    before ended."""
    stages = [
        {"name": stage.name, "seconds": stage.seconds, "trajectory": _trajectory(stage, frame_id)}
        for stage in motions.stages
        if len(stage.times_s) > 1
    ]
    return json.dumps({"frame_id": frame_id, "stages": stages}).encode()


def _trajectory(stage: MotionStage, frame_id: str) -> dict[str, Any]:
    """At rest at both ends."""
    speeds = np.gradient(stage.joints_rad, stage.times_s, axis=0)
    speeds[[0, -1]] = 0
    points = []
    for time_s, joints, speed in zip(stage.times_s, stage.joints_rad, speeds, strict=True):
        seconds, nanoseconds = divmod(round(time_s * 1e9), 1_000_000_000)
        points.append(
            {
                "positions": np.round(joints, 7).tolist(),
                "velocities": np.round(speed, 6).tolist(),
                "time_from_start": {"sec": seconds, "nanosec": nanoseconds},
            }
        )
    about = {"header": {"frame_id": frame_id}, "joint_names": list(JOINTS), "points": points}
    return {"joint_trajectory": about}
