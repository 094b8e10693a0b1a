"""ROS 2's topics between processes, and to and from a second maker's DDS."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clients
import needs
from clock import PATIENCE_S, until
from live_objects import (
    CAMERA,
    PARTS,
    empty_update,
    small_estimate,
    small_frame,
    small_setting,
    small_update,
)
from ros2_objects import (
    DOMAIN,
    OURS,
    RCLPY,
    THROUGH_RCLPY,
    Other,
    own_graph,
    peer,
    process,
    published_again,
    read_until,
    sending,
)
from ros2_peer import MASK, frame_numbered
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid
from tumortrack.core.types import OccupancyCloud
from tumortrack.live.spec import POSES
from tumortrack.live.values import Observation, PublishedFrame, Sink, Source, TrackingResult
from tumortrack_devices.ros.bus import Bus, open_bus
from tumortrack_devices.ros.dds import dds_name
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.results import DIAGNOSTICS, MARKERS, ResultMessages
from tumortrack_devices.ros.tf import TRANSFORMS, pose_of, transform_fields
from tumortrack_devices.sinks.moveit import SCENE, MoveItSinkConfig
from tumortrack_devices.sinks.ros import Ros2SinkConfig as SinkRos2
from tumortrack_devices.sources.ros import Ros2SourceConfig as SourceRos2

needs.module("cyclonedds", "tumortrack-devices, x86-64, Python up to 3.13")

IDENTITY = Path(__file__).parent / "support"
CLOUD_DDS = "sensor_msgs::msg::dds_::PointCloud2_"
TURNED = rigid(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([50.0, -20, 300]))
SHIFTED = rigid(np.diag([1.0, -1, -1]), np.array([0.0, 10, 60]))


@pytest.fixture(autouse=True)
def _own_graph() -> Iterator[None]:
    with own_graph():
        yield


@pytest.fixture
def messages() -> Messages:
    return Messages()


@pytest.fixture
def bus() -> Iterator[Bus]:
    joined = open_bus("dds")
    yield joined
    joined.close()


def large_update(sequence: int, n: int = 40_000) -> TrackingResult:
    """An update with ``n`` points, stamped now."""
    stamp_ns = time.time_ns()
    small = small_estimate(stamp_ns)
    points = np.resize(small.cloud.points_mm, (n, 3))
    cloud = OccupancyCloud(points, np.ones(n, np.uint8), np.full(n, 0.5, np.float32), stamp_ns)
    estimate = Estimate(cloud, None, small.meshes, small.report)
    return TrackingResult(sequence=sequence, stamp_ns=stamp_ns, estimate=estimate, quality="good")


@pytest.mark.parametrize("by", [OURS, THROUGH_RCLPY, RCLPY])
def test_depth_images_from_another_process(by: str) -> None:
    source = SourceRos2(topic="/camera/depth/image_rect", mask="/camera/mask").open()
    assert isinstance(source, Source)
    try:
        with peer("send", "image", 60, 600, by=by):
            first = read_until(source)
            assert source.host_clock
            assert first.mask is not None
            assert np.array_equal(first.mask, MASK)
            assert first.content.intrinsics == CAMERA
            for _ in range(5):
                seen = read_until(source)
                number = round(float(seen.content.depth_mm[0, 0]) - 100)
                expected = frame_numbered(number, 0).depth_mm
                expected = expected.round() if by == RCLPY else expected  # as drivers send it
                np.testing.assert_allclose(seen.content.depth_mm, expected, rtol=2e-7)
                assert seen.stamp_ns > first.stamp_ns

            def newest() -> Observation | None:  # and not what waited; a loaded machine may be late
                before = source.dropped
                time.sleep(0.4)
                seen = source.read(0.2)
                if seen is None or source.dropped == before:
                    return None
                return seen if time.time_ns() - seen.stamp_ns < 200_000_000 else None

            fresh = until(newest)
        until(lambda: source.read(0.3) is None, "the publisher's end")
        with peer("send", "image", 60, 600, by=by):
            again = read_until(source)
            assert again.stamp_ns > fresh.stamp_ns
    finally:
        source.close()


def test_a_source_in_another_process() -> None:
    """With a ROS in its environment it takes that, and says the same."""
    by = THROUGH_RCLPY
    sum_mm = pytest.approx(float(np.nansum(small_frame().depth_mm)), rel=1e-6)
    with sending("image") as topic, peer("see", topic, by=by) as other:
        (first,) = other.lines_until(lambda said: "by" in said)
        assert first["by"] == "RclpyBus"
        seen = other.lines_until(lambda said: said.get("sum_mm") == sum_mm)
        newest = other.lines_until(lambda said: said.get("stamp_ns", 0) > seen[-1]["stamp_ns"])
        assert newest[-1]["sum_mm"] == sum_mm


# --- the sink ------------------------------------------------------------------------------------


@pytest.mark.parametrize("by", [OURS, RCLPY])
def test_updates_reach_another_process(by: str, messages: Messages) -> None:
    sink = SinkRos2(mesh_hz=0.0).open(small_setting())
    assert isinstance(sink, Sink)
    update = small_update()
    expected = {
        one.suffix: one.message
        for one in ResultMessages(messages, small_setting()).messages(update)
    }
    try:
        with peer("hear", 600, by=by) as other:
            other.lines_until(lambda said: "listens" in said)
            by_topic = publish_until(sink, other, update)
            cloud = by_topic["cloud"]
            assert (cloud["points"], cloud["frame"]) == (500, "camera")
            assert cloud["sum"] == int(expected["cloud"].data.sum())
            assert cloud["stamp_ns"] == update.stamp_ns
            corners = {
                name: 3 * len(mesh.faces) for name, mesh in update.transformed.meshes.items()
            }
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


def test_what_is_kept_reaches_a_node_that_comes_later(bus: Bus, messages: Messages) -> None:
    publish = bus.publisher("/tumortrack/planned", MARKERS, latched=True)
    out = {
        one.suffix: one.message
        for one in ResultMessages(messages, small_setting()).messages(small_update())
    }
    publish(messages.to_bytes(out["meshes"]))
    with peer("hear", 600, by=RCLPY) as other:
        heard = other.lines_until(lambda said: said.get("topic") == "planned")[-1]
    assert heard["markers"] == [
        [one.ns, one.action, len(one.points)] for one in out["meshes"].markers
    ]


def at(last: dict[str, dict], stamp_ns: int) -> bool:
    """All topics are at this stamp."""
    return {one["stamp_ns"] for one in last.values()} == {stamp_ns}


def publish_until(sink: Sink, other: Other, update: TrackingResult) -> dict[str, dict]:
    """Publish until the other end hears it on all topics; it may not be matched yet."""
    with published_again(sink, update):
        return other.topics_until(lambda last: at(last, update.stamp_ns))


@pytest.mark.slow
def test_subscribers_that_hang_die_and_come_late_hold_up_nobody() -> None:
    """40,000 points at 30 Hz go on whatever subscribers do."""
    sink = SinkRos2(mesh_hz=10.0).open(small_setting())
    try:
        with peer("hear", 600) as lively, peer("hear", 600) as other:
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
        with peer("hear", 600) as late:
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
    # A call that waits for the hung one waits each time; a loaded machine delays some.
    assert np.median(publish_ms) < 500
    assert len(ages_ms) > 10


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


def built(folder: Path) -> tuple[Path, dict[str, str]]:
    """The Fast DDS peer and its environment; skips where it cannot be built."""
    environment = clients.environment("ros-fastrtps")
    if not shutil.which("g++"):
        needs.missing("g++ is not installed: make debian")
    made, found = folder / "peer", [f"-I{clients.FOLDER}/include", f"-L{clients.FOLDER}/lib"]
    sources = ["-std=c++17", "-O0", *found, str(IDENTITY / "fastdds" / "peer.cpp"), "-o", str(made)]
    libraries = ["-lfastrtps", "-lfastcdr", "-Wl,--unresolved-symbols=ignore-in-shared-libs"]
    subprocess.run(["g++", *sources, *libraries], check=True, timeout=600)
    return made, environment


@pytest.mark.slow
def test_fast_dds_hears_and_is_heard(tmp_path: Path, messages: Messages) -> None:
    """What rclpy's packages on PyPI have no types for: tf and the planning scene arrive there, and
    here by tf where the camera is. Noise does no harm."""
    program, environment = built(tmp_path)
    files = []
    noise = np.random.default_rng(1).integers(0, 256, 2000, np.uint8).tobytes()
    (tmp_path / "noise").write_bytes(bytes([0, 1, 0, 0]) + noise)
    files += ["rt/fast/noise", CLOUD_DDS, tmp_path / "noise"]
    ways = {"tf": ("base_link", "tool0", TURNED), "tf_static": ("tool0", "optical", SHIFTED)}
    for topic, (parent, child, way) in ways.items():
        one = transform_fields(messages, 1, parent, child, way)
        said = messages.to_bytes(messages.make(TRANSFORMS, transforms=[one]))
        (tmp_path / topic).write_bytes(said)
        files += [f"rt/{topic}", dds_name(TRANSFORMS), tmp_path / topic]

    damaged = SourceRos2(topic="/fast/noise").open()
    poses = POSES.parse("ros2:base_link?via=dds").open()
    kinds = {"/tf": TRANSFORMS, "/tf_static": TRANSFORMS, "/diagnostics": DIAGNOSTICS}
    kinds |= {"/planning_scene": SCENE}
    sub: list[object] = ["sub", PATIENCE_S]
    for topic, kind in kinds.items():
        sub += [f"rt{topic}", dds_name(kind), tmp_path / f"heard_{topic[1:]}"]
    frame = PublishedFrame("table", TURNED, calibrated=True)
    setting = replace(small_setting(), published_frame=frame)
    sinks = (
        SinkRos2(namespace="/theatre", camera_tf=True).open(setting),
        MoveItSinkConfig(margin_mm=5.0).open(setting),
    )
    placed = None
    try:
        with (
            process(program, DOMAIN, *sub, environment=environment) as there,
            process(program, DOMAIN, "pub", PATIENCE_S, 30, *files, environment=environment),
        ):
            sent, end_s = 0, time.monotonic() + PATIENCE_S
            while placed is None or there.running():
                assert time.monotonic() < end_s
                sent += 1
                for sink in sinks:
                    sink.publish(small_update(sent, frames=frame))
                seen = Observation(small_frame(time.time_ns()), 0, frame_id="optical")
                with contextlib.suppress(NoEstimate):
                    placed = poses.at(seen)
                with contextlib.suppress(InputError):
                    assert damaged.read(1 / 30) is None
            known = poses.known(0.5)  # of the sink's own frames as well
            assert all(map(int, there.line().split()))
    finally:
        for one in (damaged, poses, *sinks):
            one.close()
    # Fast DDS said the camera on the tool before we listened.
    np.testing.assert_allclose(placed, TURNED @ SHIFTED, atol=1e-9)
    for parent, child, way in ways.values():
        np.testing.assert_allclose(known[parent, child], way, atol=1e-9)
    tf, static, status, scene = (
        messages.from_bytes((tmp_path / f"heard_{topic[1:]}").read_bytes(), kind)
        for topic, kind in kinds.items()
    )
    update = small_update(frames=frame)
    assert [one.child_frame_id for one in tf.transforms] == [f"theatre/{name}" for name in PARTS]
    for name, one in zip(PARTS, tf.transforms, strict=True):
        way = pose_of(one)
        assert way is not None
        np.testing.assert_allclose(way[:3, 3], update.center_mm(name), atol=1e-9)
    (camera,) = static.transforms
    np.testing.assert_allclose(pose_of(camera), TURNED, atol=1e-9)
    assert (camera.header.frame_id, camera.child_frame_id) == ("table", "camera")
    assert {value.key for value in status.status[0].values} > {"quality", "rate_hz", "dropped"}
    objects = {one.id: one for one in scene.world.collision_objects}
    wanted = {f"tumortrack/{name}" for name in PARTS}
    assert objects.keys() == wanted | {f"{name}/margin" for name in wanted if "tumor_" in name}
    tumor = objects["tumortrack/tumor_1"].meshes[0].vertices
    off_mm = 1000 * np.array([[p.x, p.y, p.z] for p in tumor]) - update.center_mm("tumor_1")
    np.testing.assert_allclose(np.linalg.norm(off_mm, axis=1), 6, atol=0.5)
