"""Point clouds as PLY (Turk 1994, "The PLY Polygon File Format").

Own code, because available readers are either GPL or allocate whatever a header claims; here counts
are checked against the file's size first.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tumortrack.core.errors import InputError, readable
from tumortrack.core.store import write_atomically

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_NAMES = {"u1": "uchar", "i4": "int", "f4": "float", "f8": "double"}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
CAMERA = "camera (x right, y down, z forward)"
_LONGEST_HEADER = 64 * 1024  # bytes


def parse_ply_properties(content: bytes, name: str, wanted: Sequence[str] = "xyz") -> np.ndarray:
    """The wanted vertex properties as floats (n, len(wanted)), in the file's unit; faces are
    ignored. Raises InputError: not a PLY, fewer bytes than the header claims, a missing property.
    """
    end = content.find(b"end_header", 0, _LONGEST_HEADER)
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or start == 0:
        raise InputError(f"{name} is no PLY file (no header from 'ply' to 'end_header').")
    lines = [line.split() for line in content[:end].decode("latin-1").splitlines()]
    form = next((line[1] for line in lines if len(line) > 1 and line[0] == "format"), "missing")
    if form not in _ORDERS:
        raise InputError(f"{name}: PLY format {form!r}; allowed: {', '.join(_ORDERS)}.")
    count, columns = _vertex_layout(lines, name)
    if not set(wanted) <= columns.keys():
        raise InputError(f"{name}: its vertices have {list(columns)}, not {', '.join(wanted)}.")
    body = content[start:]
    if form == "ascii":
        places = [list(columns).index(column) for column in wanted]
        return _ascii(body, count, places, len(columns), name)
    dtype = np.dtype([(column, _ORDERS[form] + code) for column, code in columns.items()])
    if count * dtype.itemsize > len(body):
        raise _cut_off(name, count, len(body) // dtype.itemsize)
    table = np.frombuffer(body, dtype, count)
    with np.errstate(invalid="ignore"):  # signalling NaNs, as a wrongly stated byte order gives
        return np.stack([table[column].astype(np.float64) for column in wanted], axis=1)


def _vertex_layout(lines: list[list[str]], name: str) -> tuple[int, dict[str, str]]:
    """Number of vertices, and the type code of each property (in lower case, as some programs
    write X, Y, Z), in the file's order."""
    count, columns, inside = -1, {}, False
    for line in lines:
        match line:
            case ["element", "vertex", number] if number.isdecimal() and len(number) < 12:
                count, inside = int(number), True
            case ["element", *_] if count < 0:
                raise InputError(f"{name}: the PLY's first element must be 'vertex n'.")
            case ["element", *_]:
                inside = False
            case ["property", kind, column] if (
                inside and kind in _TYPES and column.lower() not in columns
            ):
                columns[column.lower()] = _TYPES[kind]
            case ["property", *_] if inside:
                raise InputError(f"{name}: vertex property {' '.join(line)!r} is not understood.")
    if count < 0:
        raise InputError(f"{name}: the PLY has no vertices.")
    return count, columns


def _ascii(body: bytes, count: int, wanted: list[int], columns: int, name: str) -> np.ndarray:
    if 2 * count * columns > len(body) + 1:  # at least a digit and a blank per number
        raise _cut_off(name, count, len(body) // (2 * columns))
    if count == 0:
        return np.empty((0, len(wanted)))
    with readable(name, "has a vertex that is no row of numbers"):
        points = np.loadtxt(
            io.BytesIO(body), comments=None, usecols=wanted, max_rows=count, ndmin=2
        )
    if len(points) < count:
        raise _cut_off(name, count, len(points))
    return points


def _cut_off(name: str, claimed: int, held: int) -> InputError:
    return InputError(f"{name} claims {claimed} points but has room for {held}: it is cut off.")


def write_cloud_ply(path: Path, points_mm: np.ndarray, **point_properties: np.ndarray) -> None:
    """Write camera-frame points (n, 3); see ``cloud_ply``."""
    write_atomically(path, cloud_ply(points_mm, point_properties))


def cloud_ply(
    points_mm: np.ndarray, point_properties: Mapping[str, np.ndarray], frame: str = CAMERA
) -> bytes:
    """Points (n, 3) as binary little-endian PLY, float32 mm, with further properties (``label``,
    ``probability``): arrays (n,) of uint8, int32, float32 or float64. A comment names the frame.
    Raises InputError: a property of another length or type."""
    points = np.asarray(points_mm, "<f4")
    columns = dict(zip("xyz", points.T, strict=True)) | dict(point_properties)
    for name, values in columns.items():
        if values.shape != (len(points),) or values.dtype.str[1:] not in _NAMES:
            raise InputError(
                f"point property {name!r} is {values.dtype} {values.shape}; it must be one of "
                f"uint8, int32, float32, float64, and one value for each of {len(points)} points."
            )
    codes = {name: values.dtype.str[1:] for name, values in columns.items()}
    dtype = [(name, "<" + code) for name, code in codes.items()]
    table = np.rec.fromarrays([*columns.values()], dtype)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment frame {frame}, unit mm",
        f"element vertex {len(points)}",
        *(f"property {_NAMES[code]} {name}" for name, code in codes.items()),
        "end_header\n",
    ]
    return "\n".join(header).encode() + table.tobytes()
