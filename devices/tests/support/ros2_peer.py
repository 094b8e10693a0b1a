"""The other end of test_ros2_processes.py: a process that sends frames, or says what it heard.

ros2_peer.py send image|cloud HZ SECONDS
ros2_peer.py hear SECONDS
ros2_peer.py tf HZ SECONDS
ros2_peer.py see TOPIC
`send` and `see` go through rclpy where the process has it, else over Cyclone DDS.
"""

from __future__ import annotations

import json
import signal
import sys
import time

import numpy as np
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from scipy.spatial.transform import Rotation

from live_objects import empty_update, small_frame, small_setting
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation
from tumortrack_devices.ros.bus import Publish, open_bus
from tumortrack_devices.ros.dds import domain_id, idl_type
from tumortrack_devices.ros.messages import stamp_of
from tumortrack_devices.ros.results import DIAGNOSTICS, MARKERS, PLACE, ResultMessages
from tumortrack_devices.ros.sensors import CAMERA_INFO, CLOUD, messages_seen, plain_cloud
from tumortrack_devices.ros.tf import TRANSFORMS
from tumortrack_devices.sources.ros import Ros2SourceConfig

N_POINTS = 40_000
MASK = np.arange(48 * 64).reshape(48, 64) % 3 == 0
TOOL_FROM_CAMERA = rigid(np.diag([-1.0, -1, 1]), np.array([0.01, 0.02, 0.06]))  # m


def points_mm() -> np.ndarray:
    """Every point another one; whole eighths of a mm, so that metres hold them well."""
    return (np.random.default_rng(3).integers(-800, 800, (N_POINTS, 3)) / 8).astype(np.float32)


def frame_numbered(number: int, stamp_ns: int) -> DepthFrame:
    """The small frame, with its number as the depth of its first pixel."""
    depth_mm = small_frame().depth_mm.copy()
    depth_mm[0, 0] = 100 + number % 100
    return DepthFrame(depth_mm, small_frame().intrinsics, stamp_ns)


def send(kind: str, hz: float, seconds: float) -> None:
    bus = open_bus("auto")
    messages = bus.messages
    points = points_mm()
    publishers: dict = {}
    end_s = time.monotonic() + seconds
    number = 0
    while time.monotonic() < end_s:
        start_ns = time.time_ns()
        if kind == "cloud":
            header = messages.header(start_ns, "camera")
            out = [("points", CLOUD, plain_cloud(SensorCloud(points, start_ns), header, messages))]
        else:
            observation = Observation(frame_numbered(number, start_ns), start_ns, MASK)
            out = list(reversed(messages_seen(observation, messages)))
        for suffix, message_type, message in out:
            if suffix not in publishers:
                kept = message_type == CAMERA_INFO
                publishers[suffix] = bus.publisher(f"/camera/{suffix}", message_type, kept)
            publishers[suffix](messages.to_bytes(message))
        number += 1
        time.sleep(max(0.0, 1 / hz - (time.time_ns() - start_ns) * 1e-9))
    bus.close()


def tool_pose(stamp_ns: int) -> np.ndarray:
    """base_link from a tool that turns at a constant rate, round in 20 s, m."""
    turn = Rotation.from_rotvec([0, 2 * np.pi * (stamp_ns % (20 * 10**9)) / 20e9, 0])
    return rigid(turn.as_matrix(), np.array([1.0, 0.5, 0.1]))


def transforms(hz: float, seconds: float) -> None:
    """The camera on the tool, said once and kept; then the tool."""
    bus = open_bus("dds")
    static = bus.publisher("/tf_static", TRANSFORMS, latched=True)
    moving, end_s = bus.publisher("/tf", TRANSFORMS), time.monotonic() + seconds

    def send(publish: Publish, stamp_ns: int, parent: str, child: str, way: np.ndarray) -> None:
        x, y, z, w = Rotation.from_matrix(way[:3, :3]).as_quat().tolist()
        transform = {
            "header": bus.messages.header(stamp_ns, parent),
            "child_frame_id": child,
            "transform": {
                "translation": dict(zip("xyz", way[:3, 3].tolist(), strict=True)),
                "rotation": {"x": x, "y": y, "z": z, "w": w},
            },
        }
        message = bus.messages.make(TRANSFORMS, transforms=[transform])
        publish(bus.messages.to_bytes(message))

    send(static, 1, "tool0", "optical", TOOL_FROM_CAMERA)
    print(json.dumps({"static": True}), flush=True)
    while time.monotonic() < end_s:
        now_ns = time.time_ns()
        send(moving, now_ns, "base_link", "tool0", tool_pose(now_ns))
        time.sleep(1 / hz)
    bus.close()


def hear(seconds: float) -> None:
    """Writes a line as soon as it listens, and one for every message."""
    bus = open_bus("dds")
    messages = bus.messages
    # A second reader of the cloud, whose writer has to wait for its acknowledgements.
    reliable, volatile = Policy.Reliability.Reliable(0), Policy.Durability.Volatile
    topic = Topic(member := DomainParticipant(domain_id()), "rt/tumortrack/cloud", idl_type(CLOUD))
    _held = DataReader(member, topic, Qos(reliable, volatile, Policy.History.KeepLast(1)))
    out = ResultMessages(messages, small_setting()).messages(empty_update())
    kinds = {
        sent.suffix: sent.message_type
        for sent in out
        if sent.message_type
        in (CLOUD, MARKERS, DIAGNOSTICS, PLACE)  # crtk_peer.py hears the others
        and not sent.suffix.startswith("/")
    }
    heard = {name: bus.subscriber(f"/tumortrack/{name}", kind) for name, kind in kinds.items()}
    print(json.dumps({"listens": sorted(heard)}), flush=True)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        bus.wait(0.2)
        for name, subscriber in heard.items():
            for cdr in subscriber.take():
                now_ns = time.time_ns()
                content = content_of(messages.from_bytes(cdr, kinds[name]), kinds[name])
                print(json.dumps({"topic": name, "now_ns": now_ns, **content}), flush=True)
    bus.close()


def see(topic: str) -> None:
    """What the source sees, and what it says where it sees nothing."""
    (bus := open_bus("auto")).close()
    print(json.dumps({"by": type(bus).__name__}), flush=True)
    source = Ros2SourceConfig(topic=topic).open()
    while True:
        try:
            seen = source.read(0.2)
        except InputError as error:
            print(json.dumps({"refused": str(error)}), flush=True)
            continue
        if seen is not None:
            sum_mm = float(np.nansum(seen.content.depth_mm))
            print(json.dumps({"stamp_ns": seen.stamp_ns, "sum_mm": sum_mm}), flush=True)


def content_of(message: object, kind: str) -> dict:
    if kind == MARKERS:
        markers = [[m.ns, int(m.action), len(m.points)] for m in message.markers]
        return {"stamp_ns": stamp_of(message.markers[0].header), "markers": markers}
    content = {"stamp_ns": stamp_of(message.header), "frame": message.header.frame_id}
    if kind == CLOUD:
        return {**content, "points": int(message.width), "sum": int(message.data.sum())}
    if kind == DIAGNOSTICS:
        return {**content, "level": int(message.status[0].level), "text": message.status[0].message}
    return {**content, "m": [message.point.x, message.point.y, message.point.z]}


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # and it leaves the graph
    if sys.argv[1] == "send":
        send(sys.argv[2], float(sys.argv[3]), float(sys.argv[4]))
    elif sys.argv[1] == "tf":
        transforms(float(sys.argv[2]), float(sys.argv[3]))
    elif sys.argv[1] == "see":
        see(sys.argv[2])
    else:
        hear(float(sys.argv[2]))
