"""What messages carry: TRANSFORM, STATUS, POLYDATA, STRING as values and as bytes.

Source: the protocol's Documents/Protocol/transform.md, status.md, polydata.md and string.md.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, Num, UInt32

from tumortrack.live.igtl.message import ProtocolError

# STATUS codes
OK, NOT_FOUND, CHECKSUM_ERROR, NOT_READY, NOT_PRESENT, EXITING = 1, 4, 9, 13, 16, 19
_STATUS = struct.Struct("> H q 20s")
_POLYDATA = struct.Struct("> 10I")
_ATTRIBUTE = struct.Struct("> B B I")
_POINT_SCALARS = 0x00


@dataclass(frozen=True)
class IgtlStatus:
    """How the sender is: ``code`` 1 is well; ``name`` at most 20 characters."""

    code: int
    name: str
    text: str
    sub_code: int = 0


@dataclass(frozen=True, eq=False)
class Polydata:
    """Points (n, 3) and cells over them; ``scalars``: one number a point, by name.

    ``triangles`` (f, 3) and ``segments`` (s, 2) hold point numbers.
    """

    points: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "f 3"]
    segments: Int[np.ndarray, "s 2"] = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    scalars: dict[str, Num[np.ndarray, " n"]] = field(default_factory=dict)


def pack_transform(b_from_a: Float[np.ndarray, "4 4"]) -> bytes:
    """Its upper three rows, column by column, float32."""
    return np.asarray(b_from_a)[:3].T.astype(">f4").tobytes()


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


def pack_status(status: IgtlStatus) -> bytes:
    """The text ends with a zero byte, as the protocol's own library writes it."""
    name = status.name.encode("ascii", "replace")[:20]
    return _STATUS.pack(status.code, status.sub_code, name) + status.text.encode() + b"\0"


def unpack_status(content: bytes) -> IgtlStatus:
    """Raises ProtocolError: shorter than 30 bytes."""
    if len(content) < _STATUS.size:
        raise ProtocolError(f"STATUS has at least {_STATUS.size} bytes, not {len(content)}.")
    code, sub_code, name = _STATUS.unpack_from(content)
    text = content[_STATUS.size :].split(b"\0")[0].decode("utf-8", "replace")
    return IgtlStatus(code, name.split(b"\0")[0].decode("latin-1"), text, sub_code)


def pack_string(text: str) -> bytes:
    """UTF-8. Raises ProtocolError: more than 65535 bytes."""
    data = text.encode()
    if len(data) > 65535:
        raise ProtocolError(f"STRING holds at most 65535 bytes, not {len(data)}.")
    return struct.pack("> H H", 3 if text.isascii() else 106, len(data)) + data


def unpack_string(content: bytes) -> str:
    """Raises ProtocolError: its length does not fit, or it is no UTF-8."""
    try:
        _, size = struct.unpack_from("> H H", content)
        if size != len(content) - 4:
            raise ProtocolError(f"STRING says {size} bytes and has {len(content) - 4}.")
        return content[4:].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise ProtocolError(f"STRING is damaged: {error}.") from error


def pack_polydata(data: Polydata) -> bytes:
    """Triangles are sent as polygons, segments as lines."""
    lines, polygons = _cells(data.segments), _cells(data.triangles)
    head = _POLYDATA.pack(
        len(data.points),
        *(0, 0),  # vertices: 3D Slicer's reader writes past its memory at the second one
        *(len(data.segments), len(lines)),
        *(len(data.triangles), len(polygons)),
        *(0, 0),  # triangle strips
        len(data.scalars),
    )
    points = np.asarray(data.points).astype(">f4").tobytes()
    kinds = [_ATTRIBUTE.pack(_POINT_SCALARS, 1, len(values)) for values in data.scalars.values()]
    names = b"".join(name.encode("ascii") + b"\0" for name in data.scalars)
    values = [np.asarray(values).astype(">f4").tobytes() for values in data.scalars.values()]
    padding = bytes(len(names) % 2)
    return b"".join((head, points, lines, polygons, *kinds, names, padding, *values))


def _cells(cells: np.ndarray) -> bytes:
    """Each cell as its number of points and their numbers."""
    count, size = cells.shape
    out = np.empty((count, 1 + size), ">u4")
    out[:, 0], out[:, 1:] = size, cells
    return out.tobytes()


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
        found = {name: take.numbers(size // 4, ">u4") for name, size in sizes.items()}
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
        _corners(found["polygons"], counts["polygons"], 3, n_points),
        _corners(found["lines"], counts["lines"], 2, n_points),
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
        start, found = self._at, []
        for _ in range(count):
            end = self._content.index(b"\0", self._at)
            found.append(self.bytes(end + 1 - self._at)[:-1].decode("ascii"))
        self.bytes((self._at - start) % 2)
        return found
