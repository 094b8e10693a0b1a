"""Small operations on label grids that several files of this package need."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64, UInt8

from tumortrack.core.geometry import spacing_mm
from tumortrack.core.types import LabelVolume

Box = tuple[slice, slice, slice]

_AT_ONCE = 2**16  # labels: counting makes eight bytes of each


def voxel_ml(lps_from_index: Float[np.ndarray, "4 4"]) -> float:
    """The volume of one voxel in ml."""
    return float(abs(np.linalg.det(lps_from_index[:3, :3]))) / 1000


def label_counts(labels: UInt8[np.ndarray, "i j k"]) -> Int64[np.ndarray, " 256"]:
    """How many voxels have each label."""
    flat = labels.ravel(order="K")
    counts = np.zeros(256, np.int64)
    for start in range(0, len(flat), _AT_ONCE):
        counts += np.bincount(flat[start : start + _AT_ONCE], minlength=256)
    return counts


def components(mask: Bool[np.ndarray, "i j k"]) -> tuple[Int32[np.ndarray, "i j k"], np.ndarray]:
    """Connected pieces (26 neighbours), numbered 1, 2, ... largest first, and their voxel counts.

    Returns:
        The numbered grid (0 outside) and counts, ``counts[n - 1]`` of piece n.
    """
    from scipy import ndimage

    pieces, n = ndimage.label(mask, np.ones((3, 3, 3)))
    counts = np.bincount(pieces.ravel(), minlength=n + 1)
    counts[0] = 0
    order = np.argsort(-counts, kind="stable")[:n]
    rank = np.zeros(n + 1, np.int32)
    rank[order] = np.arange(1, n + 1)
    return rank[pieces], counts[order]


def bounding_box(
    mask: Bool[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    margin_mm: float,
) -> Box:
    """The slices that hold every True voxel and a margin, within the grid."""
    margin = np.ceil(margin_mm / spacing_mm(lps_from_index)).astype(int)
    box = []
    for axis in range(3):
        hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        lower = max(0, int(hit[0]) - int(margin[axis]))
        box.append(slice(lower, min(mask.shape[axis], int(hit[-1]) + 1 + int(margin[axis]))))
    return (box[0], box[1], box[2])


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
    """The labels round everything labelled, with a margin of zeros on every side."""
    box = bounding_box(labels > 0, lps_from_index, 0.0)
    margin = np.ceil(margin_mm / spacing_mm(lps_from_index)).astype(int)
    affine = moved_origin(lps_from_index, box)
    affine[:3, 3] -= lps_from_index[:3, :3] @ margin
    return LabelVolume(np.pad(labels[box], [(m, m) for m in margin.tolist()]), affine)
