"""ROS 1: against a real roscore, and nodes with ROS's own message classes."""

from __future__ import annotations

import logging
import sys
import sysconfig
import time

import numpy as np
import pytest

from clock import PATIENCE_S
from live_objects import PARTS, STAMP_NS, empty_update, small_setting, small_update
from ros1_objects import (
    Graph,
    Listener,
    eventually,
    listener,
    publisher,
    refusal_of,
    ros1_graph,
)
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.ros import rospy_node
from tumortrack.live.sinks.ros import Ros1Sink
from tumortrack.live.sinks.ros import Ros1SinkConfig as Sink
from tumortrack.live.sources.ros import Ros1Source
from tumortrack.live.sources.ros import Ros1SourceConfig as Source
from tumortrack.live.values import Observation, PublishedFrame, SinkContext, SourceLost

pytestmark = pytest.mark.filterwarnings("ignore:notifyAll:DeprecationWarning")  # rospy's own


@pytest.fixture(scope="module")
def graph() -> Graph:
    return ros1_graph()


def opened(source: Source) -> Ros1Source:
    return eventually(source.open, "the topic")


def first(source: Ros1Source) -> Observation:
    return eventually(lambda: source.read(0.5), "a frame")


def published(sink: Ros1Sink, heard: Listener, update, topic: str = "cloud") -> dict:
    """Publish an update until it is heard on a topic."""

    def ask() -> list[dict]:
        sink.publish(update)
        time.sleep(0.05)
        return [m for m in heard.messages(topic) if m.get("stamp_ns") == update.stamp_ns]

    return eventually(ask, f"{topic} of {update.stamp_ns}")[-1]


def test_a_depth_image_arrives_bit_for_bit_with_its_camera_and_mask(graph):
    rows, columns = np.mgrid[0:48, 0:64]
    expected = (120 + columns + rows).astype(np.float32)
    expected[10:14, 20:30] = np.nan
    inside = np.zeros((48, 64), bool)
    inside[5:20, 7:40] = True
    topics = {
        "/a/depth/camera_info": "info",
        "/a/mask": "mask",
        "/a/depth/image_rect_raw": "depth",
    }
    with publisher(topics):
        source = opened(Source(topic="/a/depth/image_rect_raw", mask="/a/mask"))
        before_ns = time.time_ns()
        seen = first(source)
        assert isinstance(seen.content, DepthFrame)
        np.testing.assert_array_equal(seen.content.depth_mm, expected)
        camera = seen.content.intrinsics
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 61.0, 31.5, 23.5)
        np.testing.assert_array_equal(seen.mask, inside)
        assert 0 <= seen.arrived_ns - seen.stamp_ns < PATIENCE_S * 1e9
        assert seen.stamp_ns > before_ns - PATIENCE_S * 1e9
        following = first(source)
        assert following.stamp_ns > seen.stamp_ns
        source.close()
        source.close()


def test_a_depth_image_in_metres_becomes_millimetres(graph):
    rows, columns = np.mgrid[0:48, 0:64]
    metres = (0.12 + 0.0005 * columns + 0.0001 * rows).astype(np.float32)
    metres[10:14, 20:30] = np.nan
    with publisher({"/b/image": "depth", "/b/elsewhere/info": "info"}, encoding="32FC1"):
        source = opened(Source(topic="/b/image", info="/b/elsewhere/info"))
        seen = first(source)
        source.close()
    assert isinstance(seen.content, DepthFrame)
    np.testing.assert_array_equal(seen.content.depth_mm, metres * np.float32(1000))


def test_a_cloud_arrives_bit_for_bit_and_the_newest_one_wins(graph):
    points = np.random.default_rng(3).normal([0, 0, 0.13], 0.02, (300, 3)).astype(np.float32)
    expected = np.delete(points, 5, axis=0) * np.float32(1000)
    with publisher({"/c/points": "cloud"}, hz=100):
        source = opened(Source(topic="/c/points"))
        seen = first(source)
        assert isinstance(seen.content, SensorCloud)
        np.testing.assert_array_equal(seen.content.points_mm, expected)
        dropped = source.dropped
        eventually(lambda: source.dropped >= dropped + 5, "frames that nobody takes")
        newest = first(source)
        assert newest.stamp_ns - seen.stamp_ns >= 5 * 10e6  # it does not begin with the oldest
        source.close()


def test_what_cannot_be_used_is_refused_with_what_there_is(graph):
    with publisher({"/d/info": "info", "/d/points": "cloud", "/d/image": "depth"}):
        said = refusal_of(Source(topic="/d/info").open, InputError)
        assert "/d/info is a sensor_msgs/msg/CameraInfo; it must be" in said
        eventually(lambda: "/d/points" in graph.master.published_types(), "the topic")
        with pytest.raises(SourceLost, match=r"nobody publishes /d/other .*/d/points"):
            Source(topic="/d/other").open()
        with pytest.raises(InputError, match="a mask needs a depth image"):
            Source(topic="/d/points", mask="/d/mask").open()
        source = opened(Source(topic="/d/image"))
        said = refusal_of(lambda: source.read(0.5), InputError)
        assert "images come on /d/image, but no camera_info on /d/camera_info" in said
        source.close()
    for bad in ("", "with space", "/a//b", "/a/", "1st"):
        with pytest.raises(InputError, match="no ROS topic"):
            Source(topic=bad)
    with pytest.raises(InputError, match="unit_mm"):
        Source(topic="/a", unit_mm=0.0)


def test_another_type_on_the_topic_is_refused_and_the_right_one_taken_again(graph):
    with publisher({"/j/points": "cloud"}):
        source = opened(Source(topic="/j/points"))
        first(source)
    with publisher({"/j/points": "depth"}):
        said = refusal_of(lambda: source.read(0.2), InputError)
        assert "on /j/points came a sensor_msgs/msg/Image; it must be" in said
    with publisher({"/j/points": "cloud"}):
        first(source)
    source.close()


def test_simulated_time_is_not_this_machines(graph):
    with publisher({"/e/points": "cloud"}):
        source = opened(Source(topic="/e/points"))
        assert source.host_clock
        source.close()
        graph.master.call("setParam", "/use_sim_time", True)
        try:
            source = opened(Source(topic="/e/points"))
            assert not source.host_clock
            source.close()
            source = opened(Source(topic="/e/points", clock="host"))
            assert source.host_clock
            source.close()
        finally:
            graph.master.call("setParam", "/use_sim_time", False)


def test_an_estimate_arrives_in_metres_in_its_frame_at_its_time(graph, tmp_path):
    published_from_camera = np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
    frames = PublishedFrame("robot_base", published_from_camera)
    update = small_update(frames=frames)
    sink = Sink(namespace="/f", mesh_hz=0.0).open(SinkContext(parts=PARTS, published_frame=frames))
    with listener("/f", tmp_path) as heard:
        cloud = published(sink, heard, update)
        place = published(sink, heard, update, "tumor_1/center")
        said = published(sink, heard, update, "diagnostics")
        markers = eventually(lambda: heard.messages("meshes"), "meshes")[-1]["markers"]
    sink.close()
    sink.close()
    assert cloud["frame"] == place["frame"] == said["frame"] == "robot_base"
    assert cloud["stamp_ns"] == STAMP_NS
    placed = update.transformed
    xyz = np.column_stack([cloud["x"], cloud["y"], cloud["z"]])
    np.testing.assert_allclose(xyz * 1000, placed.points_mm, atol=1e-4)
    assert cloud["label"] == placed.labels.tolist()
    assert cloud["probability"] == placed.probability.tolist()
    np.testing.assert_allclose(place["place"], [13e-3, 34e-3, 150e-3], atol=1e-6)
    no_doubt = "fit: no check failed; its place is not verified"
    assert said["level"] == 0
    assert said["message"].startswith(f"{no_doubt}; no margin is stated: ")
    by_name = {one["ns"]: one for one in markers}
    assert all(one["frame"] == "robot_base" for one in markers)
    for name, mesh in placed.meshes.items():
        corners_mm = mesh.vertices_mm[mesh.faces.ravel()]
        np.testing.assert_allclose(np.array(by_name[name]["points"]) * 1000, corners_mm, atol=1e-9)
    assert by_name["kidney"]["opacity"] < 0.5 < by_name["tumor_1"]["opacity"]


def test_without_an_estimate_everything_is_taken_off_and_the_reason_said(graph, tmp_path):
    sink = Sink(namespace="/g", mesh_hz=0.0).open(small_setting())
    nothing = empty_update(reason="only 12 points lie in range")
    with listener("/g", tmp_path) as heard:
        assert len(published(sink, heard, small_update())["x"]) == 500
        cloud = published(sink, heard, nothing)
        said = published(sink, heard, nothing, "diagnostics")
        place = published(sink, heard, nothing, "tumor_1/center")
        first_marker, text = heard.messages("meshes")[-1]["markers"]
        published(sink, heard, small_update(7))
        sink.close()
        ended = eventually(
            lambda: [m for m in heard.messages("diagnostics") if "ended" in m["message"]],
            "the end",
        )
        assert heard.messages("cloud")[-1]["x"] == []
    assert cloud["x"] == cloud["label"] == []
    assert (said["level"], said["message"]) == (2, "no estimate: only 12 points lie in range")
    assert np.isnan(place["place"]).all()
    assert (first_marker["action"], first_marker["points"]) == (3, [])
    assert "only 12 points" in text["text"]
    assert ended[-1]["level"] == 2


def test_a_master_may_die_and_come_back(graph, tmp_path):
    sink = Sink(namespace="/h").open(small_setting())
    with listener("/h", tmp_path, "before") as before:
        with publisher({"/h/points": "cloud"}, hz=50):
            source = opened(Source(topic="/h/points"))
            held = opened(Source(topic="/h/points"))
            first(source)
            published(sink, before, small_update())
            graph.kill()
            assert first(source) is not None  # from node to node, without a master
        assert "does not answer" in refusal_of(lambda: source.read(0.2), SourceLost)
        source.close()
        with pytest.raises(SourceLost, match=r"roscore, or set ROS_MASTER_URI"):
            Source(topic="/h/points").open()
        with pytest.raises(InputError, match=r"roscore, or set ROS_MASTER_URI"):
            Sink(namespace="/i").open(small_setting())
        count = len(before.messages("cloud"))
        assert "does not answer" in refusal_of(lambda: sink.publish(small_update()), SourceLost)
        eventually(lambda: len(before.messages("cloud")) > count, "the cloud, without a master")
        graph.start()
        assert "was started anew" in refusal_of(lambda: held.read(0.2), SourceLost, "anew")
        held.close()
        with listener("/h", tmp_path, "after") as after, publisher({"/h/points": "cloud"}):
            published(sink, after, small_update(9))
            published(sink, before, small_update(9))
            source = opened(Source(topic="/h/points"))
            first(source)
            source.close()
    sink.close()


def test_without_rospy_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rospy", None)
    with pytest.raises(InputError, match=r"needs rospy.*apt install python3-rospy"):
        rospy_node.rospy_module()
    monkeypatch.setattr(rospy_node, "_DEBIAN_PYTHON", "/nowhere/python3.4")
    with pytest.raises(InputError, match=r"Debian's is for python3.4|has none"):
        rospy_node.rospy_module()


def test_debians_packages_come_last(graph):
    assert sys.path.index(rospy_node._DEBIAN) > sys.path.index(sysconfig.get_path("purelib"))
    assert not np.__file__.startswith(rospy_node._DEBIAN)
    assert logging.getLoggerClass() is logging.Logger


@pytest.mark.parametrize("uri", ["localhost:11311", "http://", "http://host:port", "file:///tmp"])
def test_a_master_must_have_an_address(monkeypatch, uri):
    monkeypatch.setenv("ROS_MASTER_URI", uri)
    with pytest.raises(InputError, match=r"must look like http://localhost:11311"):
        Source(topic="/a").open()


def test_a_program_has_one_master(graph, monkeypatch):
    Sink(namespace="/k").open(small_setting()).close()
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    with pytest.raises(InputError, match=r"already a node of"):
        Sink(namespace="/k").open(small_setting())
