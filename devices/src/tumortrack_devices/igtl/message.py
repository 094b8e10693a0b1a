"""OpenIGTLink messages as bytes: header, extended header, content, metadata and checksum.

Header version 2 (protocol 3), which 3D Slicer (since 4.7), PLUS and pyigtl read: version 1 has no
metadata for frames and missing transforms. Headers of version 1 are read too, since clients use it
for requests. All numbers are big-endian.
Source: the protocol's Documents/Protocol: header.md, timestamp.md, transform.md, status.md,
polydata.md, point.md, string.md, image.md.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num

from tumortrack.core.colours import Colour
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install

HEADER_SIZE = 58
LONGEST_DEVICE = 20  # ASCII characters
_HEADER = struct.Struct("> H 12s 20s Q Q Q")
_EXTENDED = struct.Struct("> H H I I")
_ENTRY = struct.Struct("> H H I")
_ASCII, _UTF8 = 3, 106  # IANA's numbers of character sets
_NS = 1_000_000_000
# STATUS codes
OK, NOT_FOUND, CHECKSUM_ERROR, NOT_READY, NOT_PRESENT, EXITING = 1, 4, 9, 13, 16, 19
_STATUS = struct.Struct("> H q 20s")
_POLYDATA = struct.Struct("> 10I")
_ATTRIBUTE = struct.Struct("> B B I")
_POINT_SCALARS = 0x00
_POINT = struct.Struct("> 64s 32s 4B 4f 20s")
_IMAGE = struct.Struct("> H 4B 3H 12f 6H")
_INTEGERS = {2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4"}  # by the protocol's number
_NOT_RIGID = 1e-3  # deviation of a rotation from orthonormal: float32 of some trackers' matrices
_NO_SEGMENTS = np.zeros((0, 2), np.int32)


class ProtocolError(InputError):
    """Bytes that are no message, or a message that does not fit the protocol."""


class Message(NamedTuple):
    """``type``: TRANSFORM, STATUS, POLYDATA, GET_STATUS, ..., at most 12 ASCII characters;
    ``device``: at most 20. ``stamp_ns``: since 1970, UTC; 0: unknown. Kept to 1/4 ns. ``content``:
    the type's own bytes. ``metadata``: texts by name."""

    type: str
    device: str
    stamp_ns: int = 0
    content: bytes = b""
    metadata: Mapping[str, str] = {}


class Labels(NamedTuple):
    """One slice of an IMAGE. ``labels``: rows and columns; ``sent_from_pixel``: (column, row, 0) ->
    mm, in the axes in which the IMAGE was sent; ``lps``: whether it says that they are LPS."""

    labels: Int[np.ndarray, "h w"]
    sent_from_pixel: Float[np.ndarray, "4 4"]
    lps: bool


class Header(NamedTuple):
    """The first 58 bytes; ``body_size`` bytes follow."""

    version: int
    type: str
    device: str
    stamp_ns: int
    body_size: int
    crc: int


def pack(message: Message) -> bytes:
    """The message's bytes. Raises ProtocolError for a name too long or not ASCII, and a stamp
    before 1970 or after 2106."""
    index, texts = [struct.pack("> H", len(message.metadata))], []
    for key, value in message.metadata.items():
        name, text = key.encode("ascii"), value.encode("utf-8")
        index.append(_ENTRY.pack(len(name), _ASCII if value.isascii() else _UTF8, len(text)))
        texts += [name, text]
    keys, values = b"".join(index), b"".join(texts)
    extended = _EXTENDED.pack(_EXTENDED.size, len(keys), len(values), 0)
    body = b"".join((extended, message.content, keys, values))
    limits = ("type", message.type, 12), ("device name", message.device, LONGEST_DEVICE)
    for what, given, size in limits:
        if not given.isascii() or len(given) > size:
            raise ProtocolError(f"{what} {given!r}: at most {size} ASCII characters are allowed.")
    names = message.type.encode("ascii"), message.device.encode("ascii")
    # Seconds in the upper 32 bits, their fraction in the lower ones.
    stamp = ((message.stamp_ns << 32) + _NS // 2) // _NS
    if not 0 <= stamp < 1 << 64:
        raise ProtocolError(f"stamp {message.stamp_ns} ns lies before 1970 or after 2106.")
    return _HEADER.pack(2, *names, stamp, len(body), crc64(body)) + body


def unpack_header(data: bytes) -> Header:
    """Raises ProtocolError: not 58 bytes, an unknown version, names that are no text."""
    if len(data) != HEADER_SIZE:
        raise ProtocolError(f"an OpenIGTLink header has {HEADER_SIZE} bytes, not {len(data)}.")
    version, kind, device, stamp, size, crc = _HEADER.unpack(data)
    if version not in (1, 2, 3):
        raise ProtocolError(f"header version {version} is unknown; 1, 2 and 3 are read.")
    try:
        names = [raw.split(b"\0")[0].decode("ascii") for raw in (kind, device)]
    except UnicodeDecodeError as error:
        raise ProtocolError(
            f"the header's type or device name is no ASCII text: {error}."
        ) from error
    return Header(version, names[0], names[1], (stamp * _NS + (1 << 31)) >> 32, size, crc)


def check_body(header: Header, body: bytes) -> None:
    """Raises ProtocolError if the body that followed a header has a wrong length or checksum."""
    if len(body) != header.body_size:
        raise ProtocolError(
            f"{header.type}: the body has {len(body)} bytes; its header says {header.body_size}."
        )
    if header.crc and crc64(body) != header.crc:  # 0: the sender has checksums switched off
        raise ProtocolError(f"{header.type} of {header.device!r}: its checksum is wrong (damaged).")


def unpack_body(header: Header, body: bytes) -> tuple[bytes, dict[str, str]]:
    """A checked body's content and metadata. Raises ProtocolError: it is cut off."""
    if header.version == 1:
        return body, {}
    try:
        size, index_size, texts_size, _ = _EXTENDED.unpack_from(body)
        end = len(body) - index_size - texts_size
        if not _EXTENDED.size <= size <= end:
            raise ProtocolError(f"{header.type} of {header.device!r}: its parts do not fit in it.")
        index, texts, metadata = body[end : end + index_size], body[end + index_size :], {}
        for number in range(int.from_bytes(index[:2], "big")):
            key_size, _, value_size = _ENTRY.unpack_from(index, 2 + _ENTRY.size * number)
            key, value = texts[:key_size], texts[key_size : key_size + value_size]
            metadata[key.decode(errors="replace")] = value.decode(errors="replace")
            texts = texts[key_size + value_size :]
    except struct.error as error:
        raise ProtocolError(f"{header.type} of {header.device!r} is cut off: {error}.") from error
    return body[size:end], metadata


def unpack_transform(content: bytes) -> Float[np.ndarray, "4 4"]:
    """``b_from_a``. Raises ProtocolError: it is no rigid transform."""
    if len(content) != 48:
        raise ProtocolError(f"a TRANSFORM has 48 bytes, not {len(content)}.")
    b_from_a = np.eye(4)
    with np.errstate(invalid="ignore"):  # of what is no number
        b_from_a[:3] = np.frombuffer(content, ">f4").reshape(4, 3).T
    turn = b_from_a[:3, :3]
    if not np.isfinite(b_from_a).all() or np.abs(turn @ turn.T - np.eye(3)).max() > _NOT_RIGID:
        raise ProtocolError("a TRANSFORM is not rigid.")
    return b_from_a


def unpack_string(content: bytes) -> str:
    """The text of a STRING, up to the first zero byte. Raises ProtocolError: it is cut off."""
    length = int.from_bytes(content[2:4], "big")
    if len(content) < 4 + length:
        raise ProtocolError("a STRING is cut off.")
    return _text(content[4 : 4 + length])


def unpack_points(content: bytes) -> list[tuple[str, str, Float[np.ndarray, " 3"]]]:
    """Name, group and place of the fiducials of a POINT. Raises ProtocolError: it is cut off, or
    not finite."""
    if len(content) % _POINT.size:
        raise ProtocolError(f"a POINT is of pieces of {_POINT.size} bytes; {len(content)} came.")
    points = []
    for name, group, *_, x, y, z, _, _ in _POINT.iter_unpack(content):
        if not np.isfinite((x, y, z)).all():
            raise ProtocolError("a POINT is not finite.")
        points.append((_text(name), _text(group), np.array([x, y, z])))
    return points


def unpack_polydata_points(content: bytes) -> Float[np.ndarray, "n 3"]:
    """The points of a POLYDATA. Raises ProtocolError: it is cut off, or not finite."""
    end = _POLYDATA.size + 12 * int.from_bytes(content[:4], "big")
    if len(content) < end:
        raise ProtocolError("a POLYDATA is cut off.")
    with np.errstate(invalid="ignore"):
        points = np.frombuffer(content[_POLYDATA.size : end], ">f4").reshape(-1, 3).astype(float)
    if not np.isfinite(points).all():
        raise ProtocolError("a POLYDATA is not finite.")
    return points


def unpack_labels(content: bytes) -> Labels:
    """An IMAGE of whole numbers, one slice, or what is sent of it (its subvolume). The header says
    where the whole image's middle is. Raises ProtocolError: it is another one, or of another size
    than it says."""
    if len(content) < _IMAGE.size:
        raise ProtocolError("an IMAGE is cut off.")
    _, components, kind, endian, coordinates, *numbers = _IMAGE.unpack_from(content)
    axes, middle = np.array(numbers[3:12]).reshape(3, 3).T, np.array(numbers[12:15])
    size, first, shape = (np.array(numbers[at : at + 3]) for at in (0, 15, 18))
    columns, rows, slices = shape.tolist()
    form = np.dtype(_INTEGERS.get(kind, "u1")).newbyteorder(">" if endian == 1 else "<")
    labels = kind in _INTEGERS and components == slices == 1 and min(columns, rows) > 1
    whole = len(content) == _IMAGE.size + rows * columns * form.itemsize
    if not (labels and whole and (first + shape <= size).all() and np.isfinite(numbers).all()):
        raise ProtocolError(
            f"an IMAGE of {columns} x {rows} x {slices} pixels, {components} components, scalar "
            f"type {kind} and {len(content)} bytes is not read. Allowed: one slice of labels "
            "(uint8, uint16), such as an array of 1 x rows x columns, with a finite matrix."
        )
    sent_from_pixel = np.eye(4)
    sent_from_pixel[:3, :3] = axes
    sent_from_pixel[:3, 3] = middle + axes @ (first - (size - 1) / 2)
    values = np.frombuffer(content, form, offset=_IMAGE.size).reshape(rows, columns)
    return Labels(values, sent_from_pixel, coordinates == 2)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode(errors="replace")


def crc64(data: bytes) -> int:
    """CRC-64 of ECMA-182 (1992), annex B: register 0 at the start, nothing reversed."""
    try:
        from fastcrc.crc64 import ecma_182
    except ImportError as error:
        raise InputError(
            f"OpenIGTLink needs the package fastcrc: {to_install('tumortrack-devices')}."
        ) from error
    return ecma_182(data)


def pack_transform(b_from_a: Float[np.ndarray, "4 4"]) -> bytes:
    """Its upper three rows, column by column, float32."""
    return np.asarray(b_from_a)[:3].T.astype(">f4").tobytes()


def pack_status(code: int, name: str, text: str) -> bytes:
    """``name`` is cut to 20 characters. The text ends with a zero byte, as the protocol's own
    library writes it; the sub code is 0."""
    return _STATUS.pack(code, 0, name.encode("ascii", "replace")[:20]) + text.encode() + b"\0"


def pack_points(
    points_mm: Float[np.ndarray, "n 3"], labels: Sequence[str], colours: Sequence[Colour]
) -> bytes:
    """Fiducials; labels are cut to 63 bytes: the protocol's own library reads beyond one of 64."""
    return b"".join(
        _POINT.pack(label.encode("ascii", "replace")[:63], b"Fiducial", *rgb, 255, *point, 0.0, b"")
        for label, rgb, point in zip(labels, colours, points_mm, strict=True)
    )


def pack_polydata(
    points: Float[np.ndarray, "n 3"],
    triangles: Int[np.ndarray, "f 3"],
    segments: Int[np.ndarray, "s 2"] = _NO_SEGMENTS,
    **scalars: Num[np.ndarray, " n"],
) -> bytes:
    """Points and cells of their numbers: triangles are sent as polygons, segments as lines.
    ``scalars``: one per point, by name."""
    lines, polygons = _cells(segments), _cells(triangles)
    head = _POLYDATA.pack(
        len(points),
        *(0, 0),  # vertices: 3D Slicer's reader writes past its memory at the second one
        *(len(segments), len(lines)),
        *(len(triangles), len(polygons)),
        *(0, 0),  # triangle strips
        len(scalars),
    )
    kinds = [_ATTRIBUTE.pack(_POINT_SCALARS, 1, len(values)) for values in scalars.values()]
    names = b"".join(name.encode("ascii") + b"\0" for name in scalars)
    numbers = [np.asarray(one).astype(">f4").tobytes() for one in (points, *scalars.values())]
    padding = bytes(len(names) % 2)
    return b"".join((head, numbers[0], lines, polygons, *kinds, names, padding, *numbers[1:]))


def _cells(cells: np.ndarray) -> bytes:
    return np.insert(cells, 0, cells.shape[1], axis=1).astype(">u4").tobytes()
