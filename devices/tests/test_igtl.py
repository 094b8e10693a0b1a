"""OpenIGTLink: bytes as the protocol has them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from igtl_objects import IgtlStatus, polydata_by_the_book, slow_crc, status_by_the_book
from live_objects import STAMP_NS
from tumortrack.core.geometry import rigid
from tumortrack_devices.igtl.message import (
    HEADER_SIZE,
    Message,
    Polydata,
    ProtocolError,
    check_body,
    crc64,
    pack,
    pack_polydata,
    pack_status,
    pack_transform,
    unpack_body,
    unpack_header,
    unpack_polydata_points,
    unpack_transform,
)


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
        0000000000000000                                  sub code 0
        6e6f20657374696d617465 000000000000000000         no estimate
        6661722061776179 00                               far away
        """
    )
    assert pack_status(4, "no estimate", "far away") == expected
    assert status_by_the_book(expected) == IgtlStatus(4, "no estimate", "far away")


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
    book = polydata_by_the_book(content)
    np.testing.assert_array_equal(book["points"], data.points)
    assert book["polygons"] == [tuple(t) for t in data.triangles.tolist()]
    assert book["lines"] == [tuple(t) for t in data.segments.tolist()]
    for name, values in data.scalars.items():
        assert book[name][:2] == (0, 1)
        np.testing.assert_array_equal(book[name][2], values)
    np.testing.assert_array_equal(unpack_polydata_points(content), data.points)


def test_a_flipped_bit_anywhere_in_the_body_is_refused() -> None:
    data = pack(Message("TRANSFORM", "tumor_1", 5, pack_transform(np.eye(4)), {"a": "b"}))
    header = unpack_header(data[:HEADER_SIZE])
    body = data[HEADER_SIZE:]
    check_body(header, body)
    for bit in range(8 * len(body)):
        damaged = bytearray(body)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ProtocolError, match="checksum"):
            check_body(header, bytes(damaged))
    with pytest.raises(ProtocolError, match="its header says"):
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
