"""The OpenIGTLink sink: what arrives, where it lies, and that no receiver can hold it up."""

from __future__ import annotations

import socket
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clock import PATIENCE_S, until
from igtl_objects import (
    Heard,
    IgtlStatus,
    hear,
    hear_all,
    polydata_by_the_book,
    slow_crc,
    status_by_the_book,
)
from live_objects import STAMP_NS, ball, empty_update, small_anatomy, small_setting, small_update
from refused import refused
from reports import NOWHERE, bounded, reporting
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.live.values import PublishedFrame, SinkContext
from tumortrack_devices.igtl import link
from tumortrack_devices.igtl.message import (
    HEADER_SIZE,
    Message,
    ProtocolError,
    check_body,
    crc64,
    pack,
    pack_polydata,
    pack_transform,
    unpack_body,
    unpack_header,
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
    vessel = {"vessel": ball((0.0, 0.0, 125.0), 3.0)}  # it rides along
    known = replace(reporting(update.estimate, motion=motion), structures=vessel)
    sink = open_sink(
        replace(small_setting(), anatomy_ct=replace(small_anatomy(), structures=vessel))
    )
    sock = open_receiver(sink)
    sink.publish(replace(update, estimate=known))
    heard = hear_all(sock, ALL + 2)
    surface = polydata_by_the_book(heard["POLYDATA", "vessel"].content)
    np.testing.assert_allclose(surface["points"].mean(0), [0, 0, 125], atol=0.1)
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
    heard = hear_all(sock, ALL + 1 - 2)
    assert not transforms(heard)
    assert heard["POLYDATA", "vessel"].content == bytes(40)  # no old surface stays


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
                sock.settimeout(PATIENCE_S)
                with sock:  # which may begin with what was the newest before
                    while hear(sock).metadata.get("sequence") != str(n):
                        pass
    finally:
        sink.close()


def test_what_cannot_work_is_refused(opened) -> None:
    open_sink, _ = opened
    taken = open_sink()
    with refused(InputError, taken.link.port):
        OpenIgtLinkSinkConfig(port=taken.link.port).open(small_setting())
    with refused(InputError, "no..host"):
        OpenIgtLinkSinkConfig(connect="no..host").open(small_setting())
    long = replace(small_setting(), parts=("thoracic_lymph_nodes_left",))
    with refused(InputError, *long.parts):
        OpenIgtLinkSinkConfig(port=0).open(long)
    for bad in ({"port": 70000}, {"mesh_hz": -1.0}, {"cloud_hz": float("nan")}):
        with refused(InputError, *bad):
            OpenIgtLinkSinkConfig(**bad)  # type: ignore[arg-type]


def test_crc_has_the_catalogues_check_value() -> None:
    assert crc64(b"123456789") == 0x6C40DF5F0B497347  # CRC-64/ECMA-182
    assert crc64(b"") == 0


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=70))
def test_crc_agrees_with_the_slow_one(data: bytes) -> None:
    assert crc64(data) == slow_crc(data)


def from_hex(text: str) -> bytes:
    """Hexadecimal digits before the column of remarks, two blanks away from them."""
    lines = (line.strip().split("  ")[0] for line in text.strip().splitlines())
    return bytes.fromhex("".join(lines))


def test_transform_byte_for_byte() -> None:
    body = (
        from_hex(
            """
            000c 000a 00000008 00000000
            3f800000 00000000 00000000
            00000000 3f800000 00000000
            00000000 00000000 3f800000
            41200000 c1a00000 3f000000
            0001 0003 0003 00000005
            """
        )
        + b"keyvalue"
    )
    head = from_hex(
        """
        0002                                              header version
        5452414e53464f524d000000                          TRANSFORM
        74756d6f725f31 00000000000000000000000000         tumor_1
        00000002 80000000                                 2.5 s
        000000000000004e                                  78 bytes of body: 12 + 48 + 10 + 8
        """
    )
    place = rigid(np.eye(3), np.array([10, -20, 0.5]))
    message = Message(
        "TRANSFORM", "tumor_1", 2_500_000_000, pack_transform(place), {"key": "value"}
    )
    assert pack(message) == head + slow_crc(body).to_bytes(8, "big") + body


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 * 10**9 - 1))
def test_stamps_come_back_to_the_nanosecond(stamp_ns: int) -> None:
    data = pack(Message("STRING", "d", stamp_ns))
    assert unpack_header(data[:HEADER_SIZE]).stamp_ns == stamp_ns
    fixed = int.from_bytes(data[34:42], "big")
    assert fixed >> 32 == stamp_ns // 10**9
    assert abs((fixed & 0xFFFFFFFF) / 2**32 - stamp_ns % 10**9 / 1e9) < 2**-32


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 40), st.integers(0, 20), st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_polydata_as_the_document_reads_it(n: int, faces: int, lines: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = ["label", "probability", "x"][: rng.integers(0, 4)]
    points = rng.normal(size=(n, 3)).astype(np.float32)
    triangles = rng.integers(0, max(n, 1), (faces if n else 0, 3))
    segments = rng.integers(0, max(n, 1), (lines if n else 0, 2))
    scalars = {name: rng.random(n).astype(np.float32) for name in names}
    content = pack_polydata(points, triangles, segments, **scalars)
    book = polydata_by_the_book(content)
    np.testing.assert_array_equal(book["points"], points)
    assert book["polygons"] == [tuple(t) for t in triangles.tolist()]
    assert book["lines"] == [tuple(t) for t in segments.tolist()]
    for name, values in scalars.items():
        assert book[name][:2] == (0, 1)
        np.testing.assert_array_equal(book[name][2], values)
    np.testing.assert_array_equal(unpack_polydata_points(content), points)


def test_a_flipped_bit_anywhere_in_the_body_is_refused() -> None:
    data = pack(Message("TRANSFORM", "tumor_1", 5, pack_transform(np.eye(4)), {"a": "b"}))
    header = unpack_header(data[:HEADER_SIZE])
    body = data[HEADER_SIZE:]
    check_body(header, body)
    for bit in range(8 * len(body)):
        damaged = bytearray(body)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ProtocolError):
            check_body(header, bytes(damaged))
    with pytest.raises(ProtocolError):
        check_body(header, body[:-1])


def test_what_the_protocol_cannot_hold_is_refused() -> None:
    for bad in (
        Message("TRANSFORMATION", "x"),
        Message("STATUS", "x" * 21),
        Message("STATUS", "µ"),
        Message("STATUS", "x", -1),
        Message("STATUS", "x", 2**32 * 10**9),
    ):
        with pytest.raises(ProtocolError):
            pack(bad)
    for bad_header in (b"\0" * 57, b"\0\x09" + bytes(56), b"\0\x02\xff" + bytes(55)):
        with pytest.raises(ProtocolError):
            unpack_header(bad_header)


def test_pyigtl_reads_our_messages() -> None:
    from pyigtl.messages import MessageBase

    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    place = rigid(turn, np.array([1.5, -2.25, 300]))
    data = pack(Message("TRANSFORM", "tumor_1", STAMP_NS, pack_transform(place), {"frame_id": "r"}))
    fields = MessageBase.parse_header(data[:58])
    theirs = MessageBase.create_message("TRANSFORM")
    theirs.unpack(fields, data[58:])
    np.testing.assert_array_equal(theirs.matrix, place)
    assert (theirs.device_name, theirs.metadata) == ("tumor_1", {"frame_id": "r"})
    assert theirs.timestamp == pytest.approx(STAMP_NS / 1e9, abs=1e-6)


def test_we_read_pyigtls_messages() -> None:
    from pyigtl.messages import TransformMessage

    turned = np.eye(4)
    turned[:3, 3] = [1, 2, 3]
    for version in (1, 2):
        theirs = TransformMessage(turned, device_name="needle", timestamp=1234.5)
        theirs.header_version, theirs.metadata = version, {"key": "value"} if version > 1 else {}
        data = theirs.pack()
        header = unpack_header(data[:58])
        check_body(header, data[58:])
        content, metadata = unpack_body(header, data[58:])
        said = header.type, header.device, header.stamp_ns // 10**6
        assert said == ("TRANSFORM", "needle", 1234500)
        assert metadata == theirs.metadata
        np.testing.assert_array_equal(unpack_transform(content), turned)
