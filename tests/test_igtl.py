"""OpenIGTLink: bytes as the protocol has them, and a sink that no receiver can hold up."""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from live_objects import STAMP_NS, empty_update, small_anatomy, small_setting, small_update
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid
from tumortrack.track.igtl.content import (
    Polydata,
    Status,
    pack_polydata,
    pack_status,
    pack_string,
    pack_transform,
    unpack_polydata,
    unpack_status,
    unpack_string,
    unpack_transform,
)
from tumortrack.track.igtl.crc64 import crc64
from tumortrack.track.igtl.message import (
    HEADER_SIZE,
    Message,
    ProtocolError,
    pack,
    unpack,
    unpack_header,
)
from tumortrack.track.live import Frames, Setting, Update
from tumortrack.track.sinks.openigtlink import OpenIgtLink, OpenIgtLinkSink

# ---------------------------------------------------------------- an independent reader
# Straight from the protocol's documents, sharing nothing with the code under test.


def slow_crc(data: bytes) -> int:
    """CRC-64 of ECMA-182 bit by bit: polynomial 42F0E1EBA9EA3693, register 0."""
    value = 0
    for byte in data:
        for bit in range(7, -1, -1):
            carry = (value >> 63) ^ ((byte >> bit) & 1)
            value = ((value << 1) & (2**64 - 1)) ^ (0x42F0E1EBA9EA3693 if carry else 0)
    return value


@dataclass
class Heard:
    type: str
    device: str
    seconds: float
    content: bytes
    metadata: dict[str, str]


def exactly(sock: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = sock.recv(size - len(data))
        if not piece:
            raise EOFError
        data += piece
    return data


def hear(sock: socket.socket) -> Heard:
    """The next message, header version 2."""
    head = exactly(sock, 58)
    assert int.from_bytes(head[:2], "big") == 2
    kind, device = head[2:14].rstrip(b"\0").decode(), head[14:34].rstrip(b"\0").decode()
    seconds = int.from_bytes(head[34:42], "big") / 2**32
    body = exactly(sock, int.from_bytes(head[42:50], "big"))
    if len(body) < 2000:
        assert int.from_bytes(head[50:58], "big") == slow_crc(body)
    ext, index_size, texts_size = struct.unpack(">HHI", body[:8])
    assert ext == 12
    end = len(body) - index_size - texts_size
    index, texts = body[end : end + index_size], body[end + index_size :]
    metadata = {}
    for n in range(int.from_bytes(index[:2], "big")):
        k, _, v = struct.unpack(">HHI", index[2 + 8 * n : 10 + 8 * n])
        metadata[texts[:k].decode()] = texts[k : k + v].decode()
        texts = texts[k + v :]
    return Heard(kind, device, seconds, body[12:end], metadata)


def hear_all(sock: socket.socket, wanted: int, wait_s: float = 5.0) -> dict[tuple, Heard]:
    """Messages by type and device, until there are ``wanted`` different ones."""
    sock.settimeout(wait_s)
    found: dict[tuple, Heard] = {}
    while len(found) < wanted:
        one = hear(sock)
        found[one.type, one.device] = one
    return found


def polydata_by_the_book(content: bytes) -> dict:
    """Points, cells by kind and attributes, as polydata.md lays them out."""
    counts = struct.unpack(">10I", content[:40])
    at = 40
    points = struct.unpack(f">{3 * counts[0]}f", content[at : at + 12 * counts[0]])
    at += 12 * counts[0]
    out: dict = {"points": np.reshape(points, (-1, 3))}
    for n, name in enumerate(("vertices", "lines", "polygons", "strips")):
        number, size = counts[1 + 2 * n : 3 + 2 * n]
        cells, end = [], at + size
        while at < end:
            (length,) = struct.unpack(">I", content[at : at + 4])
            cells.append(struct.unpack(f">{length}I", content[at + 4 : at + 4 + 4 * length]))
            at += 4 + 4 * length
        assert (len(cells), at) == (number, end)
        out[name] = cells
    kinds = [struct.unpack(">BBI", content[at + 6 * n : at + 6 * n + 6]) for n in range(counts[9])]
    at += 6 * counts[9]
    names, start = [], at
    for _ in kinds:
        end = content.index(b"\0", at)
        names.append(content[at:end].decode())
        at = end + 1
    at += (at - start) % 2
    for name, (kind, components, number) in zip(names, kinds, strict=True):
        size = 4 * components * number
        values = struct.unpack(f">{components * number}f", content[at : at + size])
        out[name] = (kind, components, np.array(values))
        at += size
    assert at == len(content)
    return out


# ---------------------------------------------------------------- bytes


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


def test_status_byte_for_byte() -> None:
    expected = from_hex(
        """
        0004                                              not found
        ffffffffffffffff                                  sub code -1
        6e6f20657374696d617465 000000000000000000         no estimate
        6661722061776179 00                               far away
        """
    )
    assert pack_status(Status(4, "no estimate", "far away", -1)) == expected
    assert unpack_status(expected) == Status(4, "no estimate", "far away", -1)


def test_polydata_byte_for_byte() -> None:
    expected = from_hex(
        """
        00000003                                          points
        00000000 00000000                                 vertices
        00000001 0000000c                                 lines, their bytes
        00000001 00000010                                 polygons, their bytes
        00000000 00000000                                 strips
        00000001                                          attributes
        3f800000 40000000 40400000                        1, 2, 3
        bf800000 00000000 00000000
        00000000 42c80000 00000000
        00000002 00000000 00000002                        line 0, 2
        00000003 00000000 00000001 00000002               triangle 0, 1, 2
        00 01 00000003                                    scalars of points, one number each, three
        7072 00 00                                        pr, its end, padding to an even size
        00000000 3f000000 3f800000                        0, 0.5, 1
        """
    )
    points = np.array([[1.0, 2, 3], [-1, 0, 0], [0, 100, 0]])
    scalars = {"pr": np.array([0, 0.5, 1])}
    data = Polydata(points, np.array([[0, 1, 2]]), np.array([[0, 2]]), scalars)
    assert pack_polydata(data) == expected
    assert pack_polydata(Polydata(points[:0], np.zeros((0, 3), int))) == bytes(40)


def test_string_byte_for_byte() -> None:
    assert pack_string("hm") == bytes.fromhex("0003 0002 686d")
    assert pack_string("µ") == bytes.fromhex("006a 0002 c2b5")
    assert unpack_string(pack_string("37 µm")) == "37 µm"
    with pytest.raises(ProtocolError, match="65535"):
        pack_string("x" * 65536)
    with pytest.raises(ProtocolError, match="says 2 bytes and has 1"):
        unpack_string(bytes.fromhex("0003 0002 68"))


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
    data = Polydata(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, max(n, 1), (faces if n else 0, 3)),
        rng.integers(0, max(n, 1), (lines if n else 0, 2)),
        {name: rng.random(n).astype(np.float32) for name in names},
    )
    content = pack_polydata(data)
    book, ours = polydata_by_the_book(content), unpack_polydata(content)
    np.testing.assert_array_equal(book["points"], data.points)
    assert book["polygons"] == [tuple(t) for t in data.triangles.tolist()]
    assert book["lines"] == [tuple(t) for t in data.segments.tolist()]
    for name, values in data.scalars.items():
        assert book[name][:2] == (0, 1)
        np.testing.assert_array_equal(book[name][2], values)
        np.testing.assert_array_equal(ours.scalars[name], values)
    np.testing.assert_array_equal(ours.points, data.points)
    np.testing.assert_array_equal(ours.triangles, data.triangles)
    np.testing.assert_array_equal(ours.segments, data.segments)


def test_a_flipped_bit_anywhere_in_the_body_is_refused() -> None:
    data = pack(Message("TRANSFORM", "tumor_1", 5, pack_transform(np.eye(4)), {"a": "b"}))
    header = unpack_header(data[:HEADER_SIZE])
    body = data[HEADER_SIZE:]
    assert unpack_transform(unpack(header, body).content).tolist() == np.eye(4).tolist()
    for bit in range(8 * len(body)):
        damaged = bytearray(body)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ProtocolError, match="checksum"):
            unpack(header, bytes(damaged))
    with pytest.raises(ProtocolError, match="its header says"):
        unpack(header, body[:-1])


def resealed(message: Message, **sizes: int) -> bytes:
    """The message with other numbers in its extended header, the checksum made right again."""
    data = bytearray(pack(message))
    ext = list(struct.unpack_from(">HHI", data, HEADER_SIZE))
    for n, name in enumerate(("extended", "index", "texts")):
        ext[n] = sizes.get(name, ext[n])
    struct.pack_into(">HHI", data, HEADER_SIZE, *ext)
    struct.pack_into(">Q", data, 50, slow_crc(bytes(data[HEADER_SIZE:])))
    return bytes(data)


@pytest.mark.parametrize("sizes", [{"extended": 200}, {"index": 90}, {"texts": 9}, {"extended": 3}])
def test_sizes_that_do_not_fit_are_refused(sizes: dict[str, int]) -> None:
    data = resealed(Message("STATUS", "x", 0, b"", {"k": "vv"}), **sizes)
    with pytest.raises(ProtocolError):
        unpack(unpack_header(data[:HEADER_SIZE]), data[HEADER_SIZE:])


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


@pytest.mark.parametrize(("at", "value"), [(3, 4), (15, 13), (23, 12), (27, 9), (39, 2), (95, 7)])
def test_damaged_polydata_is_refused(at: int, value: int) -> None:
    data = Polydata(np.eye(3), np.array([[0, 1, 2]]), np.array([[0, 2]]), {"p": np.ones(3)})
    content = bytearray(pack_polydata(data))
    assert content[at] != value
    content[at] = value
    with pytest.raises(ProtocolError):
        unpack_polydata(bytes(content))


# ---------------------------------------------------------------- the sink


@pytest.fixture
def opened():
    """Opens sinks on free ports and receivers on them, and closes all."""
    used: list = []

    def sink(setting: Setting | None = None, **options: object) -> OpenIgtLinkSink:
        one = OpenIgtLink(port=0, **options).open(setting or small_setting())  # type: ignore[arg-type]
        used.append(one)
        return one

    def receiver(sink: OpenIgtLinkSink, buffer: int = 0) -> socket.socket:
        sock = socket.socket()
        if buffer:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        sock.connect(("127.0.0.1", sink.port))
        used.append(sock)
        before = time.monotonic() + 5
        while not sink.receivers and time.monotonic() < before:
            time.sleep(0.002)
        return sock

    yield sink, receiver
    for one in reversed(used):
        one.close()


ALL = 6  # STATUS, two TRANSFORM, three POLYDATA


def test_an_update_arrives_where_slicer_has_our_files(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    sock = open_receiver(sink)
    sink.publish(small_update(sequence=7))
    heard = hear_all(sock, ALL)
    status = heard["STATUS", "tumortrack"]
    assert unpack_status(status.content) == Status(1, "good", "")
    assert status.metadata == {
        "frame_id": "camera", "sequence": "7", "quality": "good", "latency_ms": "12.5",
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
    frames = Frames("robot", rigid(quarter, np.array([100.0, 0, 0])))
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
    report = {**update.estimate.report, "motion": {"camera_from_ct": camera_from_ct.tolist()}}
    update = replace(update, estimate=replace(update.estimate, report=report))
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
    sock.settimeout(5)
    while (one := hear(sock)).device != "ct":
        pass
    assert one.metadata["TransformStatus"] == "MISSING"


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
    heard = hear_all(sock, ALL + 1)
    assert unpack_status(heard["STATUS", "tumortrack"].content) == Status(
        4, "no estimate", "only 12 points lie in range"
    )
    for (kind, _), one in heard.items():
        assert one.seconds > STAMP_NS / 1e9 + 0.03
        if kind == "POLYDATA":
            assert one.content == bytes(40)
        if kind == "TRANSFORM":
            assert one.metadata["TransformStatus"] == "MISSING"
            np.testing.assert_array_equal(unpack_transform(one.content), np.eye(4))


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
    assert heard["POLYDATA", "tumor_2"].content == bytes(40)
    assert heard["TRANSFORM", "tumor_2"].metadata["TransformStatus"] == "MISSING"
    assert heard["TRANSFORM", "tumor_1"].metadata["TransformStatus"] == "OK"


def test_the_end_is_said(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    sock = open_receiver(sink)
    sink.publish(small_update())
    hear_all(sock, ALL)
    sink.close()
    sink.close()
    heard = hear_all(sock, ALL)
    assert unpack_status(heard["STATUS", "tumortrack"].content).code == 19
    assert heard["POLYDATA", "kidney"].content == bytes(40)
    with pytest.raises((EOFError, ConnectionError)):
        hear(sock)


def test_a_slow_receiver_holds_up_nobody_and_gets_the_newest(opened) -> None:
    open_sink, open_receiver = opened
    sink = open_sink(mesh_hz=1000.0)
    slow, quick = open_receiver(sink, buffer=4096), open_receiver(sink)
    quick.settimeout(5)
    while sink.receivers < 2:
        time.sleep(0.002)
    slowest, last = 0.0, 399
    for n in range(last):
        started = time.perf_counter()
        sink.publish(replace(small_update(n), stamp_ns=STAMP_NS + n))
        slowest = max(slowest, time.perf_counter() - started)
    sink.publish(empty_update(last))
    assert slowest < 0.5
    for sock in (quick, slow):
        heard: dict[tuple, Heard] = {}
        count = 0
        sock.settimeout(5)
        while len(heard) < ALL or any(
            one.metadata["sequence"] != str(last) for one in heard.values()
        ):
            one = hear(sock)
            heard[one.type, one.device] = one
            count += 1
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
    sock.settimeout(5)
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
    assert unpack_status(hear(sock).content).code == 9
    sock.sendall(pack(Message("GET_STATUS", "")))
    assert hear(sock).device == "tumortrack"


@pytest.mark.parametrize(
    "garbage", [b"GET / HTTP/1.1\r\n".ljust(60), b"\0\1" + bytes(40) + b"\xff" * 16]
)
def test_a_stranger_is_sent_away(opened, garbage: bytes) -> None:
    open_sink, open_receiver = opened
    sink = open_sink()
    stranger, friend = open_receiver(sink), open_receiver(sink)
    stranger.sendall(garbage)
    stranger.settimeout(5)
    with pytest.raises((EOFError, ConnectionError)):
        hear(stranger)
    sink.publish(small_update())
    assert len(hear_all(friend, ALL)) == ALL


def test_as_a_client_it_waits_for_its_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    config = OpenIgtLink(port=port, connect="127.0.0.1")
    sink = config.open(small_setting())
    try:
        sink.publish(small_update(1))
        with socket.create_server(("127.0.0.1", port)) as server:
            server.settimeout(5)
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
        OpenIgtLink(port=taken.port).open(small_setting())
    for bad in ({"port": 70000}, {"mesh_hz": -1.0}, {"cloud_hz": float("nan")}):
        with pytest.raises(InputError, match="must lie in"):
            OpenIgtLink(**bad)  # type: ignore[arg-type]


# ---------------------------------------------------------------- an independent implementation


def test_pyigtl_reads_our_messages(opened) -> None:
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
    data = pack(Message("STRING", "note", STAMP_NS, pack_string("a note")))
    theirs = MessageBase.create_message("STRING")
    theirs.unpack(MessageBase.parse_header(data[:58]), data[58:])
    assert theirs.string == "a note"


def test_we_read_pyigtls_messages() -> None:
    from pyigtl.messages import StringMessage, TransformMessage

    turned = np.eye(4)
    turned[:3, 3] = [1, 2, 3]
    for version in (1, 2):
        theirs = TransformMessage(turned, device_name="needle", timestamp=1234.5)
        theirs.header_version, theirs.metadata = version, {"key": "value"} if version > 1 else {}
        data = theirs.pack()
        ours = unpack(unpack_header(data[:58]), data[58:])
        assert (ours.type, ours.device, ours.stamp_ns // 10**6) == ("TRANSFORM", "needle", 1234500)
        assert ours.metadata == theirs.metadata
        np.testing.assert_array_equal(unpack_transform(ours.content), turned)
    data = StringMessage("hello", device_name="d").pack()
    assert unpack_string(unpack(unpack_header(data[:58]), data[58:]).content) == "hello"


def test_a_pyigtl_client_follows_the_sink(opened) -> None:
    import pyigtl

    open_sink, _ = opened
    sink = open_sink()
    client = pyigtl.OpenIGTLinkClient("127.0.0.1", sink.port)
    try:
        before = time.monotonic() + 5
        while not sink.receivers and time.monotonic() < before:
            time.sleep(0.005)
        for n in range(5):
            sink.publish(small_update(n))
            message = client.wait_for_message("tumor_1", timeout=5)
            assert message.metadata["sequence"] == str(n)
            np.testing.assert_allclose(message.matrix[:3, 3], [-14, 3, 120], atol=1e-4)
    finally:
        client.stop()


def large_update(n: int) -> Update:
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
        sock.settimeout(10)
        while (one := hear(sock)).device != "occupancy":
            pass
        assert one.metadata["sequence"] == str(n)
        points = unpack_polydata(one.content).points
        assert update.placed is not None
        np.testing.assert_array_equal(points, update.placed.points_mm * np.float32([-1, -1, 1]))
