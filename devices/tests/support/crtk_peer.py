"""Nodes as laboratories run them, on rclpy and its typed messages.

crtk_peer.py slicer        reads what SlicerROS2 reads, as it does: reliable, depth 100 (its
                           vtkMRMLROS2SubscriberInternals.h), poses as matrices in mm (its
                           vtkROS2ToSlicer.cxx); and, as another node, poses with covariance
crtk_peer.py arm X Y Z     a dVRK's PSM1 whose tip stands there (m, its own base) and whose jaw
                           closes for 0.4 s in every second; 100 Hz, PoseStamped and JointState
crtk_peer.py simulator     says each servo_cp of PSM1
All say a line of JSON for each message, the arm one as it begins, until they are ended.
"""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

from live_objects import PARTS

SLICER = {"next_touch": PoseArray, "verdict": String, "bounds": Float64MultiArray}
SLICER |= {f"{part}/measured_cp": PoseStamped for part in PARTS}
SLICER |= {f"{part}/measured_cp_covariance": PoseWithCovarianceStamped for part in PARTS}
OPEN_RAD, CLOSED_RAD, CLOSED_S = 0.6, -0.1, 0.4


def listen(node: Node, topics: dict[str, Any]) -> None:
    def heard(topic: str, kind: Any) -> None:
        def said(message: Any) -> None:
            print(json.dumps({"topic": topic, **content_of(message)}), flush=True)

        node.create_subscription(kind, topic, said, 100)

    for topic, kind in topics.items():
        heard(topic, kind)
    print(json.dumps({"listens": len(topics)}), flush=True)
    rclpy.spin(node)


def content_of(message: Any) -> dict[str, Any]:
    if isinstance(message, String):
        return {"text": message.data}
    if isinstance(message, Float64MultiArray):
        (dim,) = message.layout.dim  # SlicerROS2 takes one dimension alone
        return {"label": dim.label, "size": dim.size, "numbers": list(message.data)}
    header = message.header
    about = {
        "stamp_ns": header.stamp.sec * 10**9 + header.stamp.nanosec,
        "frame": header.frame_id,
    }
    if isinstance(message, PoseArray):
        return {**about, "matrices": [matrix_of(pose) for pose in message.poses]}
    if isinstance(message, PoseWithCovarianceStamped):
        return {**about, "covariance": message.pose.covariance.tolist()}
    return {**about, "matrix": matrix_of(message.pose)}


def matrix_of(pose: Any) -> list[list[float]]:
    """mm."""
    w, x, y, z = (getattr(pose.orientation, name) for name in "wxyz")
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    place = [1000 * getattr(pose.position, name) for name in "xyz"]
    return np.vstack([np.column_stack([turn, place]), [0, 0, 0, 1]]).tolist()


def arm(node: Node, place_m: list[float]) -> None:
    poses = node.create_publisher(PoseStamped, "/PSM1/local/measured_cp", 10)
    jaws = node.create_publisher(JointState, "/PSM1/jaw/measured_js", 10)
    pose, jaw = PoseStamped(), JointState(name=["jaw"])
    pose.header.frame_id, pose.pose.orientation.w = "PSM1_base", 1.0
    pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = place_m
    print(json.dumps({"arm": place_m}), flush=True)
    begun_s = time.monotonic()
    while True:
        pose.header.stamp = jaw.header.stamp = node.get_clock().now().to_msg()
        past_s = math.fmod(time.monotonic() - begun_s, 1.0)
        jaw.position = [CLOSED_RAD if past_s > 1 - CLOSED_S else OPEN_RAD]
        poses.publish(pose)
        jaws.publish(jaw)
        time.sleep(0.01)


if __name__ == "__main__":
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # and it leaves the graph
    here = rclpy.create_node("peer")
    if sys.argv[1] == "arm":
        arm(here, [float(word) for word in sys.argv[2:]])
    elif sys.argv[1] == "slicer":
        listen(here, {f"/tumortrack/{topic}": kind for topic, kind in SLICER.items()})
    else:
        listen(here, {"/PSM1/servo_cp": PoseStamped})
