"""Exact scan conversion of triangle meshes into voxel grids."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int16, UInt8

from tumortrack.core.compiled import njit
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh

_MOST_CELLS = 2**28


def winding_numbers(
    mesh: Mesh, frame_from_index: Float[np.ndarray, "4 4"], shape: tuple[int, int, int]
) -> Int16[np.ndarray, "i j k"]:
    """The winding number at voxel centres (integer indices), by rays along the last axis: each
    triangle adds +1 or -1 to every voxel behind it. A closed mesh whose faces turn outward and that
    does not cross itself gives 0 outside and 1 inside. Raises InputError: the grid is too large."""
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
    triangles = (index - low)[mesh.faces]
    i, j, k = (high - low).tolist()
    first = np.zeros(i * j + 1, np.int64)
    _find_crossings(triangles, (i, j, k), first, np.zeros(0, np.int32), np.zeros(0, np.int8))
    first = np.cumsum(first)
    if first[-1] == 0:
        return
    behind, sign = np.empty(first[-1], np.int32), np.empty(first[-1], np.int8)
    _find_crossings(triangles, (i, j, k), first.copy(), behind, sign)
    if np.linalg.det(frame_from_index[:3, :3]) < 0:
        sign = -sign
    box = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    _fill_along_rays(first, behind, sign, value, out[box])


@njit(nogil=True)  # no fast math: rounded as in the reference, ``cover`` in tests/support
def _find_crossings(triangles, shape, first, k, sign):  # type: ignore[no-untyped-def]
    """Where rays along the last axis cross triangles (t, 3, 3), in cells: ``k``, the first voxel
    behind each crossing, and ``sign``, +1 where the ray enters, -1 where it leaves.

    Called twice. With ``k`` empty it counts the crossings of ray (i, j) in
    ``first[i * shape[1] + j + 1]``. With their cumulative sum in ``first`` it writes the crossings
    and advances ``first``.
    """
    fill = len(k) > 0
    for t in range(len(triangles)):
        tri = triangles[t]
        ax, ay = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1]
        bx, by = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1]
        area = ax * by - ay * bx
        turned = np.int8(area < 0) - np.int8(area > 0)
        # As NumPy's cross product: the same products in the same order
        az, bz = tri[1, 2] - tri[0, 2], tri[2, 2] - tri[0, 2]
        along = area if area != 0 else 1.0
        slope_i, slope_j = (ay * bz - az * by) / along, (az * bx - ax * bz) / along
        lowest = min(tri[0, 2], tri[1, 2], tri[2, 2])
        highest = max(tri[0, 2], tri[1, 2], tri[2, 2])
        start = max(math.ceil(min(tri[0, 0], tri[1, 0], tri[2, 0])), 0)
        stop = min(math.ceil(max(tri[0, 0], tri[1, 0], tri[2, 0])), shape[0])
        for i in range(start, stop):
            low, high = _span(tri, i)
            left = min(max(math.ceil(low), 0), shape[1])
            right = min(max(math.ceil(high), 0), shape[1])
            for j in range(left, right):
                depth = tri[0, 2] - slope_i * (i - tri[0, 0])
                depth -= slope_j * (j - tri[0, 1])
                depth = min(max(depth, lowest), highest)
                behind = max(math.ceil(depth), 0)
                if behind >= shape[2]:
                    continue
                ray = i * shape[1] + j
                if fill:
                    at = first[ray]
                    k[at], sign[at] = behind, turned
                    first[ray] = at + 1
                else:
                    first[ray + 1] += 1


@njit(nogil=True)
def _span(tri, i):  # type: ignore[no-untyped-def]
    """Where a triangle begins and ends on the line ``i`` of its first axis."""
    low, high = np.inf, -np.inf
    for edge in range(3):
        a, b = edge, (edge + 1) % 3
        if tri[a, 0] > tri[b, 0]:  # one direction, so that both triangles round alike
            a, b = b, a
        if tri[a, 0] <= i and tri[b, 0] > i:
            at = tri[a, 1] + (i - tri[a, 0]) * (tri[b, 1] - tri[a, 1]) / (tri[b, 0] - tri[a, 0])
            low, high = min(low, at), max(high, at)
    return low, high


@njit(nogil=True)
def _fill_along_rays(first, k, sign, value, out):  # type: ignore[no-untyped-def]
    """See ``_fill``; the crossings of each ray in ``k`` and ``sign`` begin at ``first``."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            ray = i * out.shape[1] + j
            begin, end = first[ray], first[ray + 1]
            _sort(k, sign, begin, end)
            winding = 0
            for at in range(begin, end):
                winding += sign[at]
                stop = k[at + 1] if at + 1 < end else out.shape[2]
                if winding != 0:
                    out[i, j, k[at] : stop] = value if value != 0 else winding


@njit(nogil=True)
def _sort(k, sign, begin, end):  # type: ignore[no-untyped-def]
    """Insertion sort of one ray's few crossings by ``k``."""
    for at in range(begin + 1, end):
        this_k, this_sign = k[at], sign[at]
        before = at - 1
        while before >= begin and k[before] > this_k:
            k[before + 1], sign[before + 1] = k[before], sign[before]
            before -= 1
        k[before + 1], sign[before + 1] = this_k, this_sign
