"""Point clouds as PCD, through pypcd4; claimed sizes are checked first."""

from __future__ import annotations

import io
import struct

import numpy as np

from tumortrack.core.errors import InputError


def parse_pcd_points(content: bytes, name: str, largest: int) -> np.ndarray:
    """The points' x, y, z as floats (n, 3), in the file's unit; ascii, binary or compressed.

    Raises:
        InputError: no PCD, damaged, larger than ``largest`` bytes unpacked, or no x, y, z.
    """
    from pypcd4 import PointCloud

    _check_size(content, name, largest)
    try:
        cloud = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(content)))
        table = np.atleast_1d(cloud.pc_data)
        points = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except Exception as error:  # pypcd4 raises anything on a damaged file
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{name} cannot be read as PCD with x, y and z: {reason}.") from error
    if len(points) != cloud.metadata.points:
        raise InputError(
            f"{name} claims {cloud.metadata.points} points but holds {len(points)}; it is "
            "damaged. Export it again."
        )
    return points


def _check_size(content: bytes, name: str, largest: int) -> None:
    """Hold the claimed size against the limit, before pypcd4 allocates it."""
    header, found, body = content[: 64 * 1024].partition(b"\nDATA ")
    fields = {line.split()[0]: line.split()[1:] for line in header.splitlines() if line.split()}
    try:
        points = int(fields[b"POINTS"][0])
        sizes = [int(size) for size in fields[b"SIZE"]]
        counts = [int(count) for count in fields.get(b"COUNT", [b"1"] * len(sizes))]
        claimed = points * sum(size * n for size, n in zip(sizes, counts, strict=True))
        start = len(header) + len(found) + body.index(b"\n") + 1
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{name} is no PCD file (its header lacks or garbles a line).") from error
    if body.startswith(b"binary_compressed"):
        packed, unpacked = struct.unpack_from("<II", content[start : start + 8].ljust(8, b"\0"))
        too_large = unpacked > largest or packed > len(content) - start - 8
        too_large |= claimed > unpacked
    else:  # ascii: at least a digit and a blank for each number
        room = len(content) - start
        numbers = 2 * points * sum(counts)
        too_large = (claimed > room) if body.startswith(b"binary") else (numbers > room + 1)
    if too_large or points < 0 or claimed > largest or sum(counts) > 1000:
        raise InputError(f"{name} claims {points} points but has no room for them; it is damaged.")
