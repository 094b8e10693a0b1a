"""Point clouds as .npz, never through pickle; claimed shapes are checked first."""

from __future__ import annotations

import io
import zipfile

import numpy as np

from tumortrack.core.errors import InputError


def parse_npz_points(content: bytes, name: str, largest: int) -> tuple[np.ndarray, str]:
    """The points (n, 3), in the file's unit, and the name of their array: ``points_mm``, else
    ``points``, else the only one of that shape.

    Raises:
        InputError: no .npz, damaged, larger than ``largest`` bytes unpacked, or no such array.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_size(archive, name, largest)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            preferred = [key for key in ("points_mm", "points") if key in arrays.files]
            found = {key: arrays[key] for key in preferred[:1] or arrays.files}
    except InputError:
        raise
    except Exception as error:  # zipfile and numpy raise anything on a damaged file
        raise InputError(f"{name} cannot be read as .npz: {error or type(error)}.") from error
    clouds = [
        key
        for key, array in found.items()
        if array.ndim == 2 and array.shape[1] == 3 and array.dtype.kind in "fiu"
    ]
    if len(clouds) != 1:
        shapes = ", ".join(f"{key} {array.shape}" for key, array in found.items())
        raise InputError(
            f"{name} must hold points_mm, points, or exactly one (n, 3) array of numbers; "
            f"it has: {shapes or 'nothing'}."
        )
    return found[clouds[0]], clouds[0]


def _check_size(archive: zipfile.ZipFile, name: str, largest: int) -> None:
    """Hold each array's claimed shape against its bytes; numpy allocates what a header claims."""
    if sum(member.file_size for member in archive.infolist()) > largest:
        raise InputError(f"{name} unpacks to more than 256 MiB; thin the cloud first.")
    for member in archive.infolist():
        with archive.open(member) as stream:
            major, _ = np.lib.format.read_magic(stream)
            read_header = (
                np.lib.format.read_array_header_1_0
                if major == 1
                else np.lib.format.read_array_header_2_0
            )
            shape, _, dtype = read_header(stream)
        claimed = dtype.itemsize
        for length in shape:
            claimed *= length
        if claimed > member.file_size or min(shape, default=0) < 0:
            raise InputError(f"{name}: {member.filename} claims more than the file holds.")
