"""The OpenIGTLink sink: what arrives, where it lies, and that no receiver can hold it up."""

from __future__ import annotations

import socket
import time
from dataclasses import replace

import numpy as np
import pytest

from clock import PATIENCE_S, until
from igtl_objects import (
    Heard,
    IgtlStatus,
    hear,
    hear_all,
    polydata_by_the_book,
    status_by_the_book,
)
from live_objects import STAMP_NS, empty_update, small_anatomy, small_setting, small_update
from reports import NOWHERE, bounded, reporting
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult
from tumortrack_devices.igtl import link
from tumortrack_devices.igtl.message import (
    Message,
    pack,
    unpack_polydata_points,
    unpack_transform,
)
from tumortrack_devices.sinks.openigtlink import OpenIgtLinkSink, OpenIgtLinkSinkConfig


@pytest.fixture
def opened():
    """Opens sinks on free ports and receivers on them, and closes all."""
    used: list = []

    def sink(setting: SinkContext | None = None, **options: object) -> OpenIgtLinkSink:
        one = OpenIgtLinkSinkConfig(port=0, **options).open(setting or small_setting())  # type: ignore[arg-type]
        used.append(one)
        return one

    def receiver(sink: OpenIgtLinkSink, buffer: int = 0) -> socket.socket:
        sock = socket.socket()
        if buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        sock.connect(("127.0.0.1", sink.link.port))
        used.append(sock)
        until(lambda: sink.link.receivers)
        return sock

    yield sink, receiver
    for one in reversed(used):
        one.close()


def transforms(heard):
    return {device for kind, device in heard if kind == "TRANSFORM"}


ALL = 7  # STATUS, two TRANSFORM, POINT, three POLYDATA


def test_an_update_arrives_where_slicer_has_our_files(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    sock = open_receiver(sink)
    sink.publish(small_update(sequence=7))
    heard = hear_all(sock, ALL)
    status = heard["STATUS", "tumortrack"]
    assert status_by_the_book(status.content) == IgtlStatus(1, "good", small_update().describe())
    assert status.metadata == {
        "frame_id": "camera", "sequence": "7", "quality": "good", "latency_ms": "12.5",
        "patient": "P1", "side": "left",
    }  # fmt: skip
    anatomy = small_anatomy()
    for name, mesh in zip(anatomy.names, anatomy.parts, strict=True):
        book = polydata_by_the_book(heard["POLYDATA", name].content)
        np.testing.assert_allclose(book["points"], mesh.vertices_mm * [-1, -1, 1], atol=1e-4)
        assert book["polygons"] == [tuple(t) for t in mesh.faces.tolist()]
        assert heard["POLYDATA", name].seconds == pytest.approx(STAMP_NS / 1e9, abs=1e-6)
    first = heard["TRANSFORM", "tumor_1"]
    assert first.metadata["TransformStatus"] == "OK"
    np.testing.assert_allclose(unpack_transform(first.content)[:3, 3], [-14, 3, 120], atol=1e-5)
    second = unpack_transform(heard["TRANSFORM", "tumor_2"].content)
    np.testing.assert_allclose(second, rigid(np.eye(3), np.array([6.0, -5, 138])), atol=1e-5)


def test_published_frame_and_lps(opened) -> None:
    open_sink, open_receiver = opened
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    frames = PublishedFrame("robot", rigid(quarter, np.array([100.0, 0, 0])))
    sink = open_sink(space="lps")
    sock = open_receiver(sink)
    sink.publish(small_update(frames=frames))
    heard = hear_all(sock, ALL)
    assert {one.metadata["frame_id"] for one in heard.values()} == {"robot"}
    place = unpack_transform(heard["TRANSFORM", "tumor_1"].content)
    # (14, -3, 120) a quarter turn about z: (3, 14, 120), and 100 along x.
    np.testing.assert_allclose(place, rigid(np.eye(3), np.array([103.0, 14, 120])), atol=1e-4)
    box = polydata_by_the_book(heard["POLYDATA", "tumor_1"].content)["points"]
    np.testing.assert_allclose((box.min(0) + box.max(0)) / 2, [103, 14, 120], atol=1e-4)


def test_the_organs_pose_carries_the_ct(opened) -> None:
    """A point of the CT, given in RAS as Slicer has it, lands where the organ is now."""
    open_sink, open_receiver = opened
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    camera_from_ct = rigid(turn, np.array([1.0, 2, 130]))
    update = small_update()
    assert update.estimate is not None
    motion = {**NOWHERE, "camera_from_ct": camera_from_ct.tolist()}
    update = replace(update, estimate=reporting(update.estimate, motion=motion))
    sink = open_sink(replace(small_setting(), anatomy_ct=small_anatomy()))
    sock = open_receiver(sink)
    sink.publish(update)
    heard = hear_all(sock, ALL + 1)
    ct = unpack_transform(heard["TRANSFORM", "ct"].content)
    point_lps = np.array([10.0, 20, 30])
    now_camera = turn @ point_lps + [1, 2, 130]  # (11, -28, 150)
    now_ras = ct @ [-10, -20, 30, 1]
    np.testing.assert_allclose(now_camera, [11, -28, 150])
    np.testing.assert_allclose(now_ras[:3], [-11, 28, 150], atol=1e-4)
    tumor = unpack_transform(heard["TRANSFORM", "tumor_1"].content)
    np.testing.assert_allclose(tumor[:3, :3], ct[:3, :3], atol=1e-6)
    assert np.linalg.det(tumor[:3, :3]) == pytest.approx(1)
    sink.publish(empty_update())
    assert not transforms(hear_all(sock, ALL - 2))


def test_no_estimate_is_said_and_leaves_nothing(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink(cloud_hz=100.0)
    sock = open_receiver(sink)
    sink.publish(small_update())
    cloud = polydata_by_the_book(hear_all(sock, ALL + 1)["POLYDATA", "occupancy"].content)
    assert len(cloud["points"]) == len(cloud["lines"]) == 500
    assert set(cloud["label"][2]) == {1, 2, 3}
    assert cloud["probability"][2][[0, -1]].tolist() == [0.5, 1.0]
    sink.publish(empty_update(reason="only 12 points lie in range"))
    heard = hear_all(sock, ALL + 1 - 2)
    assert status_by_the_book(heard["STATUS", "tumortrack"].content) == IgtlStatus(
        4, "no estimate", "only 12 points lie in range"
    )
    for (kind, _), one in heard.items():
        assert one.seconds > STAMP_NS / 1e9 + 0.03
        if kind == "POLYDATA":
            assert one.content == bytes(40)
        if kind == "POINT":
            assert one.content == b""
    assert not transforms(heard)
    assert not transforms(hear_all(open_receiver(sink), ALL + 1 - 2))  # nor of who comes later


def test_a_lost_part_goes_at_once_however_seldom_surfaces_are_sent(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink(mesh_hz=0.01)
    sock = open_receiver(sink)
    update = small_update()
    sink.publish(update)
    assert len(hear_all(sock, ALL)["POLYDATA", "tumor_2"].content) > 40
    assert update.estimate is not None
    less = {k: m for k, m in update.estimate.meshes.items() if k != "tumor_2"}
    sink.publish(replace(update, estimate=replace(update.estimate, meshes=less)))
    heard = hear_all(sock, 4)
    assert ("POLYDATA", "kidney") not in heard
    assert len(heard["POINT", "tumors"].content) == 136  # one point
    assert heard["POLYDATA", "tumor_2"].content == bytes(40)
    assert transforms(heard) == {"tumor_1"}


def test_how_far_off_a_tumor_may_be_comes_with_it(opened) -> None:
    """As a surface, and in the centre's label."""
    import pyigtl

    open_sink, open_receiver = opened
    sink = open_sink(small_setting(), mesh_hz=1000.0)
    sock = open_receiver(sink)
    update = small_update()
    assert update.estimate is not None
    sink.publish(replace(update, estimate=bounded(update.estimate, tumor_1=5.04)))
    heard = hear_all(sock, ALL + 1)  # the shell
    shell = polydata_by_the_book(heard["POLYDATA", "tumor_1_margin"].content)["points"]
    distances = np.linalg.norm(shell - [-14, 3, 120], axis=1)  # the tumor's radius is 6 mm
    np.testing.assert_allclose(distances, 11.04, atol=0.05)
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", sink.link.port)
    try:
        points = client.wait_for_message("tumors", timeout=PATIENCE_S)
    finally:
        client.stop()
    assert points.names == [
        "tumor_1, off by at most 5.0 mm (95 %)", "tumor_2",
    ]  # fmt: skip
    np.testing.assert_allclose(points.positions, [[-14, 3, 120], [6, -5, 138]], atol=1e-4)
    sink.publish(update)
    sock.settimeout(PATIENCE_S)
    while (one := hear(sock)).device != "tumor_1_margin":
        pass
    assert one.content == bytes(40)


def test_the_end_is_said(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    sock = open_receiver(sink)
    sink.publish(small_update())
    hear_all(sock, ALL)
    sink.close()
    sink.close()
    heard = hear_all(sock, ALL - 2)
    assert status_by_the_book(heard["STATUS", "tumortrack"].content).code == 19
    assert heard["POLYDATA", "kidney"].content == bytes(40)
    with pytest.raises((EOFError, ConnectionError)):
        hear(sock)


def test_a_slow_receiver_holds_up_nobody_and_gets_the_newest(opened, monkeypatch) -> None:
    monkeypatch.setattr(link, "_STALLED_S", PATIENCE_S)  # a busy machine is no stalled receiver
    open_sink, open_receiver = opened
    sink = open_sink(mesh_hz=1000.0)
    slow, quick = open_receiver(sink, buffer=4096), open_receiver(sink)
    quick.settimeout(PATIENCE_S)
    until(lambda: len(sink.link.receivers) == 2)
    last = 399
    for n in range(last):  # while nobody receives
        sink.publish(replace(small_update(n), stamp_ns=STAMP_NS + n))
    sink.publish(empty_update(last))
    for sock in (quick, slow):
        heard: dict[tuple, Heard] = {}
        count = 0
        sock.settimeout(PATIENCE_S)
        while len(heard) < ALL - 2 or any(
            one.metadata["sequence"] != str(last) for one in heard.values()
        ):
            one = hear(sock)
            count += 1
            if one.type == "TRANSFORM":  # of before
                assert int(one.metadata["sequence"]) < last
            else:
                heard[one.type, one.device] = one
        assert heard["POLYDATA", "kidney"].content == bytes(40)
    assert count < last * ALL / 2  # the slow one skipped most


def test_a_newcomer_gets_the_newest_and_a_leaver_does_no_harm(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    first = open_receiver(sink)
    sink.publish(small_update(3))
    hear_all(first, ALL)
    first.close()
    for n in range(4, 20):
        sink.publish(small_update(n))
        time.sleep(0.005)
    second = open_receiver(sink)
    assert hear_all(second, ALL)["STATUS", "tumortrack"].metadata["sequence"] == "19"


def test_requests_are_answered_and_others_ignored(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    sock = open_receiver(sink)
    sink.publish(small_update(5))
    hear_all(sock, ALL)
    old = b"\0\1" + b"GET_TRANSFOR" + b"tumor_2".ljust(20, b"\0") + bytes(24)  # header version 1
    sock.sendall(pack(Message("SENSOR", "glove", 0, b"abc")) + old)
    sock.settimeout(PATIENCE_S)
    one = hear(sock)
    assert (one.type, one.device, one.metadata["sequence"]) == ("TRANSFORM", "tumor_2", "5")
    sock.sendall(pack(Message("GET_IMAGE", "ct")))
    one = hear(sock)
    assert (one.type, one.device, one.content) == ("IMAGE", "ct", b"")
    sock.sendall(pack(Message("STT_POLYDATA", "kidney")) + pack(Message("STP_POLYDATA", "x")))
    assert [hear(sock).content for _ in range(2)] == [b"\0", b"\1"]
    damaged = bytearray(pack(Message("GET_STATUS", "tumortrack")))
    damaged[-1] ^= 1
    sock.sendall(damaged)
    assert status_by_the_book(hear(sock).content).code == 9
    sock.sendall(pack(Message("GET_STATUS", "")))
    assert hear(sock).device == "tumortrack"


def test_one_that_only_asks_fills_no_memory(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    asker, friend = open_receiver(sink, buffer=4096), open_receiver(sink)
    asker.settimeout(PATIENCE_S)
    for n in range(3000):
        asker.sendall(pack(Message("GET_IMAGE", f"ct{n}")))
    sink.publish(small_update())
    assert len(hear_all(friend, ALL)) == ALL
    most = max(len(one.waiting) for one in sink.link.receivers)
    assert most <= 100 + ALL


@pytest.mark.parametrize(
    "garbage", [b"GET / HTTP/1.1\r\n".ljust(60), b"\0\1" + bytes(40) + b"\xff" * 16]
)
def test_a_stranger_is_sent_away(opened, garbage: bytes) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    stranger, friend = open_receiver(sink), open_receiver(sink)
    stranger.sendall(garbage)
    stranger.settimeout(PATIENCE_S)
    with pytest.raises((EOFError, ConnectionError)):
        hear(stranger)
    sink.publish(small_update())
    assert len(hear_all(friend, ALL)) == ALL


def test_as_a_client_it_waits_for_its_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    config = OpenIgtLinkSinkConfig(port=port, connect="127.0.0.1")
    sink = config.open(small_setting())
    try:
        sink.publish(small_update(1))
        with socket.create_server(("127.0.0.1", port)) as server:
            server.settimeout(PATIENCE_S)
            for n in (1, 2):  # the second time after the first connection broke
                sink.publish(small_update(n))
                sock, _ = server.accept()
                with sock:
                    heard = hear_all(sock, ALL)
                assert heard["STATUS", "tumortrack"].metadata["sequence"] == str(n)
    finally:
        sink.close()


def test_what_cannot_work_is_refused(opened) -> None:
    open_sink, _ = opened
    taken = open_sink()
    with pytest.raises(InputError, match="Choose another port"):
        OpenIgtLinkSinkConfig(port=taken.link.port).open(small_setting())
    with pytest.raises(InputError, match="there is no host"):
        OpenIgtLinkSinkConfig(connect="no..host").open(small_setting())
    long = replace(small_setting(), parts=("thoracic_lymph_nodes_left",))
    with pytest.raises(InputError, match="shorter --name"):
        OpenIgtLinkSinkConfig(port=0).open(long)
    for bad in ({"port": 70000}, {"mesh_hz": -1.0}, {"cloud_hz": float("nan")}):
        with pytest.raises(InputError, match=next(iter(bad))):
            OpenIgtLinkSinkConfig(**bad)  # type: ignore[arg-type]


def test_a_pyigtl_client_follows_the_sink(opened) -> None:
    import pyigtl

    open_sink, _ = opened
    sink = open_sink()
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", sink.link.port)
    try:
        until(lambda: sink.link.receivers)
        for n in range(5):
            sink.publish(small_update(n))
            message = client.wait_for_message("tumor_1", timeout=PATIENCE_S)
            assert message.metadata["sequence"] == str(n)
            np.testing.assert_allclose(message.matrix[:3, 3], [-14, 3, 120], atol=1e-4)
    finally:
        client.stop()


def large_update(n: int) -> TrackingResult:
    """40,000 points in its cloud."""
    update = small_update()
    assert update.estimate is not None
    rng = np.random.default_rng(n)
    cloud = update.estimate.cloud
    points = rng.normal(size=(40_000, 3)).astype(np.float32)
    labels, probability = np.ones(40_000, np.uint8), np.full(40_000, 0.5, np.float32)
    large = replace(cloud, points_mm=points, labels=labels, probability=probability)
    return replace(update, sequence=n, estimate=replace(update.estimate, cloud=large))


def test_forty_thousand_points_flow(opened) -> None:
    """Every one of some updates of 1.28 MB arrives, whole, as soon as it is taken."""
    open_sink, open_receiver = opened
    sink = open_sink(cloud_hz=1000.0)
    sock = open_receiver(sink)
    for n in range(5):
        update = large_update(n)
        sink.publish(update)
        sock.settimeout(PATIENCE_S)
        while (one := hear(sock)).device != "occupancy":
            pass
        assert one.metadata["sequence"] == str(n)
        points = unpack_polydata_points(one.content)
        assert update.transformed is not None
        np.testing.assert_array_equal(
            points, update.transformed.points_mm * np.float32([-1, -1, 1])
        )
