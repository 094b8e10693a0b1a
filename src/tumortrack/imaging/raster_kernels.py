"""Kernels: closed surfaces cut by rays along a grid's last axis. The arithmetic is that of
``raster.cover``, number by number; no fast math, so that no rounding differs."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def crossings(triangles, shape, first, k, sign):  # type: ignore[no-untyped-def]
    """Where rays along the last axis pass triangles (t, 3, 3), in cells.

    Called twice: with ``k`` empty it counts, ``first[i * shape[1] + j + 1]`` of the ray (i, j).
    Then, ``first`` being where each ray's crossings begin, it writes the first voxel behind each,
    ``k``, and +1 or -1, ``sign``, of faces that are entered and left; ``first`` moves on.
    """
    fill = len(k) > 0
    for t in range(len(triangles)):
        tri = triangles[t]
        ax, ay = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1]
        bx, by = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1]
        area = ax * by - ay * bx
        turned = np.int8(area < 0) - np.int8(area > 0)
        # As numpy's cross product: the same products, in the same order.
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


@numba.njit(cache=True, nogil=True)
def _span(tri, i):  # type: ignore[no-untyped-def]
    """Where a triangle begins and ends on the line ``i`` of its first axis."""
    low, high = np.inf, -np.inf
    for edge in range(3):
        a, b = edge, (edge + 1) % 3
        if tri[a, 0] > tri[b, 0]:  # the same direction, hence the same rounding, from both sides
            a, b = b, a
        if tri[a, 0] <= i and tri[b, 0] > i:
            at = tri[a, 1] + (i - tri[a, 0]) * (tri[b, 1] - tri[a, 1]) / (tri[b, 0] - tri[a, 0])
            low, high = min(low, at), max(high, at)
    return low, high


@numba.njit(cache=True, nogil=True)
def fill(first, k, sign, value, out):  # type: ignore[no-untyped-def]
    """``value`` into the voxels of ``out`` (i, j, k) whose winding number is not 0, or that number
    itself where ``value`` is 0; others stay as they are. The rest is from ``crossings``."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            ray = i * out.shape[1] + j
            begin, end = first[ray], first[ray + 1]
            _in_order(k, sign, begin, end)
            winding = 0
            for at in range(begin, end):
                winding += sign[at]
                stop = k[at + 1] if at + 1 < end else out.shape[2]
                if winding != 0:
                    out[i, j, k[at] : stop] = value if value != 0 else winding


@numba.njit(cache=True, nogil=True)
def _in_order(k, sign, begin, end):  # type: ignore[no-untyped-def]
    """Sort one ray's crossings, a handful, by ``k``."""
    for at in range(begin + 1, end):
        here, its = k[at], sign[at]
        before = at - 1
        while before >= begin and k[before] > here:
            k[before + 1], sign[before + 1] = k[before], sign[before]
            before -= 1
        k[before + 1], sign[before + 1] = here, its
