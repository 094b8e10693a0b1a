"""ROS 2's topics without ROS: what is announced, asked for and refused."""

from __future__ import annotations

import os
import re
import secrets
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import needs
from clock import PATIENCE_S, until
from live_objects import (
    empty_update,
    small_frame,
    small_setting,
    small_update,
)
from ros2_objects import Frames, own_graph, read_until, sending
from ros2_peer import points_mm
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.types import SensorCloud
from tumortrack.live.spec import POSES, SINKS, SOURCES, TOOLS, Registry
from tumortrack.live.values import Observation, Source
from tumortrack.live.workers import SourceWorker
from tumortrack_devices.ros import sensors
from tumortrack_devices.ros.bus import Bus
from tumortrack_devices.ros.dds import dds_name, domain_id, idl_type, ros_name
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import JOINTS, MARKERS, ResultMessages
from tumortrack_devices.ros.ros2 import open_bus
from tumortrack_devices.ros.sensors import messages_seen, plain_cloud
from tumortrack_devices.sinks.ros import ACKNOWLEDGE
from tumortrack_devices.sinks.ros import Ros2SinkConfig as SinkRos2
from tumortrack_devices.sources.ros import Ros2SourceConfig as SourceRos2
from workcell_objects import with_arms, working

needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")

HERE = Path(__file__).parent / "support"
CLOUD_DDS = "sensor_msgs::msg::dds_::PointCloud2_"


@pytest.fixture(autouse=True)
def _own_graph() -> Iterator[None]:
    with own_graph():
        yield


@pytest.fixture
def bus() -> Iterator[Bus]:
    joined = open_bus("dds")
    yield joined
    joined.close()


@pytest.fixture
def messages() -> Messages:
    return Messages()


# --- types ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [sensors.CLOUD, sensors.CAMERA_INFO, MARKERS, JOINTS])
def test_types_agree_with_a_second_encoder(kind: str, messages: Messages) -> None:
    """cyclonedds' own (slow) coding of our type gives the bytes that rosbags gives."""
    seen = Observation(small_frame(), 0)
    cloud = Observation(SensorCloud(points_mm()[:7], 12_000_000_034), 0)
    made = [*messages_seen(seen, messages), *messages_seen(cloud, messages)]
    made += ResultMessages(messages, with_arms()).of(working())
    message = next(one.message for one in made if one.message_type == kind)
    cdr = bytes(messages.to_bytes(message))
    type_ = idl_type(kind)
    value = type_.deserialize(cdr)
    assert value.serialize(use_version_2=False)[: len(cdr)] == cdr
    if kind == sensors.CLOUD:
        assert (value.header.stamp.sec, value.header.stamp.nanosec, value.width) == (12, 34, 7)
    assert type_.__idl__.idl_transformed_typename == dds_name(kind)
    assert ros_name(dds_name(kind)) == kind


def test_names_that_are_none_of_ros() -> None:
    assert ros_name("HelloWorld") == ""
    assert ros_name("a::msg::dds_::B") == ""


def test_what_other_nodes_see_of_a_topic(bus: Bus) -> None:
    """Name, type, type hash and QoS are those that a ROS 2 node announces."""
    from cyclonedds.qos import Policy

    publisher = bus.publisher("/seen/points", sensors.CLOUD)
    known = lambda: [o for o in bus._published.read(100) if o.topic_name == "rt/seen/points"]  # noqa: E731
    (one,) = until(known)
    assert one.type_name == CLOUD_DDS
    assert bus.types_of("/seen/points") == {sensors.CLOUD}
    # As `ros2 topic info -v` prints it for sensor_msgs/msg/PointCloud2.
    said = "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    assert one.qos[Policy.Userdata].data == f"typehash=RIHS01_{said};".encode()
    assert isinstance(one.qos[Policy.Reliability], Policy.Reliability.Reliable)
    assert one.qos[Policy.Durability] == Policy.Durability.Volatile
    assert publisher  # it lives as long as whoever asked for it holds it


def test_a_topic_that_nobody_publishes_is_said_with_those_there_are(bus, monkeypatch) -> None:
    source = SourceRos2(topic="/camera/depht/image").open()
    try:
        assert source.read(0.0) is None  # it may not be heard of yet
        monkeypatch.setattr("tumortrack_devices.sources.ros._ALONE_S", 0.0)
        with pytest.raises(InputError, match="/camera/depht/image; nor any image or cloud"):
            source.read(0.0)
        publishers = [bus.publisher("/camera/depth/image", sensors.IMAGE)]
        publishers += [bus.publisher("/camera/depth/camera_info", sensors.CAMERA_INFO)]
        until(lambda: bus.types_of("/camera/depth/camera_info"))
        with pytest.raises(InputError, match=r"clouds seen: /camera/depth/image\. Look at the top"):
            source.read(0.0)
        publishers.append(bus.publisher("/camera/depht/image", sensors.IMAGE))
        until(lambda: bus.types_of("/camera/depht/image"))
        assert source.read(0.0) is None  # and now it is listened to
    finally:
        source.close()


def test_a_program_joins_once_and_what_it_left_is_gone(bus: Bus) -> None:
    """One participant however often topics are opened; their types are never freed, for Cyclone
    reads them without a lock. Writers and readers end with whoever opened them."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant

    for _ in range(3):
        again = open_bus("dds")
        publisher = again.publisher("/again/points", sensors.CLOUD)
        until(lambda: bus.types_of("/again/points") == {sensors.CLOUD})
        again.close()
        until(lambda: not bus.types_of("/again/points"))
        assert publisher  # held, and ended all the same
    everyone = BuiltinDataReader(bus._published.participant, BuiltinTopicDcpsParticipant)
    # Not those of programs that other tests have ended: they stay for their lease of 10 s.
    pid = f'key="__Pid", value="{os.getpid()}"'
    mine = [one.key for one in everyone.read(100) if pid in str(one.qos)]
    assert mine == [bus._published.participant.guid]


# --- the source ----------------------------------------------------------------------------------


class Sender(Frames):
    """Sends frames from this process, until something comes of it."""

    def until(
        self, source: Source, seen: Observation, leave_out: tuple[str, ...] = ()
    ) -> Observation:
        """Send again and again until it is seen (or refused: raises)."""

        def got() -> Observation | None:
            self.send(seen, leave_out)
            return source.read(0.05)

        return until(got, "a frame")

    def refused(
        self, source: Source, seen: Observation, not_this: str, beside: Observation | None = None
    ) -> str:
        """The first refusal that does not say ``not_this``."""
        for _ in range(100):
            if beside is not None:
                self.send(beside, ("depth/image_rect",))
            try:
                self.until(source, seen)
            except InputError as error:
                if not_this not in str(error):
                    return str(error)
        raise AssertionError("never refused")


def test_what_belongs_to_an_image_is_asked_for(bus: Bus) -> None:
    frames = Sender(bus, "/a")
    source = SourceRos2(topic="/a/depth/image_rect", mask="/a/mask").open()
    now = small_frame(time.time_ns())
    old = small_frame(now.stamp_ns - 2_000_000_000)
    mask = np.ones((48, 64), bool)
    alone = Observation(now, 0)
    try:
        with pytest.raises(InputError, match=r"no camera_info on /a/depth/camera_info.*\?info="):
            frames.until(source, alone, ("depth/camera_info",))
        refused = frames.refused(source, alone, "camera_info")
        assert "no mask came on /a/mask" in refused
        frames.send(Observation(old, 0, mask), ("depth/image_rect",))
        refused = frames.refused(source, alone, "so far", Observation(old, 0, mask))
        assert "2.00 s older" in refused
        assert frames.until(source, Observation(now, 0, mask)).mask is not None
    finally:
        source.close()


@pytest.mark.parametrize(
    ("offset_s", "clock", "host"),
    [(0, "auto", True), (-20, "auto", True), (-3600, "auto", True), (-90_000, "auto", False)]
    + [(-90_000, "host", True), (0, "other", False)],
)
def test_whose_clock(offset_s: int, clock: str, host: bool, bus: Bus) -> None:
    """A stream that lags by seconds is not taken for one with a clock of its own."""
    place = f"/clock_{secrets.token_hex(4)}"
    source = SourceRos2(topic=f"{place}/points", clock=clock).open()
    begin_ns = time.time_ns()
    stamp_ns = begin_ns + offset_s * 1_000_000_000
    try:
        cloud = Observation(SensorCloud(points_mm()[:9], stamp_ns), 0)
        seen = Sender(bus, place).until(source, cloud)
        assert source.host_clock is host
        assert seen.stamp_ns == stamp_ns
        assert begin_ns <= seen.arrived_ns <= time.time_ns()
    finally:
        source.close()


def test_the_loop_counts_ages_from_the_stamp_once_a_frame_came() -> None:
    with sending("cloud") as topic:
        reader = SourceWorker(SourceRos2(topic=topic).open)
        seen = reader.take(PATIENCE_S)
        assert reader.latency_from == "stamp"
        assert reader.born_ns(seen) == seen.stamp_ns
        reader.close()


@pytest.mark.parametrize(
    ("name", "frame", "topics"),
    [
        ("tumortrack.rviz", "camera", ["cloud", "meshes"]),
        ("resection.rviz", "table", ["cloud", "meshes", "observed", "planned", "workcell"]),
    ],
)
def test_the_view_for_rviz_shows_what_is_published(
    name: str, frame: str, topics: list[str], messages: Messages
) -> None:
    """Topics, frame and reliability of the views are the sink's."""
    folder = HERE.parents[2] / "integrations" / "ros2" / "tumortrack_ros" / "rviz"
    view = (folder / name).read_text(encoding="utf-8")
    out = ResultMessages(messages, with_arms()).of(empty_update())
    sent = {one.topic("/tumortrack") for one in out}
    shown = set(re.findall(r"Value: (/tumortrack\S+)", view))
    assert sorted(shown) == [f"/tumortrack/{topic}" for topic in topics]
    assert shown < sent
    assert f"Fixed Frame: {frame}" in view
    # A subscriber that wants what was published before does not hear a volatile publisher.
    assert re.findall(r"Transient Local\n.*\n.*\n +Value: (\S+)", view) == (
        ["/tumortrack/planned", "/robot_description"] if name == "resection.rviz" else []
    )


def test_arms_travel_over_dds(bus: Bus, messages: Messages) -> None:
    kinds = {"joint_states": JOINTS, "workcell": MARKERS}
    heard = {name: bus.subscriber(f"/arms/{name}", kind) for name, kind in kinds.items()}
    sink = SinkRos2(namespace="/arms", mesh_hz=0.0, via="dds").open(with_arms())
    came: dict = {}
    for n in range(200):
        update = working(n, 0.25)
        sink.publish(update)
        bus.wait(0.05)
        came |= {
            name: messages.from_bytes(raw, kinds[name])
            for name, one in heard.items()
            for raw in one.take()
        }
        if len(came) == 2:
            break
    sink.close()
    assert update.workcell is not None
    joints = came["joint_states"]
    assert dict(zip(joints.name, joints.position, strict=True)) == update.workcell.joints_rad
    markers = {marker.ns: marker for marker in came["workcell"].markers}
    for shape in update.workcell.shapes:
        assert len(markers[shape.name].points) == shape.mesh.faces.size
    assert markers["state"].text == "sweep 1"


def test_who_has_seen_what_contradicts_says_so_on_a_topic(bus: Bus, messages: Messages) -> None:
    setting, (topic, kind) = small_setting(), ACKNOWLEDGE
    seen = bus.publisher(f"/tumortrack/{topic}", kind)
    sink = SinkRos2().open(setting)

    def heard() -> bool:
        sink.publish(small_update())
        return setting.controls.acknowledged.is_set()

    try:
        assert not heard()

        def said() -> bool:
            seen.publish(messages.to_bytes(messages.make(kind)))
            return heard()

        until(said, "it was heard")
    finally:
        sink.close()


def test_other_types_are_refused(bus: Bus, messages: Messages) -> None:
    publisher = bus.publisher("/text", "std_msgs/msg/String")
    publisher.publish(messages.to_bytes(messages.make("std_msgs/msg/String", data="hello")))
    source = SourceRos2(topic="/text").open()
    try:
        with pytest.raises(InputError, match="/text is published as std_msgs/msg/String"):
            read_until(source)
    finally:
        source.close()


def test_damaged_bytes_are_not_sent(bus: Bus, messages: Messages) -> None:
    header = messages.header(5, "camera")
    cdr = bytes(messages.to_bytes(plain_cloud(SensorCloud(points_mm()[:9]), header, messages)))
    publisher = bus.publisher("/points", sensors.CLOUD)
    publisher.publish(cdr)
    with pytest.raises(TumortrackError, match=r"/points: a message of \d+ bytes was not sent"):
        publisher.publish(cdr[:60])


@pytest.mark.parametrize("kinds", [SOURCES, SINKS, POSES, TOOLS])
def test_whoever_asks_for_ros_1_is_told_what_to_do(kinds: Registry) -> None:
    with pytest.raises(InputError, match=r"ROS 1 was removed.*ros1_bridge.*recording:PATH"):
        kinds.parse("ros1:/camera/points?unit_mm=1")


@pytest.mark.parametrize("value", ["233", "-1", "1.5", "home", "²"])
def test_domains_that_are_none(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", value)
    with pytest.raises(InputError, match=r"whole number in 0\.\.232"):
        domain_id()


def test_a_graph_in_which_nothing_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "off")
    monkeypatch.setenv("ROS_DOMAIN_ID", "101")  # one that this process has not joined yet
    with pytest.raises(InputError, match="is OFF"):
        SourceRos2(topic="/points", via="dds").open()


def test_a_network_that_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS><Domain><Bad/></Domain></CycloneDDS>")
    monkeypatch.setenv("ROS_DOMAIN_ID", "101")
    with pytest.raises(InputError, match=r"domain 101 cannot be joined.*CYCLONEDDS_URI"):
        SourceRos2(topic="/points", via="dds").open()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"topic": "points"}, "no full topic name"),
        ({"topic": "/a/"}, "no full topic name"),
        ({"topic": "/a/2b"}, "no full topic name"),
        ({"topic": "/a", "info": "b c"}, "no full topic name"),
        ({"topic": "/a", "type": "cloud", "mask": "/m"}, "belong to a depth image"),
        ({"topic": "/a", "unit_mm": 0.0}, "unit_mm"),
    ],
)
def test_options_that_cannot_be(options: dict, said: str) -> None:
    with pytest.raises(InputError, match=said):
        SourceRos2(**options)


def test_without_rclpy_it_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"rclpy cannot be imported.*via=dds"):
        SourceRos2(topic="/points", via="rclpy").open()
