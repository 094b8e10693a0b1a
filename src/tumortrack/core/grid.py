"""Voxel grids: reading and checks shared by all file formats, and operations on masks and boxes."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from jaxtyping import Bool, Float, Int32, Int64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.types import LabelVolume

Box = tuple[slice, slice, slice]

_MAX_VOXELS = 2**30
_MAX_BYTES = 8 * 2**30
_SPACING_RANGE_MM = (0.05, 10.0)
GZIP_BEST = 1100  # deflate cannot compress better than 1032 : 1
_USUAL_BEST, _MUCH = 100, 2**30  # a better ratio is refused if the volume has so many bytes
_MOST_BEHIND = 16 * 2**20  # bytes after the voxels
_SAVE_AS = {  # of formats that no reader here knows
    (".mha", ".mhd", ".mgz", ".mgh", ".mnc", ".npy", ".npz", ".vti", ".tif"): ".nii.gz or .nrrd",
    (".vtk", ".vtp", ".vtu", ".glb", ".gltf", ".3mf", ".off"): "STL, OBJ or PLY",
}


class Segment(NamedTuple):
    """A label with a name. Segments may overlap; ``mask`` reads its voxels, bool (i, j, k)."""

    number: int
    name: str
    mask: Callable[[], np.ndarray]


@dataclass(frozen=True, eq=False)
class RawVolume:
    """Voxels in the file's own number type; axes (i, j, k); ``lps_from_index``: index -> LPS mm.
    ``notes``: what else was there and was left out. ``patient``: as the file states. ``segments``:
    of a file whose labels have names; ``array`` is then a map of them."""

    array: np.ndarray
    lps_from_index: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()
    patient: Patient = NOBODY
    segments: tuple[Segment, ...] = ()


def check_suffix(path: Path) -> None:
    """Raises InputError, which says what to save instead, for kinds of files that are not read."""
    for suffixes, wanted in _SAVE_AS.items():
        if path.name.lower().endswith(suffixes):
            raise InputError(f"{path}: this kind of file is not read. Save it as {wanted}.")


def check_size(
    path: Path,
    shape: tuple[int, ...],
    bytes_per_voxel: int,
    compressed: bool,
    stored: int | None = None,
) -> None:
    """Check, before anything is allocated, that a shape is a 3-D volume within the limits and that
    the file (``stored`` bytes; None: its size) is long enough for it; InputError where not."""
    dims = " x ".join(map(str, shape))
    if len(shape) != 3:
        raise InputError(f"{path} has {len(shape)} axes ({dims}). Export one phase or channel.")
    if min(shape) < 2:
        raise InputError(f"{path} is {dims} voxels: a flat image. Give a whole 3-D volume.")
    voxels = math.prod(int(n) for n in shape)
    needed = voxels * bytes_per_voxel
    if voxels > _MAX_VOXELS or needed > _MAX_BYTES:
        raise InputError(
            f"{path} claims {dims} voxels of {bytes_per_voxel} bytes; the limit is {_MAX_VOXELS} "
            "voxels and 8 GiB. Crop it round the organ."
        )
    stored = path.stat().st_size if stored is None else stored
    if compressed and needed > _MUCH and _USUAL_BEST * stored < needed <= GZIP_BEST * stored:
        raise InputError(
            f"{path} would unpack from {stored / 2**20:.1f} MiB to {needed / 2**30:.1f} GiB, as no "
            "scan does. Crop it round the organ, or store it as 8-bit or 16-bit numbers."
        )
    if stored * (GZIP_BEST if compressed else 1) < needed:
        raise InputError(f"{path} is shorter than its header says ({needed} bytes of voxels).")


@contextmanager
def volume_stream(path: Path, compressed: bool, start: int = 0) -> Iterator[BufferedIOBase]:
    """The content of a volume file from byte ``start`` on, unpacked if it is compressed. Raises
    InputError where reading it fails."""
    try:
        with path.open("rb") as stored:
            stored.seek(start)
            yield gzip.GzipFile(fileobj=stored) if compressed else stored
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path} is truncated or damaged: {error}.") from error


def read_voxels(
    path: Path, stream: BufferedIOBase, shape: tuple[int, ...], dtype: np.dtype, compressed: bool
) -> np.ndarray:
    """The next voxels of a stream, first axis fastest, in native byte order. A compressed stream is
    read to its end, where its checksum is. Raises InputError: too few bytes, or far too many."""
    n_bytes = math.prod(shape) * dtype.itemsize
    data = stream.read(n_bytes)
    if len(data) < n_bytes:
        raise InputError(f"{path} is truncated: {len(data)} of {n_bytes} bytes of voxels.")
    if compressed and len(stream.read(_MOST_BEHIND + 1)) > _MOST_BEHIND:
        raise InputError(f"{path} holds much more than its header says. Export it again.")
    array = np.frombuffer(data, dtype).reshape(shape, order="F")
    return array.astype(dtype.newbyteorder("="), copy=False)


def check_affine(path: Path, lps_from_index: Float[np.ndarray, "4 4"]) -> None:
    """InputError for a NaN or singular affine, and for a spacing that is not plausibly millimetres
    (metres are recognised)."""
    linear = lps_from_index[:3, :3]
    if not np.isfinite(lps_from_index).all():
        raise InputError(f"{path}: the affine has NaN or infinite numbers. Export it again.")
    if np.abs(lps_from_index).max() > 1e6:
        raise InputError(f"{path}: the affine puts voxels kilometres away. Export it again.")
    steps = spacing_mm(lps_from_index)
    if min(steps) <= 0 or abs(np.linalg.det(linear / np.where(steps > 0, steps, 1))) < 0.1:
        raise InputError(f"{path}: the affine is singular. Export it again.")
    low, high = _SPACING_RANGE_MM
    if min(steps) < low or max(steps) > high:
        text = " x ".join(f"{s:.6g}" for s in steps)
        is_metres = low <= 1000 * min(steps) and 1000 * max(steps) <= high
        raise InputError(
            f"{path}: voxels of {text} mm; allowed are {low:g} to {high:g} mm. Correct the "
            f"header{': it looks like metres' if is_metres else ''}, and export it again."
        )


def voxel_ml(lps_from_index: Float[np.ndarray, "4 4"]) -> float:
    return float(abs(np.linalg.det(lps_from_index[:3, :3]))) / 1000


def face_areas_mm2(lps_from_index: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
    """Of a voxel's faces across each axis."""
    i, j, k = lps_from_index[:3, :3].T
    return np.linalg.norm([np.cross(j, k), np.cross(k, i), np.cross(i, j)], axis=1)


def label_counts(labels: UInt8[np.ndarray, "i j k"]) -> Int64[np.ndarray, " 256"]:
    """How many voxels have each label. Layer by layer: bincount makes eight bytes of each voxel."""
    along = labels if labels.strides[0] >= labels.strides[2] else labels.T
    return np.sum([np.bincount(layer.ravel(), minlength=256) for layer in along], axis=0)


def components(mask: Bool[np.ndarray, "i j k"]) -> tuple[Int32[np.ndarray, "i j k"], np.ndarray]:
    """Connected pieces (26 neighbours), numbered 1, 2, ... largest first, 0 outside; and their
    voxel counts, largest first."""
    from scipy import ndimage

    pieces, n = ndimage.label(mask, np.ones((3, 3, 3)))
    counts = np.bincount(pieces.ravel(), minlength=n + 1)
    counts[0] = 0
    order = np.argsort(-counts, kind="stable")[:n]
    rank = np.zeros(n + 1, np.int32)
    rank[order] = np.arange(1, n + 1)
    return rank[pieces], counts[order]


def tight_box(mask: Bool[np.ndarray, "i j k"]) -> Box:
    """The smallest box that holds every True voxel; there must be one."""
    hits = [np.flatnonzero(mask.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    i, j, k = (slice(int(hit[0]), int(hit[-1]) + 1) for hit in hits)
    return i, j, k


def grown_box(
    box: Iterable[slice], shape: tuple[int, ...], margin: npt.ArrayLike = (0, 0, 0)
) -> Box:
    """A box grown on every side by a margin (3,) in voxels, clipped to the grid."""
    i, j, k = (
        slice(max(0, s.start - m), min(n, s.stop + m))
        for s, n, m in zip(box, shape, np.asarray(margin).tolist(), strict=True)
    )
    return i, j, k


def bounding_box(
    mask: Bool[np.ndarray, "i j k"], lps_from_index: Float[np.ndarray, "4 4"], margin_mm: float
) -> Box:
    """The box that holds every True voxel and a margin, clipped to the grid."""
    margin = np.ceil(margin_mm / spacing_mm(lps_from_index)).astype(int)
    return grown_box(tight_box(mask), mask.shape, margin)


def extent_mm(box: tuple[slice, ...], steps_mm: np.ndarray) -> Float[np.ndarray, " 3"]:
    """Edge lengths of a box of voxels."""
    return np.array([s.stop - s.start for s in box]) * steps_mm


def depth_mm(mask: Bool[np.ndarray, "i j k"], steps_mm: np.ndarray) -> Float[np.ndarray, "i j k"]:
    """Distance of each True voxel to the nearest False one; beyond the grid all are False."""
    from scipy import ndimage

    return ndimage.distance_transform_edt(np.pad(mask, 1), sampling=steps_mm)[1:-1, 1:-1, 1:-1]


def moved_origin(lps_from_index: Float[np.ndarray, "4 4"], box: Box) -> Float[np.ndarray, "4 4"]:
    """The affine of a cropped grid."""
    out = lps_from_index.copy()
    out[:3, 3] += lps_from_index[:3, :3] @ np.array([s.start for s in box], float)
    return out


def cropped(
    labels: UInt8[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    margin_mm: float = 8.0,
) -> LabelVolume:
    """The labels cropped to what is labelled, with a margin of zeros on every side."""
    box = tight_box(labels > 0)
    margin = np.ceil(margin_mm / spacing_mm(lps_from_index)).astype(int)
    affine = moved_origin(lps_from_index, box)
    affine[:3, 3] -= lps_from_index[:3, :3] @ margin
    return LabelVolume(np.pad(labels[box], [(m, m) for m in margin.tolist()]), affine)


def grid_round(
    box_mm: Float[np.ndarray, "2 3"], step_mm: float, margin_mm: float
) -> tuple[Float[np.ndarray, "4 4"], tuple[int, int, int]]:
    """``frame_from_index`` and shape of an axis-aligned grid that holds a box and a margin."""
    frame_from_index = np.diag([step_mm, step_mm, step_mm, 1.0])
    frame_from_index[:3, 3] = box_mm[0] - margin_mm
    counts = np.ceil((box_mm[1] - box_mm[0] + 2 * margin_mm) / step_mm).astype(int) + 1
    i, j, k = counts.tolist()
    return frame_from_index, (i, j, k)
