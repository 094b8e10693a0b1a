"""A ROS 2 node as its users write one: rclpy, its typed messages, its usual qualities of service.

rclpy_peer.py send image HZ SECONDS      a depth camera
rclpy_peer.py hear SECONDS               a line for every message of the sink
rclpy_peer.py ask NAME COUNT              calls of the node's service
rclpy_peer.py change NAME ...            transitions of the node /tumortrack, and its state before
                                         and after each
rclpy_peer.py set NAME=VALUE ...         parameters of the node /tumortrack, one after the other
"""

from __future__ import annotations

import json
import signal
import sys
import time
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from live_objects import CAMERA, PARTS
from ros2_peer import MASK, frame_numbered

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
NUMBERS = ("smoothing", "stale")
KINDS = {"cloud": PointCloud2, "meshes": MarkerArray, "diagnostics": DiagnosticArray}


def send(node: Node, hz: float, seconds: float) -> None:
    """As drivers do: images of 16 bits, in mm, best effort; the camera said once, and kept."""
    cameras = node.create_publisher(CameraInfo, "/camera/depth/camera_info", KEPT)
    images = node.create_publisher(Image, "/camera/depth/image_rect", qos_profile_sensor_data)
    masks = node.create_publisher(Image, "/camera/mask", 10)
    info = CameraInfo(width=CAMERA.width, height=CAMERA.height)
    info.k = [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0]
    info.header.frame_id = "optical"
    cameras.publish(info)
    mask = 255 * MASK.astype(np.uint8)
    end_s, number = time.monotonic() + seconds, 0
    while time.monotonic() < end_s:
        depth_mm = np.nan_to_num(frame_numbered(number, 0).depth_mm).round().astype(np.uint16)
        now = node.get_clock().now().to_msg()
        for publisher, encoding, pixels in ((masks, "mono8", mask), (images, "16UC1", depth_mm)):
            image = Image(width=CAMERA.width, height=CAMERA.height, encoding=encoding)
            image.header.frame_id, image.header.stamp = "optical", now
            image.step, image.data = pixels.strides[0], pixels.tobytes()
            publisher.publish(image)
        number += 1
        time.sleep(1 / hz)


def hear(node: Node, seconds: float) -> None:
    """Says once that it listens."""
    kinds = KINDS | {f"{part}/center": PointStamped for part in PARTS}

    def listen(topic: str, kind: Any, quality: QoSProfile | int = 10) -> None:
        def said(message: Any) -> None:
            content = {"now_ns": time.time_ns(), **content_of(message)}
            print(json.dumps({"topic": topic, **content}), flush=True)

        node.create_subscription(kind, f"/tumortrack/{topic}", said, quality)

    listen("planned", MarkerArray, KEPT)
    for topic, kind in kinds.items():
        listen(topic, kind)
    print(json.dumps({"listens": sorted(kinds)}), flush=True)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.2)


def content_of(message: Any) -> dict[str, Any]:
    if isinstance(message, MarkerArray):
        markers = [[one.ns, one.action, len(one.points)] for one in message.markers]
        return {"stamp_ns": stamp_ns(message.markers[0].header), "markers": markers}
    content = {"stamp_ns": stamp_ns(message.header), "frame": message.header.frame_id}
    if isinstance(message, PointCloud2):
        return {**content, "points": message.width, "sum": sum(message.data)}
    if isinstance(message, DiagnosticArray):
        status = message.status[0]
        return {**content, "level": ord(status.level), "text": status.message}
    place = [message.point.x, message.point.y, message.point.z]
    return {**content, "m": place}


def put(node: Node, words: list[str]) -> None:
    """A line for each answer, and one with all values once an accepted one was set back."""
    client = AsyncParameterClient(node, "/tumortrack")
    client.wait_for_services()

    def answer(future: Any) -> Any:
        rclpy.spin_until_future_complete(node, future)
        return future.result()

    for name, value in (word.split("=") for word in words):
        given = Parameter(name, value=float(value) if name in NUMBERS else value)
        (result,) = answer(client.set_parameters([given])).results
        said = {"successful": result.successful, "reason": result.reason}
        print(json.dumps(said), flush=True)
        while value == "nonsense":
            stale, moving = answer(client.get_parameters(["stale", "moving"])).values
            if moving.string_value != value:
                said = {"stale": stale.double_value, "moving": moving.string_value}
                print(json.dumps(said), flush=True)
                break
            time.sleep(0.05)


def change(node: Node, names: list[str]) -> None:
    """A line for each transition: whether it was made, and in which state the node is; and first
    one with its state, and the names of all nodes. rclpy never answers a number (the transition's
    id) that the state does not have: it is sent, and no more."""
    states = node.create_client(GetState, "/tumortrack/get_state")
    changes = node.create_client(ChangeState, "/tumortrack/change_state")

    def answer(client: Any, request: Any) -> Any:
        client.wait_for_service()
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future)
        return future.result()

    def state() -> str:
        return answer(states, GetState.Request()).current_state.label

    said: dict[str, Any] = {"state": state(), "nodes": node.get_node_names()}
    print(json.dumps(said), flush=True)
    for name in names:
        if name.isdigit():
            changes.call_async(ChangeState.Request(transition=Transition(id=int(name))))
            continue
        request = ChangeState.Request(transition=Transition(label=name))
        done = answer(changes, request).success
        print(json.dumps({"name": name, "done": done, "state": state()}), flush=True)


def ask(node: Node, name: str, count: int) -> None:
    """A line for each answer, half a second apart."""
    client = node.create_client(Trigger, f"/tumortrack/{name}")
    client.wait_for_service()
    for _ in range(count):
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future)
        print(json.dumps({"successful": future.result().success}), flush=True)
        time.sleep(0.5)


def stamp_ns(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


if __name__ == "__main__":
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # and it leaves the graph
    here = rclpy.create_node("peer")
    if sys.argv[1] == "send":
        send(here, *map(float, sys.argv[3:]))
    elif sys.argv[1] == "set":
        put(here, sys.argv[2:])
    elif sys.argv[1] == "change":
        change(here, sys.argv[2:])
    elif sys.argv[1] == "ask":
        ask(here, sys.argv[2], int(sys.argv[3]))
    else:
        hear(here, float(sys.argv[2]))
