"""Kernels on lattices of logits: refinement, filling, trilinear interpolation.

Compiled: tumortrack's native/exact/occupancy.c. Logits are compared and mixed, whatever they are.
Flat indices are of voxels or points of a lattice of a ``shape``.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from tumortrack.native import BOOL, F32, I64, U8, kernel

Shape = tuple[int, int, int]
Flat = Int64[np.ndarray, " _"]
Rows = Float32[np.ndarray, "n classes"]
Lattice = Float32[np.ndarray, "_ _ _ classes"]
Labels = UInt8[np.ndarray, "_ _ _"]

_LOGITS, _LABELS = F32["a", "b", "c", "classes"].any_value, U8["a", "b", "c"]
_FINE, _ROWS = F32["i", "j", "k", "classes"], F32["n", "classes"]

_halved = kernel("halved", _LOGITS, _FINE.out, int, int)
_leading = kernel("leading", _ROWS.any_value, U8["n"].out, F32["n"].out)
# ... -> whether each point is; room for logits
_mispredicted = kernel(
    "mispredicted", _LOGITS, I64[3], I64["n"], _ROWS.any_value, float, BOOL["n"].out,
    F32["classes"].out,
)  # fmt: skip
# Certain labels, planes, room for a row -> the number of cells whose corners do not agree
_open_cells = kernel("open_cells", U8["a", "b", "c"], int, int, U8["c"].out, result=int)
# Lattice, labels, certain labels, voxels, planes, room for a row; what is noted of voxels
_fill_cells = kernel(
    "fill_cells", _LOGITS, _LABELS, _LABELS, U8["i", "j", "k"].out, int, int, U8["c"].out,
    I64["n"].out, _ROWS.out, BOOL["n"].out, result=int,
)  # fmt: skip
_neighbours = kernel("neighbours", I64[3], I64["n"], BOOL["all"].out, I64["most"].out, result=int)
_trilinear = kernel("trilinear", _LOGITS, F32["n", 3].any_value, _ROWS.out)


def halved(coarse: Lattice, fine: Lattice, first: int, last: int) -> None:
    """Logits at half the step, linear between the coarse ones (a, b, c, classes), into planes
    ``first`` to ``last`` of ``fine`` (2a - 1, 2b - 1, 2c - 1, classes)."""
    _check_half(coarse.shape, fine.shape)
    _halved(_ordered(coarse), fine, *_planes(first, last, len(fine)))


def leading(logits: Rows) -> tuple[UInt8[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """The label of the largest logit in every row, and its lead over the second."""
    labels, leads = np.empty(len(logits), np.uint8), np.empty(len(logits), np.float32)
    _leading(_ordered(logits), labels, leads)
    return labels, leads


def mispredicted(coarse: Lattice, shape: Shape, flat: Flat, logits: Rows, limit: float) -> Flat:
    """Which points of the lattice of half the step have another label than linear interpolation
    predicts, where the prediction of the two labels' difference is off by more than the limit.
    ``logits``: those queried at the points."""
    _check_half(coarse.shape, shape)
    _check_indices(shape, flat)
    wrong, room = np.empty(len(flat), np.bool_), np.empty(coarse.shape[3], np.float32)
    points = np.array(shape, np.int64), flat, _ordered(logits)
    _mispredicted(_ordered(coarse), *points, limit, wrong, room)
    return flat[wrong]


def fill_cells(
    coarse: Lattice, labels: Labels, certain: Labels, fine: Labels, first: int, last: int
) -> tuple[Flat, Rows, Bool[np.ndarray, " n"]]:
    """Fill the voxels ``fine`` (i, j, k), of half the step, from the lattice ``coarse`` (a, b, c,
    classes), its ``labels`` (a, b, c) and the ``certain`` ones, 255 elsewhere; cell by cell, coarse
    planes ``first`` to ``last``. A cell whose corners have the same certain label is filled with
    it: by linear interpolation none of its voxels is less certain. The voxels of all other cells
    are returned: flat indices, linear logits, and whether they lie between coarse points."""
    _check_half(coarse.shape, fine.shape)
    first, last = _planes(first, last, len(coarse))
    room = np.empty(coarse.shape[2], np.uint8)
    most = 8 * _open_cells(certain, first, last, room)
    flat, between = np.empty(most, np.int64), np.empty(most, np.bool_)
    expected = np.empty((most, coarse.shape[3]), np.float32)
    noted = flat, expected, between
    count = _fill_cells(_ordered(coarse), labels, certain, fine, first, last, room, *noted)
    return flat[:count].copy(), expected[:count].copy(), between[:count].copy()


def neighbours(shape: Shape, frontier: Flat, known: Bool[np.ndarray, " all"]) -> Flat:
    """The voxels that touch these and are not known yet. They are marked as known, since the caller
    queries them next."""
    _check_indices(shape, frontier)
    if known.size != np.prod(shape):
        raise ValueError(f"{known.size} voxels are said to be known or not; shape {shape}")
    flat = np.empty(27 * len(frontier), np.int64)
    count = _neighbours(np.array(shape, np.int64), frontier, known, flat)
    return flat[:count].copy()


def trilinear(values: Lattice, places: Float32[np.ndarray, "n 3"]) -> Rows:
    """Trilinear interpolation of a lattice at places, in its steps; outside the value at the
    nearest border."""
    if 0 in values.shape[:3]:
        raise ValueError(f"a lattice without points: {values.shape}")
    out = np.empty((len(places), values.shape[3]), np.float32)
    _trilinear(_ordered(values), _ordered(places), out)
    return out


_ordered = np.ascontiguousarray  # a network's logits may lie column by column


def _check_half(coarse: tuple[int, ...], fine: tuple[int, ...]) -> None:
    """Every point of the fine lattice lies between coarse ones."""
    if any(n > 2 * c - 1 for c, n in zip(coarse[:3], fine[:3], strict=True)):
        raise ValueError(f"{fine} points at half the step do not lie in a lattice of {coarse}")


def _planes(first: int, last: int, count: int) -> tuple[int, int]:
    if not 0 <= first <= last <= count:
        raise ValueError(f"planes {first} to {last} of {count}")
    return first, last


def _check_indices(shape: Shape, flat: Flat) -> None:
    if len(flat) and not (flat.min() >= 0 and flat.max() < np.prod(shape)):
        raise ValueError(f"indices {flat.min()} to {flat.max()} of a lattice of shape {shape}")
