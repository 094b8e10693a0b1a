"""ROS 2's topics without ROS: other processes, a second maker's DDS, and what can go wrong."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest

from live_objects import (
    CAMERA,
    PARTS,
    empty_update,
    small_estimate,
    small_frame,
    small_setting,
    small_update,
)
from ros2_objects import DOMAIN, Frames, own_graph, sending
from ros2_peer import frame_numbered, points_mm
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.types import OccupancyCloud, SensorCloud
from tumortrack.track.estimate import Estimate
from tumortrack.track.live import Seen, Sink, Source, Update
from tumortrack.track.reader import Reader
from tumortrack.track.ros import incoming
from tumortrack.track.ros.bus import Bus, domain_id, open_bus
from tumortrack.track.ros.dds_types import dds_name, idl_type, ros_name
from tumortrack.track.ros.messages import Messages
from tumortrack.track.ros.observed import messages_seen, plain_cloud
from tumortrack.track.ros.outgoing import MARKERS, messages_of
from tumortrack.track.sinks.ros2 import Ros2 as SinkRos2
from tumortrack.track.sources.ros2 import Ros2 as SourceRos2

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed (tumortrack[live])")

HERE = Path(__file__).parent
N_TOPICS = 3 + len(PARTS)
CLOUD_DDS = "sensor_msgs::msg::dds_::PointCloud2_"


@pytest.fixture(autouse=True)
def _own_graph() -> Iterator[None]:
    with own_graph():
        yield


@pytest.fixture
def messages() -> Messages:
    return Messages()


@pytest.fixture
def bus(messages: Messages) -> Iterator[Bus]:
    joined = open_bus("dds", messages)
    yield joined
    joined.close()


class Other:
    """Another process; what it says is read at once, so that it never waits for us."""

    def __init__(self, *command: object) -> None:
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdout=subprocess.PIPE,
            text=True,
            cwd=HERE,
            start_new_session=True,
        )
        self._said: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        for line in self._process.stdout:
            self._said.put(line)

    def line(self, timeout_s: float = 20.0) -> str:
        return self._said.get(timeout=timeout_s)

    def lines_until(self, good: Callable[[dict], bool]) -> list[dict]:
        """What it said (JSON), up to the first line that is good."""
        said = [json.loads(self.line())]
        while not good(said[-1]):
            said.append(json.loads(self.line()))
        return said

    def topics_until(self, good: Callable[[dict[str, dict]], bool]) -> dict[str, dict]:
        """The last message of each topic, once they are good together. Topics race."""
        last: dict[str, dict] = {}

        def heard(said: dict) -> bool:
            last[said.get("topic", "")] = said
            return len(last) >= N_TOPICS and good(last)

        self.lines_until(heard)
        return last

    def signal(self, number: int) -> None:
        os.killpg(self._process.pid, number)

    def end(self) -> None:
        self.signal(signal.SIGKILL)
        self._process.wait()
        self._thread.join()


@contextmanager
def process(*command: object) -> Iterator[Other]:
    other = Other(*command)
    try:
        yield other
    finally:
        other.end()


@contextmanager
def peer(*arguments: object) -> Iterator[Other]:
    with process(sys.executable, HERE / "ros2_peer.py", *arguments) as other:
        yield other


def read_until(source: Source, seconds: float) -> Seen:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        if (seen := source.read(0.2)) is not None:
            return seen
    raise AssertionError(f"nothing came in {seconds} s")


def large_update(sequence: int, n: int = 40_000) -> Update:
    """An update with ``n`` points, stamped now."""
    stamp_ns = time.time_ns()
    small = small_estimate(stamp_ns)
    points = np.resize(small.cloud.points_mm, (n, 3))
    cloud = OccupancyCloud(points, np.ones(n, np.uint8), np.full(n, 0.5, np.float32), stamp_ns)
    estimate = Estimate(cloud, None, small.meshes, small.report)
    return Update(sequence=sequence, stamp_ns=stamp_ns, estimate=estimate, quality="good")


# --- types ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [incoming.CLOUD, incoming.CAMERA_INFO, MARKERS])
def test_types_agree_with_a_second_encoder(kind: str, messages: Messages) -> None:
    """cyclonedds' own (slow) coding of our type gives the bytes that rosbags gives."""
    seen = Seen(small_frame(), 0)
    cloud = Seen(SensorCloud(points_mm()[:7], 12_000_000_034), 0)
    made = [*messages_seen(seen, messages), *messages_seen(cloud, messages)]
    made += messages_of(small_update(), messages, PARTS)
    message = next(one.message for one in made if one.message_type == kind)
    cdr = bytes(messages.to_bytes(message))
    type_ = idl_type(kind, "humble")
    value = type_.deserialize(cdr)
    assert value.serialize(use_version_2=False)[: len(cdr)] == cdr
    if kind == incoming.CLOUD:
        assert (value.header.stamp.sec, value.header.stamp.nanosec, value.width) == (12, 34, 7)
    assert type_.__idl__.idl_transformed_typename == dds_name(kind)
    assert ros_name(dds_name(kind)) == kind


def test_names_that_are_none_of_ros() -> None:
    assert ros_name("HelloWorld") == ""
    assert ros_name("a::msg::dds_::B") == ""
    with pytest.raises(InputError, match="no message type"):
        idl_type("sensor_msgs/msg/Nothing", "humble")


def test_what_other_nodes_see_of_a_topic(bus: Bus) -> None:
    """Name, type, type hash and QoS are those that a ROS 2 node announces."""
    from cyclonedds.qos import Policy

    publisher = bus.publisher("/seen/points", incoming.CLOUD)
    for _ in range(50):
        known = [one for one in bus._published.read(100) if one.topic_name == "rt/seen/points"]
        if known:
            break
        time.sleep(0.05)
    (one,) = known
    assert one.type_name == CLOUD_DDS
    assert bus.types_of("/seen/points") == {incoming.CLOUD}
    # As `ros2 topic info -v` prints it for sensor_msgs/msg/PointCloud2.
    said = "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    assert one.qos[Policy.Userdata].data == f"typehash=RIHS01_{said};".encode()
    assert isinstance(one.qos[Policy.Reliability], Policy.Reliability.Reliable)
    assert one.qos[Policy.Durability] == Policy.Durability.Volatile
    assert publisher  # it lives as long as whoever asked for it holds it


# --- the source ----------------------------------------------------------------------------------


def test_depth_images_from_another_process() -> None:
    source = SourceRos2(topic="/camera/depth/image_rect", mask="/camera/mask").open()
    assert isinstance(source, Source)
    try:
        assert source.read(0.1) is None  # nobody there is no fault
        with peer("send", "image", 60, 30):
            first = complete(lambda: read_until(source, 10))
            assert source.host_clock
            assert first.mask is not None
            assert np.array_equal(first.mask, np.arange(48 * 64).reshape(48, 64) % 3 == 0)
            assert first.content.intrinsics == CAMERA
            for _ in range(5):
                seen = read_until(source, 2)
                number = round(float(seen.content.depth_mm[0, 0]) - 100)
                expected = frame_numbered(number, 0).depth_mm
                np.testing.assert_allclose(seen.content.depth_mm, expected, rtol=2e-7)
                assert seen.stamp_ns > first.stamp_ns
            before = source.dropped
            time.sleep(0.4)
            fresh = source.read(0.2)
            assert fresh is not None
            assert time.time_ns() - fresh.stamp_ns < 200_000_000  # the newest, not what waited
            assert source.dropped > before
        while source.read(0.3) is not None:
            pass
        assert source.read(0.3) is None  # the publisher is gone
        with peer("send", "image", 60, 30):
            again = complete(lambda: read_until(source, 10))
            assert again.stamp_ns > fresh.stamp_ns
    finally:
        source.close()


def complete(read: Callable[[], Seen]) -> Seen:
    """The first frame that has all it needs; what belongs to it comes on topics of its own."""
    for _ in range(100):
        with contextlib.suppress(InputError):
            return read()
    raise AssertionError("neither mask nor camera_info came")


def test_clouds_of_40_000_points_at_30_hz() -> None:
    source = SourceRos2(topic="/camera/points", type="cloud").open()
    ages_ms = []
    try:
        with peer("send", "cloud", 30, 30):
            read_until(source, 10)
            end_s = time.monotonic() + 2
            while time.monotonic() < end_s:
                seen = source.read(0.2)
                if seen is not None:
                    ages_ms.append((time.time_ns() - seen.stamp_ns) * 1e-6)
        np.testing.assert_allclose(seen.content.points_mm, points_mm(), rtol=2e-7)
    finally:
        source.close()
    p50, p95 = np.percentile(ages_ms, [50, 95])
    print(f"40k points: {len(ages_ms) / 2:.1f} Hz, p50 {p50:.2f} ms, p95 {p95:.2f} ms")
    assert len(ages_ms) > 30


class Sender(Frames):
    """Sends frames from this process, until something comes of it."""

    def until(self, source: Source, seen: Seen, leave_out: tuple[str, ...] = ()) -> Seen:
        """Send again and again until it is seen (or refused: raises)."""
        for _ in range(100):
            self.send(seen, leave_out)
            if (got := source.read(0.05)) is not None:
                return got
        raise AssertionError("nothing came")

    def refused(self, source: Source, seen: Seen, not_this: str, beside: Seen | None = None) -> str:
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


def test_what_belongs_to_an_image_is_asked_for(bus: Bus, messages: Messages) -> None:
    frames = Sender(bus, messages, "/a")
    source = SourceRos2(topic="/a/depth/image_rect", mask="/a/mask").open()
    now = small_frame(time.time_ns())
    old = small_frame(now.stamp_ns - 2_000_000_000)
    mask = np.ones((48, 64), bool)
    alone = Seen(now, 0)
    try:
        with pytest.raises(InputError, match=r"no camera_info on /a/depth/camera_info.*\?info="):
            frames.until(source, alone, ("depth/camera_info",))
        refused = frames.refused(source, alone, "camera_info")
        assert "no mask came on /a/mask" in refused
        frames.send(Seen(old, 0, mask), ("depth/image_rect",))
        refused = frames.refused(source, alone, "so far", Seen(old, 0, mask))
        assert "2.00 s older" in refused
        assert frames.until(source, Seen(now, 0, mask)).mask is not None
    finally:
        source.close()


@pytest.mark.parametrize(
    ("offset_s", "clock", "host"),
    [(0, "auto", True), (-20, "auto", True), (-3600, "auto", False), (-3600, "host", True)]
    + [(0, "other", False)],
)
def test_whose_clock(offset_s: int, clock: str, host: bool, bus: Bus, messages: Messages) -> None:
    """A stream that lags by seconds is not taken for one with a clock of its own."""
    place = f"/clock_{secrets.token_hex(4)}"
    source = SourceRos2(topic=f"{place}/points", clock=clock).open()
    stamp_ns = time.time_ns() + offset_s * 1_000_000_000
    try:
        cloud = Seen(SensorCloud(points_mm()[:9], stamp_ns), 0)
        seen = Sender(bus, messages, place).until(source, cloud)
        assert source.host_clock is host
        assert seen.stamp_ns == stamp_ns
        assert abs(seen.arrived_ns - time.time_ns()) < 5_000_000_000
    finally:
        source.close()


def test_the_loop_counts_ages_from_the_stamp_once_a_frame_came() -> None:
    with sending("cloud") as topic:
        reader = Reader(SourceRos2(topic=topic).open)
        seen = reader.take(10.0)
        assert reader.latency_from == "stamp"
        assert reader.born_ns(seen) == seen.stamp_ns
        reader.close()


def test_the_view_for_rviz_shows_what_is_published(messages: Messages) -> None:
    """Topics, frame and reliability of docs/ros/tumortrack.rviz are the sink's."""
    view = (HERE.parent / "docs" / "ros" / "tumortrack.rviz").read_text(encoding="utf-8")
    published = {f"/tumortrack/{one.suffix}" for one in messages_of(empty_update(), messages)}
    shown = set(re.findall(r"Value: (/\S+)", view))
    assert {"/tumortrack/cloud", "/tumortrack/meshes"} == shown
    assert shown < published
    assert "Fixed Frame: camera" in view
    assert "Transient Local" not in view  # that would not hear a volatile publisher


def test_other_types_are_refused(bus: Bus, messages: Messages) -> None:
    publisher = bus.publisher("/text", "std_msgs/msg/String")
    publisher.publish(messages.to_bytes(messages.make("std_msgs/msg/String", data="hello")))
    source = SourceRos2(topic="/text").open()
    try:
        with pytest.raises(InputError, match="/text is published as std_msgs/msg/String"):
            read_until(source, 5)
    finally:
        source.close()


def test_damaged_bytes_are_not_sent(bus: Bus, messages: Messages) -> None:
    header = messages.header(5, "camera")
    cdr = bytes(messages.to_bytes(plain_cloud(SensorCloud(points_mm()[:9]), header, messages)))
    publisher = bus.publisher("/points", incoming.CLOUD)
    publisher.publish(cdr)
    with pytest.raises(TumortrackError, match=r"/points: a message of \d+ bytes was not sent"):
        publisher.publish(cdr[:60])


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


# --- the sink ------------------------------------------------------------------------------------


def test_updates_reach_another_process(messages: Messages) -> None:
    sink = SinkRos2(mesh_hz=0).open(small_setting())
    assert isinstance(sink, Sink)
    update = small_update()
    expected = {one.suffix: one.message for one in messages_of(update, messages, PARTS)}
    try:
        with peer("hear", 60) as other:
            other.lines_until(lambda said: "listens" in said)
            by_topic = publish_until(sink, other, update)
            cloud = by_topic["cloud"]
            assert (cloud["points"], cloud["frame"]) == (500, "camera")
            assert cloud["sum"] == int(expected["cloud"].data.sum())
            assert cloud["stamp_ns"] == update.stamp_ns
            corners = {name: 3 * len(mesh.faces) for name, mesh in update.placed.meshes.items()}
            triangles = {ns: n for ns, _, n in by_topic["meshes"]["markers"] if ns in PARTS}
            assert triangles == corners
            centre_m = by_topic["tumor_1/center"]["m"]
            assert centre_m == pytest.approx([0.014, -0.003, 0.120], abs=1e-9)  # metres
            assert by_topic["diagnostics"]["level"] == 0

            sink.publish(empty_update())
            by_topic = other.topics_until(lambda last: at(last, empty_update().stamp_ns))
            assert by_topic["cloud"]["points"] == 0
            assert by_topic["meshes"]["markers"][0][1] == 3  # DELETEALL
            assert np.isnan(by_topic["tumor_1/center"]["m"]).all()
            assert by_topic["diagnostics"]["level"] == 2
            assert "only 12 points" in by_topic["diagnostics"]["text"]

            sink.publish(small_update(2))
            other.topics_until(lambda last: last["diagnostics"]["level"] == 0)
            sink.close()
            by_topic = other.topics_until(lambda last: last["diagnostics"]["level"] == 2)
            assert "ended" in by_topic["diagnostics"]["text"]
    finally:
        sink.close()
        sink.close()


def at(last: dict[str, dict], stamp_ns: int) -> bool:
    """All topics are at this stamp."""
    return {one["stamp_ns"] for one in last.values()} == {stamp_ns}


def publish_until(sink: Sink, other: Other, update: Update) -> dict[str, dict]:
    """Publish until the other end hears it on all topics; it may not be matched yet."""
    done = threading.Event()

    def again() -> None:
        while not done.is_set():
            sink.publish(update)
            done.wait(0.1)

    thread = threading.Thread(target=again)
    thread.start()
    try:
        return other.topics_until(lambda last: at(last, update.stamp_ns))
    finally:
        done.set()
        thread.join()


def test_subscribers_that_hang_die_and_come_late_hold_up_nobody() -> None:
    """40,000 points at 30 Hz go on whatever subscribers do."""
    sink = SinkRos2(mesh_hz=10).open(small_setting())
    try:
        with peer("hear", 60) as lively, peer("hear", 60) as other:
            for one in (lively, other):
                one.lines_until(lambda said: "listens" in said)
            publish_until(sink, lively, large_update(0))
            other.signal(signal.SIGSTOP)  # matched, and acknowledges nothing any more
            hung_ms = publish_at(sink, 30, 3.0)
            other.signal(signal.SIGKILL)
            killed_ms = publish_at(sink, 30, 0.5)
            last = ("cloud", sent_last(sink))
            heard = lively.lines_until(lambda one: (one["topic"], one["stamp_ns"]) == last)
            clouds = [one for one in heard if one["topic"] == "cloud"]
            ages_ms = [(one["now_ns"] - one["stamp_ns"]) * 1e-6 for one in clouds]
        with peer("hear", 60) as late:
            late.lines_until(lambda said: "listens" in said)
            by_topic = publish_until(sink, late, small_update(1000))
            assert by_topic["cloud"]["points"] == 500
    finally:
        sink.close()
    publish_ms = [*hung_ms, *killed_ms]
    p50, most = np.median(publish_ms), max(publish_ms)
    print(
        f"publishing 40k points beside a hung subscriber: p50 {p50:.1f} ms, most {most:.1f} ms; "
        f"the other one got {len(ages_ms)} of {len(publish_ms) + 1}, p50 "
        f"{np.median(ages_ms):.2f} ms"
    )
    assert np.percentile(publish_ms, 90) < 500
    assert len(ages_ms) > len(publish_ms) / 2


def sent_last(sink: Sink) -> int:
    """One more, whose stamp it gives back."""
    update = large_update(999)
    sink.publish(update)
    return update.stamp_ns


def publish_at(sink: Sink, hz: float, seconds: float) -> list[float]:
    """How long each call took, ms."""
    took_ms = []
    for number in range(int(hz * seconds)):
        start_s = time.monotonic()
        sink.publish(large_update(number))
        took_ms.append(1000 * (time.monotonic() - start_s))
        time.sleep(max(0.0, 1 / hz - (time.monotonic() - start_s)))
    return took_ms


# --- a second maker's DDS ------------------------------------------------------------------------


def built(folder: Path) -> Path:
    """The Fast DDS peer; skips where it cannot be built."""
    if not shutil.which("g++"):
        pytest.skip("g++ is not installed: see tools/debian-packages.txt")
    if not Path("/usr/include/fastdds").is_dir():
        pytest.skip("Fast DDS's headers are not installed: see tools/debian-packages.txt")
    made = folder / "peer"
    sources = ["-std=c++17", "-O0", str(HERE / "fastdds" / "peer.cpp"), "-o", str(made)]
    subprocess.run(["g++", *sources, "-lfastrtps", "-lfastcdr"], check=True, timeout=120)
    return made


def test_fast_dds_hears_and_is_heard(tmp_path: Path, bus: Bus, messages: Messages) -> None:
    """A cloud of ours arrives there byte for byte, an image from there here; noise does no harm."""
    program = built(tmp_path)
    files = []
    for suffix, kind, message in messages_seen(Seen(small_frame(), 0), messages):
        (tmp_path / suffix.replace("/", "_")).write_bytes(messages.to_bytes(message))
        files += [f"rt/fast/{suffix}", dds_name(kind), tmp_path / suffix.replace("/", "_")]
    noise = np.random.default_rng(1).integers(0, 256, 2000, np.uint8).tobytes()
    (tmp_path / "noise").write_bytes(bytes([0, 1, 0, 0]) + noise)
    files += ["rt/fast/noise", CLOUD_DDS, tmp_path / "noise"]

    header = messages.header(5, "camera")
    cloud = SensorCloud(points_mm()[:2000])
    cdr = bytes(messages.to_bytes(plain_cloud(cloud, header, messages)))
    ours = bus.publisher("/tumortrack/cloud", incoming.CLOUD)
    image = SourceRos2(topic="/fast/depth/image_rect").open()
    damaged = SourceRos2(topic="/fast/noise").open()
    heard = tmp_path / "heard"
    sub = ("sub", 4, "rt/tumortrack/cloud", CLOUD_DDS, heard)
    try:
        with (
            process(program, DOMAIN, *sub) as there,
            process(program, DOMAIN, "pub", 30, 30, *files),
        ):
            images, sent, end_s = [], 0, time.monotonic() + 4
            while time.monotonic() < end_s:
                ours.publish(cdr)
                sent += 1
                with contextlib.suppress(InputError):  # before the first CameraInfo
                    images.append(image.read(1 / 30))
                with contextlib.suppress(InputError):
                    assert damaged.read(0.0) is None
            received = int(there.line())
    finally:
        image.close()
        damaged.close()
    seen = [one for one in images if one is not None]
    np.testing.assert_allclose(seen[-1].content.depth_mm, small_frame().depth_mm, rtol=2e-7)
    ages_ms = [(one.arrived_ns - one.stamp_ns) * 1e-6 for one in seen]
    print(
        f"Fast DDS heard {received} of {sent}; {len(seen)} images, p50 {np.median(ages_ms):.2f} ms"
    )
    assert image.host_clock
    assert len(seen) > 20
    assert received > 20
    assert heard.read_bytes().rstrip(b"\0") == cdr.rstrip(b"\0")


# --- the user's own ROS --------------------------------------------------------------------------


def test_the_way_through_rclpy(monkeypatch: pytest.MonkeyPatch, messages: Messages) -> None:
    """Which calls go to rclpy, in which order. A stand-in: there is no rclpy to run here."""
    calls: list[tuple] = []
    callbacks: dict = {}
    cloud = plain_cloud(SensorCloud(points_mm()[:300]), messages.header(7, "camera"), messages)

    class Recorded:
        """Notes what is called on it; every call gives another."""

        def __init__(self, name: str) -> None:
            self.name = name

        def __getattr__(self, name: str) -> Callable:
            def call(*args: object, **kwargs: object) -> object:
                calls.append((f"{self.name}.{name}", args, kwargs))
                if name == "create_subscription":
                    callbacks[args[1]] = args[2]
                if name == "spin_once":
                    for came in list(callbacks.values()):
                        came(bytes(messages.to_bytes(cloud)))
                if name == "get_publishers_info_by_topic":
                    return [types.SimpleNamespace(topic_type=incoming.CLOUD)]
                return Recorded(name)

            return call

    def module(name: str, **content: object) -> None:
        made = types.ModuleType(name)
        vars(made).update(content)
        made.__spec__ = ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, made)

    rclpy = Recorded("rclpy")
    module("rclpy", Context=rclpy.Context, init=rclpy.init, create_node=rclpy.create_node)
    module("rclpy.executors", SingleThreadedExecutor=rclpy.SingleThreadedExecutor)
    policy = types.SimpleNamespace
    module(
        "rclpy.qos",
        QoSProfile=dict,
        ReliabilityPolicy=policy(RELIABLE="reliable", BEST_EFFORT="best effort"),
        DurabilityPolicy=policy(TRANSIENT_LOCAL="transient local", VOLATILE="volatile"),
    )
    module("rclpy.duration", Duration=dict)
    for package in ("sensor_msgs", "visualization_msgs", "geometry_msgs", "diagnostic_msgs"):
        names = ("PointCloud2", "MarkerArray", "PointStamped", "DiagnosticArray")
        module(f"{package}.msg", **{name: name for name in names})

    source = SourceRos2(topic="/points").open()  # auto: rclpy is there now
    seen = source.read(0.1)
    assert seen is not None
    np.testing.assert_allclose(seen.content.points_mm, points_mm()[:300], rtol=2e-7)
    source.close()
    source.close()
    made = [name for name, _, _ in calls]
    assert made.index("rclpy.init") < made.index("rclpy.create_node")
    subscribed = next(call for call in calls if call[0].endswith("create_subscription"))
    assert subscribed[1][:2] == ("PointCloud2", "/points")
    assert subscribed[1][3]["reliability"] == "best effort"
    assert subscribed[2] == {"raw": True}
    assert made.count("create_node.destroy_node") == 1

    calls.clear()
    sink = SinkRos2(via="rclpy").open(small_setting())
    sink.publish(small_update())
    sink.close()
    topics = {args[1] for name, args, _ in calls if name.endswith("create_publisher")}
    assert {"/tumortrack/cloud", "/tumortrack/tumor_2/center"} < topics
    sent = [args[0] for name, args, _ in calls if name == "create_publisher.publish"]
    assert all(isinstance(one, bytes) and one[:4] == b"\0\1\0\0" for one in sent)
    assert len(sent) == 2 * len(topics)  # the update, and that it is over


def test_without_rclpy_it_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"rclpy cannot be imported.*via=dds"):
        SourceRos2(topic="/points", via="rclpy").open()
