"""The compiled parts of ``models.sampling``, for a CPU."""

from __future__ import annotations

import numba
import numpy as np

_MAXIMUM = {"nnan", "nsz"}  # lets a maximum be taken in lanes; sums stay as they are written


@numba.njit(cache=True, nogil=True, fastmath=_MAXIMUM)
def farthest(points, first, chosen):  # type: ignore[no-untyped-def]
    """Farthest points of every cloud.

    Args:
        points: (B, 3, N), float32.
        first: (B,), the first choice.
        chosen: (B, k), int64; filled.
    """
    n_clouds, _, n = points.shape
    nearest = np.empty(n, np.float32)
    for cloud in range(n_clouds):
        x, y, z = points[cloud, 0], points[cloud, 1], points[cloud, 2]
        nearest[:] = np.inf
        newest = first[cloud]
        for step in range(chosen.shape[1]):
            chosen[cloud, step] = newest
            cx, cy, cz = x[newest], y[newest], z[newest]
            for i in range(n):
                dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
                nearest[i] = min(nearest[i], dx * dx + dy * dy + dz * dz)
            most = np.float32(-1.0)
            for i in range(n):
                most = max(most, nearest[i])
            newest = 0
            while newest < n - 1 and nearest[newest] != most:
                newest += 1


@numba.njit(cache=True, nogil=True)
def balls(points, centres, radius_2, found):  # type: ignore[no-untyped-def]
    """The first points within a radius of every centre, the first repeated where they are few.

    Args:
        points: (B, 3, N), float32.
        centres: (B, 3, M), float32.
        radius_2: squared.
        found: (B, M, k), int64; filled.
    """
    n_clouds, _, n = points.shape
    k = found.shape[2]
    square = np.empty(n, np.float32)
    for cloud in range(n_clouds):
        x, y, z = points[cloud, 0], points[cloud, 1], points[cloud, 2]
        for m in range(centres.shape[2]):
            cx, cy, cz = centres[cloud, 0, m], centres[cloud, 1, m], centres[cloud, 2, m]
            for i in range(n):
                dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
                square[i] = dx * dx + dy * dy + dz * dz
            row = found[cloud, m]
            count = 0
            for i in range(n):
                if square[i] <= radius_2:
                    row[count] = i
                    count += 1
                    if count == k:
                        break
            rest = row[0] if count else 0
            for i in range(count, k):
                row[i] = rest
