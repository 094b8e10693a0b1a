"""Reads OpenIGTLink messages with the tests' own code, built on the product's header alone."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num, UInt32

from tumortrack_devices.igtl.message import (
    Header,
    Message,
    Polydata,
    ProtocolError,
    check_body,
)


class IgtlStatus(NamedTuple):
    """What a STATUS says: ``code`` 1 is well."""

    code: int
    name: str
    text: str
    sub_code: int = 0


_EXTENDED = struct.Struct("> H H I I")
_ENTRY = struct.Struct("> H H I")
_UTF8 = 106
_STATUS = struct.Struct("> H q 20s")
_POLYDATA = struct.Struct("> 10I")
_ATTRIBUTE = struct.Struct("> B B I")
_POINT_SCALARS = 0x00


def unpack(header: Header, body: bytes) -> Message:
    """The message of a header and the body that followed it.

    Raises:
        ProtocolError: a wrong length or checksum, or sizes inside that do not fit.
    """
    check_body(header, body)
    content, metadata = body, {}
    if header.version > 1:
        try:
            size, keys_size, values_size, _ = _EXTENDED.unpack_from(body)
        except struct.error as error:
            raise ProtocolError(f"{header.type}: its extended header is cut short.") from error
        end = len(body) - keys_size - values_size
        if not _EXTENDED.size <= size <= end:
            raise ProtocolError(f"{header.type}: its extended header's sizes do not fit.")
        content = body[size:end]
        if keys_size:
            metadata = _read_metadata(body[end : end + keys_size], body[end + keys_size :])
    return Message(header.type, header.device, header.stamp_ns, content, metadata)


def _read_metadata(index: bytes, texts: bytes) -> dict[str, str]:
    metadata, at = {}, 0
    try:
        (count,) = struct.unpack_from("> H", index)
        for n in range(count):
            key_size, charset, value_size = _ENTRY.unpack_from(index, 2 + n * _ENTRY.size)
            key = texts[at : at + key_size].decode("ascii")
            value = texts[at + key_size : at + key_size + value_size]
            at += key_size + value_size
            metadata[key] = value.decode("utf-8" if charset == _UTF8 else "latin-1")
    except (struct.error, UnicodeDecodeError) as error:
        raise ProtocolError(f"the message's metadata are damaged: {error}.") from error
    if at != len(texts):
        raise ProtocolError(f"the metadata's sizes add up to {at} of {len(texts)} bytes.")
    return metadata


def unpack_transform(content: bytes) -> Float[np.ndarray, "4 4"]:
    """Raises ProtocolError: not 48 bytes, or NaN or infinity among its numbers."""
    if len(content) != 48:
        raise ProtocolError(f"TRANSFORM has 48 bytes, not {len(content)}.")
    columns = np.frombuffer(content, ">f4").reshape(4, 3)
    if not np.isfinite(columns).all():
        raise ProtocolError("TRANSFORM has NaN or infinity among its numbers.")
    b_from_a = np.eye(4)
    b_from_a[:3] = columns.T
    return b_from_a


def unpack_status(content: bytes) -> IgtlStatus:
    """Raises ProtocolError: shorter than 30 bytes."""
    if len(content) < _STATUS.size:
        raise ProtocolError(f"STATUS has at least {_STATUS.size} bytes, not {len(content)}.")
    code, sub_code, name = _STATUS.unpack_from(content)
    text = content[_STATUS.size :].split(b"\0")[0].decode("utf-8", "replace")
    return IgtlStatus(code, name.split(b"\0")[0].decode("latin-1"), text, sub_code)


def unpack_polydata(content: bytes) -> Polydata:
    """Read what ``pack_polydata`` writes: lines of two points, triangles, scalars of points.

    Raises:
        ProtocolError: sizes that do not fit, point numbers that do not exist, other cells.
    """
    try:
        n_points, *cells, n_attributes = _POLYDATA.unpack_from(content)
        take = _Reader(content, _POLYDATA.size)
        points = take.numbers(3 * n_points, ">f4").reshape(-1, 3).astype(np.float32)
        sizes = dict(zip(("vertices", "lines", "polygons", "strips"), cells[1::2], strict=True))
        counts = dict(zip(sizes, cells[::2], strict=True))
        if counts["vertices"] or counts["strips"]:
            raise ProtocolError("POLYDATA: only lines and polygons are read.")
        cells_of = {name: take.numbers(size // 4, ">u4") for name, size in sizes.items()}
        kinds = [_ATTRIBUTE.unpack(take.bytes(_ATTRIBUTE.size)) for _ in range(n_attributes)]
        if any(kind != (_POINT_SCALARS, 1, n_points) for kind in kinds):
            raise ProtocolError("POLYDATA: only attributes of one number a point are read.")
        names = take.names(n_attributes)
        scalars = {name: take.numbers(n_points, ">f4").astype(np.float32) for name in names}
        if take.left or any(size % 4 for size in sizes.values()):
            raise ProtocolError("POLYDATA: its sizes do not fit.")
    except (struct.error, ValueError, UnicodeDecodeError) as error:
        raise ProtocolError(f"POLYDATA is damaged: {error}.") from error
    return Polydata(
        points,
        _corners(cells_of["polygons"], counts["polygons"], 3, n_points),
        _corners(cells_of["lines"], counts["lines"], 2, n_points),
        scalars,
    )


def _corners(
    numbers: UInt32[np.ndarray, " m"], count: int, size: int, n_points: int
) -> Int[np.ndarray, "count size"]:
    if len(numbers) != count * (1 + size):
        raise ProtocolError(f"POLYDATA: {count} cells of {size} points each do not fit.")
    cells = numbers.reshape(-1, 1 + size)
    if (cells[:, 0] != size).any() or (cells[:, 1:] >= n_points).any():
        raise ProtocolError("POLYDATA: cells of another size, or of points that do not exist.")
    return cells[:, 1:].astype(np.int32)


class _Reader:
    """Takes pieces one after another, and says where there is nothing left."""

    def __init__(self, content: bytes, at: int) -> None:
        self._content, self._at = content, at

    @property
    def left(self) -> int:
        return len(self._content) - self._at

    def bytes(self, size: int) -> bytes:
        piece = self._content[self._at : self._at + size]
        if len(piece) != size:
            raise ValueError(f"{size} bytes wanted at {self._at}, {len(piece)} are there")
        self._at += size
        return piece

    def numbers(self, count: int, kind: str) -> Num[np.ndarray, " n"]:
        return np.frombuffer(self.bytes(4 * count), kind)

    def names(self, count: int) -> list[str]:
        """Texts that each end with a zero byte; one more where that makes the size even."""
        start, names = self._at, []
        for _ in range(count):
            end = self._content.index(b"\0", self._at)
            names.append(self.bytes(end + 1 - self._at)[:-1].decode("ascii"))
        self.bytes((self._at - start) % 2)
        return names
