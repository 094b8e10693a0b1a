"""ROS 2's topics without ROS: what is announced, asked for and refused."""

from __future__ import annotations

import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cyclonedds import core

import needs
from clock import Clock, until
from live_objects import (
    empty_update,
    small_frame,
    small_setting,
    small_update,
)
from refused import refused
from ros2_objects import DOMAIN, Frames, own_graph
from ros2_peer import points_mm
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.types import SensorCloud
from tumortrack.live.values import Observation, Source
from tumortrack_devices.ros import sensors
from tumortrack_devices.ros.bus import Bus, open_bus
from tumortrack_devices.ros.dds import dds_name, idl_type, ros_name
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import JOINTS, MARKERS, ResultMessages
from tumortrack_devices.ros.sensors import messages_seen, plain_cloud
from tumortrack_devices.sinks.moveit import SCENE
from tumortrack_devices.sinks.ros import ACKNOWLEDGE, ASKED, place_of
from tumortrack_devices.sinks.ros import Ros2SinkConfig as SinkRos2
from tumortrack_devices.sources.ros import Ros2SourceConfig as SourceRos2
from workcell_objects import with_arms, working

needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")

IDENTITY = Path(__file__).parent / "support"


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


@pytest.mark.parametrize("kind", [sensors.CLOUD, sensors.CAMERA_INFO, MARKERS, JOINTS, SCENE])
def test_types_agree_with_a_second_encoder(kind: str, messages: Messages) -> None:
    """cyclonedds' own (slow) coding of our type gives the bytes that rosbags gives."""
    seen = Observation(small_frame(), 0)
    cloud = Observation(SensorCloud(points_mm()[:7], 12_000_000_034), 0)
    made = [*messages_seen(seen, messages), *messages_seen(cloud, messages)]
    made += ResultMessages(messages, with_arms()).messages(working())
    if kind == SCENE:
        message = messages.make(SCENE, name="room", is_diff=True, robot_state={"is_diff": True})
    else:
        message = next(one.message for one in made if one.message_type == kind)
    cdr = bytes(messages.to_bytes(message))
    type_ = idl_type(kind)
    value = type_.deserialize(cdr)
    assert value.serialize(use_version_2=False)[: len(cdr)] == cdr
    if kind == sensors.CLOUD:
        assert (value.header.stamp.sec, value.header.stamp.nanosec, value.width) == (12, 34, 7)
    assert type_.__idl__.idl_transformed_typename == dds_name(kind)
    assert ros_name(dds_name(kind)) == kind
    assert ros_name("a::msg::dds_::B") == ""  # none of ROS


def test_a_topic_that_nobody_publishes_is_said_with_those_there_are(bus: Bus, monkeypatch) -> None:
    clock = Clock()
    monkeypatch.setattr("tumortrack_devices.sources.ros.time", clock)
    source = SourceRos2(topic="/camera/depht/image").open()
    bus.publisher("/camera/depth/image", sensors.IMAGE)
    bus.publisher("/camera/depth/camera_info", sensors.CAMERA_INFO)
    try:
        until(lambda: "/camera/depth/image" in bus.topics())
        assert source.read(0.0) is None  # it may not be heard of yet
        clock.sleep(2.1)
        with refused(InputError, "/camera/depht/image", "/camera/depth/image."):
            source.read(0.0)
        bus.publisher("/camera/depht/image", sensors.IMAGE)
        until(lambda: "/camera/depht/image" in bus.topics())
        assert source.read(0.0) is None  # and now it is listened to
    finally:
        source.close()


def test_what_other_nodes_see_of_a_program_that_comes_and_goes(bus: Bus) -> None:
    """Name, type, type hash and QoS are those that a ROS 2 node announces, of one participant
    however often topics are opened. Writers and readers end with whoever opened them."""
    from cyclonedds import builtin
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.qos import Policy

    other = DomainParticipant(int(DOMAIN))
    published, read, everyone = (
        builtin.BuiltinDataReader(other, topic)
        for topic in (
            builtin.BuiltinTopicDcpsPublication,
            builtin.BuiltinTopicDcpsSubscription,
            builtin.BuiltinTopicDcpsParticipant,
        )
    )

    def of(reader: builtin.BuiltinDataReader) -> list:
        alive = core.ReadCondition(reader, core.InstanceState.Alive | 0xF)
        return [one for one in reader.read(100, alive) if one.topic_name == "rt/again/points"]

    for _ in range(3):
        again = open_bus("dds")
        publish = again.publisher("/again/points", sensors.CLOUD)
        heard = again.subscriber("/again/points", sensors.CLOUD)
        (one,) = until(lambda: of(published))
        until(lambda: of(read))
        assert bus.topics()["/again/points"] == {sensors.CLOUD}
        again.close()
        until(lambda: not of(published) and not of(read) and "/again/points" not in bus.topics())
        publish(b"held, and ended all the same")
        assert heard.take() == []
    assert one.type_name == "sensor_msgs::msg::dds_::PointCloud2_"
    # As `ros2 topic info -v` prints it for sensor_msgs/msg/PointCloud2.
    said = "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    assert one.qos[Policy.Userdata].data == f"typehash=RIHS01_{said};".encode()
    assert isinstance(one.qos[Policy.Reliability], Policy.Reliability.Reliable)
    assert one.qos[Policy.Durability] == Policy.Durability.Volatile
    # Not those of programs that other tests have ended: they stay for their lease of 10 s.
    pid = f'key="__Pid", value="{os.getpid()}"'
    mine = {each.key for each in everyone.read(100) if pid in str(each.qos)}
    assert mine == {one.participant_key, other.guid}


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
        self, source: Source, seen: Observation, this: str, extra_status: Observation | None = None
    ) -> None:
        """Until it is refused for ``this``."""
        for _ in range(100):
            if extra_status is not None:
                self.send(extra_status, ("depth/image_rect",))
            try:
                self.until(source, seen)
            except InputError as error:
                if this in str(error):
                    return
        raise AssertionError("never refused")


def test_what_belongs_to_an_image_is_asked_for(bus: Bus) -> None:
    frames = Sender(bus, "/a")
    source = SourceRos2(topic="/a/depth/image_rect", mask="/a/mask").open()
    now = small_frame(time.time_ns())
    old = small_frame(now.stamp_ns - 2_000_000_000)
    mask = np.ones((48, 64), bool)
    alone = Observation(now, 0)
    try:
        with refused(InputError, "/a/depth/camera_info"):
            frames.until(source, alone, ("depth/camera_info",))
        frames.refused(source, alone, "/a/mask")
        frames.refused(source, alone, "2.00 s", Observation(old, 0, mask))
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


@pytest.mark.parametrize(
    ("name", "frame", "topics"),
    [
        ("tumortrack.rviz", "camera", ["cloud", "meshes"]),
        (
            "resection.rviz",
            "table",
            ["cloud", "links", "meshes", "observed", "planned", "workcell"],
        ),
    ],
)
def test_the_view_for_rviz_shows_what_is_published(
    name: str, frame: str, topics: list[str], messages: Messages
) -> None:
    """Topics, frame and reliability of the views are the sink's."""
    folder = IDENTITY.parents[1] / "integrations" / "ros2" / "tumortrack_ros" / "rviz"
    view = (folder / name).read_text(encoding="utf-8")
    out = ResultMessages(messages, with_arms()).messages(empty_update())
    sent = {one.topic("/tumortrack") for one in out}
    shown = set(re.findall(r"Value: (/tumortrack\S+)", view))
    assert sorted(shown) == [f"/tumortrack/{topic}" for topic in topics]
    assert shown < sent
    assert f"Fixed Frame: {frame}" in view
    # A subscriber that wants what was published before does not hear a volatile publisher.
    assert re.findall(r"Transient Local\n.*\n.*\n +Value: (\S+)", view) == (
        ["/tumortrack/links", "/tumortrack/planned", "/robot_description"]
        if name == "resection.rviz"
        else []
    )


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
            seen(messages.to_bytes(messages.make(kind)))
            return heard()

        until(said, "it was heard")
    finally:
        sink.close()


def test_a_user_halts_forgets_and_points_at_the_organ(bus: Bus, messages: Messages) -> None:
    """Arms are halted where some are controlled; elsewhere nobody listens for it."""
    setting, unarmed, update = with_arms(), small_setting(), working()
    controls = setting.controls
    say = {name: bus.publisher(f"/tumortrack/{name}", kind) for name, kind in ASKED.items()}
    sink, other = SinkRos2().open(setting), SinkRos2().open(unarmed)

    def until_heard(name: str, heard: Callable[[], object], **content: object) -> None:
        def said() -> object:
            say[name](messages.to_bytes(messages.make(ASKED[name], **content)))
            sink.publish(update)
            if name != "point_at":  # in the frame of the table, of which it does not know
                other.publish(small_update())
            return heard()

        until(said, f"{name} was heard")

    def point_at(frame: str, *place: float) -> np.ndarray:
        controls.picked_mm = None
        until_heard(
            "point_at",
            lambda: controls.picked_mm is not None,
            header={"frame_id": frame},
            point=dict(zip("xyz", place, strict=True)),
        )
        return controls.picked_mm

    try:
        assert not controls.aborted.is_set()
        until_heard("halt", controls.aborted.is_set)
        until_heard(
            "forget", lambda: all(one.controls.forgotten.is_set() for one in (setting, unarmed))
        )
        assert not unarmed.controls.aborted.is_set()
        assert not controls.cut.is_set()
        until_heard("cut", lambda: controls.cut.is_set() and unarmed.controls.cut.is_set())
        np.testing.assert_allclose(point_at("table", 0.01, -0.02, 0.0), [10, -20, 0])
        np.testing.assert_allclose(point_at("camera", 0.01, -0.02, 0.13), [10, 20, 30], atol=1e-9)
    finally:
        sink.close()
        other.close()


@pytest.mark.parametrize(
    ("place", "frame", "named"),
    [
        ((0.0, 0.0, 0.1), "elsewhere", "elsewhere"),
        ((np.nan, 0.0, 0.1), "table", "nan"),
        ((320.0, 240.0, 0.0), "camera", "320"),  # a pixel
    ],
)
def test_what_is_no_place_of_the_organ_is_refused(
    place: tuple[float, float, float], frame: str, named: str
) -> None:
    with refused(InputError, named):
        place_of(np.array(place), frame, working())


def test_other_types_are_refused(bus: Bus) -> None:
    bus.publisher("/text", "std_msgs/msg/String")
    source = SourceRos2(topic="/text").open()
    try:
        with refused(InputError, "std_msgs/msg/String"):
            until(lambda: source.read(0.2))
    finally:
        source.close()


def test_damaged_bytes_are_not_sent(bus: Bus, messages: Messages) -> None:
    header = messages.header(5, "camera")
    cdr = bytes(messages.to_bytes(plain_cloud(SensorCloud(points_mm()[:9]), header, messages)))
    publish = bus.publisher("/points", sensors.CLOUD)
    publish(cdr)
    with refused(TumortrackError, "/points"):
        publish(cdr[:60])


@pytest.mark.parametrize(
    "options",
    [
        {"topic": "points"},
        {"topic": "/a/"},
        {"topic": "/a/2b"},
        {"topic": "/a", "info": "b c"},
        {"topic": "/a", "type": "cloud", "mask": "/m"},
        {"topic": "/a", "unit_mm": 0.0},
    ],
)
def test_options_that_cannot_be(options: dict) -> None:
    with pytest.raises(InputError):
        SourceRos2(**options)


# In a domain that this process has not joined yet.
BAD_URI = "<CycloneDDS><Domain><Bad/></Domain></CycloneDDS>"


@pytest.mark.parametrize(
    ("variables", "via"),
    [({"ROS_DOMAIN_ID": domain}, "dds") for domain in ("233", "-1", "1.5", "home", "²")]
    + [({"ROS_DOMAIN_ID": "101", "ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, "dds")]
    + [({"ROS_DOMAIN_ID": "101", "CYCLONEDDS_URI": BAD_URI}, "dds"), ({}, "rclpy")],
)
def test_environments_that_cannot_be(variables: dict, via: str, monkeypatch) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError):
        open_bus(via)
