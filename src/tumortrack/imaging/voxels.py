"""A voxel array as a file stores it, with the checks that hold for every format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm

MAX_VOXELS = 2**30
MAX_BYTES = 8 * 2**30
SPACING_RANGE_MM = (0.05, 10.0)
_GZIP_BEST = 1100  # deflate cannot compress better than 1032 : 1


@dataclass(frozen=True, eq=False)
class RawVolume:
    """Voxels in the file's own number type; axes (i, j, k); ``lps_from_index``: index -> LPS mm.

    ``notes`` say what lay beside them and was left out.
    """

    array: np.ndarray
    lps_from_index: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()


def check_size(path: Path, shape: tuple[int, ...], bytes_per_voxel: int) -> None:
    """Refuse a shape that is no volume or too large, before anything is allocated.

    Raises:
        InputError: not three axes, fewer than two voxels along one, or above the limits.
    """
    dims = " x ".join(str(n) for n in shape)
    if len(shape) != 3:
        raise InputError(
            f"{path} has {len(shape)} axes ({dims}); one 3-D volume is needed. Export a single "
            "phase or channel."
        )
    if min(shape) < 2:
        raise InputError(f"{path} is {dims} voxels: a flat image. Give a whole 3-D volume.")
    voxels = 1
    for n in shape:
        voxels *= int(n)
    if voxels > MAX_VOXELS or voxels * bytes_per_voxel > MAX_BYTES:
        raise InputError(
            f"{path} claims {dims} voxels of {bytes_per_voxel} bytes; the limit is {MAX_VOXELS} "
            "voxels and 8 GiB. Crop or resample the volume round the kidney."
        )


def check_stored(path: Path, needed_bytes: int, compressed: bool) -> None:
    """Refuse a file too short to hold what its header claims, before allocating it.

    Raises:
        InputError: the file is truncated, or its header is damaged.
    """
    most = path.stat().st_size * (_GZIP_BEST if compressed else 1)
    if most < needed_bytes:
        raise InputError(
            f"{path} is shorter than its header says ({needed_bytes} bytes of voxels): truncated "
            "or damaged. Copy or export it again."
        )


def check_affine(path: Path, lps_from_index: Float[np.ndarray, "4 4"]) -> None:
    """Refuse a NaN or singular affine, and spacing that is not plausibly millimetres.

    Raises:
        InputError: with the reason; metres are recognised.
    """
    linear = lps_from_index[:3, :3]
    if not np.isfinite(lps_from_index).all():
        raise InputError(f"{path}: the affine has NaN or infinite numbers. Export it again.")
    if np.abs(lps_from_index).max() > 1e6:
        raise InputError(f"{path}: the affine puts voxels kilometres away. Export it again.")
    steps = spacing_mm(lps_from_index)
    if min(steps) <= 0 or abs(np.linalg.det(linear / np.where(steps > 0, steps, 1))) < 0.1:
        raise InputError(
            f"{path}: the affine is singular (its axes do not span space). Export it again."
        )
    low, high = SPACING_RANGE_MM
    if min(steps) < low or max(steps) > high:
        text = " x ".join(f"{s:.6g}" for s in steps)
        metres = low <= 1000 * min(steps) and 1000 * max(steps) <= high
        hint = (
            "This looks like metres: multiply the spacing by 1000 and export again."
            if metres
            else "Correct the header and export again."
        )
        raise InputError(
            f"{path}: voxels of {text} mm; allowed are {low:g} to {high:g} mm on each axis. {hint}"
        )


def check_numbers(path: Path, dtype: npt.DTypeLike) -> None:
    """Refuse voxels that are not plain integers or real numbers.

    Raises:
        InputError: colours, complex numbers or structures.
    """
    if np.dtype(dtype).kind not in "iuf":
        raise InputError(
            f"{path}: voxels are {np.dtype(dtype)}; a CT or a label map of plain numbers is needed."
        )
