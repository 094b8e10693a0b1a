"""The compiled part of ``occupancy.lattice``."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(nogil=True, inline="always")
def _cell(at, size):  # type: ignore[no-untyped-def]
    """The cell that a place along one axis lies in, and how far along it."""
    at = min(max(at, np.float32(0)), np.float32(size - 1))
    low = min(int(at), size - 2)
    return low, at - np.float32(low)


@numba.njit(cache=True, nogil=True)
def between(values, place, out):  # type: ignore[no-untyped-def]
    """Values (a, b, c, n) at places (m, 3), in steps of the lattice, by trilinear weights; outside
    those of the nearest border. ``out``: (m, n), filled."""
    for m in range(len(place)):
        i, x = _cell(place[m, 0], values.shape[0])
        j, y = _cell(place[m, 1], values.shape[1])
        k, z = _cell(place[m, 2], values.shape[2])
        for n in range(values.shape[3]):
            near = (1 - z) * values[i, j, k, n] + z * values[i, j, k + 1, n]
            right = (1 - z) * values[i, j + 1, k, n] + z * values[i, j + 1, k + 1, n]
            near = (1 - y) * near + y * right
            far = (1 - z) * values[i + 1, j, k, n] + z * values[i + 1, j, k + 1, n]
            right = (1 - z) * values[i + 1, j + 1, k, n] + z * values[i + 1, j + 1, k + 1, n]
            far = (1 - y) * far + y * right
            out[m, n] = (1 - x) * near + x * far
