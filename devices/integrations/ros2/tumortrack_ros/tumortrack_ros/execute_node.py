"""Sends one stage of a plan (PLAN/trajectories.json) to MoveIt's action ``execute_trajectory``.

MoveIt alone moves the arms, and nothing of tumortrack looks on: it does not halt them when the
organ moves. For simulations; docs/ros.md says more.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import rclpy
from moveit_msgs.action import ExecuteTrajectory
from moveit_msgs.msg import MoveItErrorCodes
from rclpy.action import ActionClient
from rosidl_runtime_py import set_message_fields


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plan", type=Path, help="trajectories.json of a plan")
    parser.add_argument("stage", help="its name: approach, grasp, ..., or 'list'")
    parser.add_argument("--action", default="/execute_trajectory")
    given, _ = parser.parse_known_args()
    stages = {one["name"]: one for one in json.loads(given.plan.read_text())["stages"]}
    if given.stage not in stages:
        sys.exit("\n".join(f"{name}: {one['seconds']:.1f} s" for name, one in stages.items()))
    goal = ExecuteTrajectory.Goal()
    set_message_fields(goal.trajectory, stages[given.stage]["trajectory"])

    rclpy.init()
    node = rclpy.create_node("tumortrack_execute")
    client = ActionClient(node, ExecuteTrajectory, given.action)
    if not client.wait_for_server(10.0):
        sys.exit(f"nobody offers {given.action}: is move_group running?")
    sent = client.send_goal_async(goal)
    rclpy.spin_until_future_complete(node, sent)
    if not sent.result().accepted:
        sys.exit(f"{given.stage} was refused")
    done = sent.result().get_result_async()
    rclpy.spin_until_future_complete(node, done)
    code = done.result().result.error_code.val
    if code != MoveItErrorCodes.SUCCESS:
        sys.exit(f"{given.stage} failed: MoveIt's error {code}")
