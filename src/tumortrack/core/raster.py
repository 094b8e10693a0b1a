"""Exact scan conversion of triangle meshes into voxel grids."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.native import F64, I32, I64, U8, Array, kernel

_MOST_CELLS = 2**28

_SIZE = int, int, int
# The voxels behind which rays along the last axis cross triangles, twice their number, odd where
# they enter: without room for them they are counted per ray, then written from ``first`` on
_find_crossings = kernel(
    "find_crossings", F64["t", 3, 3], _SIZE, I64["rays"].out, I32["crossings"].out
)
# Sets what the rays through a box of the grid (lower corner, size, and whether crossings enter, 1,
# or leave, -1) have in their crossings
_RAYS = _SIZE, _SIZE, int, I64["rays"], I32["crossings"].out
_fill_labels = kernel("fill_labels", _RAYS, int, U8["i", "j", "k"].out)
_fill_windings = kernel("fill_windings", _RAYS, Array(np.int16)["i", "j", "k"].out)


def winding_numbers(
    mesh: Mesh, frame_from_index: Float[np.ndarray, "4 4"], shape: tuple[int, int, int]
) -> Int16[np.ndarray, "i j k"]:
    """The winding number at voxel centres: of a closed mesh whose faces turn outward and that does
    not cross itself 0 outside and 1 inside. Raises InputError: the grid is too large."""
    out = _zeros(shape, np.int16)
    _fill(mesh, frame_from_index, out, 0)
    return out


def voxelise(
    mesh: Mesh, frame_from_index: Float[np.ndarray, "4 4"], shape: tuple[int, int, int]
) -> Bool[np.ndarray, "i j k"]:
    """Which voxel centres lie inside a closed mesh: where its winding number is not 0, so that a
    surface that overlaps itself makes no holes, as parity would."""
    inside = _zeros(shape, np.uint8)
    _fill(mesh, frame_from_index, inside, 1)
    return inside.view(bool)


def label_grid(
    anatomy: Anatomy, camera_from_index: Float[np.ndarray, "4 4"], shape: tuple[int, int, int]
) -> UInt8[np.ndarray, "i j k"]:
    """Labels of an anatomy on a grid: 1 organ, 2, 3, ... tumors; a tumor wins over the organ."""
    labels = _zeros(shape, np.uint8)
    for label, part in enumerate(anatomy.parts, start=1):
        _fill(part, camera_from_index, labels, label)
    return labels


def _zeros(shape: tuple[int, int, int], dtype: type) -> np.ndarray:
    if np.prod(np.array(shape, float)) > _MOST_CELLS:
        raise InputError(f"a grid of {' x '.join(map(str, shape))} voxels is too large.")
    return np.zeros(shape, dtype)


def _fill(mesh: Mesh, frame_from_index: np.ndarray, out: np.ndarray, value: int) -> None:
    """Set the voxels of ``out`` whose winding number is not 0 to ``value``, or to that number where
    ``value`` is 0."""
    if len(mesh.faces) == 0:
        return
    index = transform_points(np.linalg.inv(frame_from_index), mesh.vertices_mm)
    low = np.clip(np.floor(index.min(0)), 0, out.shape).astype(int)
    high = np.clip(np.ceil(index.max(0)) + 1, 0, out.shape).astype(int)
    if (high <= low).any():
        return
    high[2] = out.shape[2]  # rays need not leave an open mesh
    triangles = np.ascontiguousarray((index - low)[mesh.faces])
    size = i, j, _ = (high - low).tolist()
    first = np.zeros(i * j + 1, np.int64)
    _find_crossings(triangles, size, first, np.empty(0, np.int32))
    first = np.cumsum(first)
    if first[-1] == 0:
        return
    crossings = np.empty(first[-1], np.int32)
    _find_crossings(triangles, size, first.copy(), crossings)
    entering = -1 if np.linalg.det(frame_from_index[:3, :3]) < 0 else 1
    rays = low, size, entering, first, crossings
    if value:
        _fill_labels(rays, value, out)
    else:
        _fill_windings(rays, out)
