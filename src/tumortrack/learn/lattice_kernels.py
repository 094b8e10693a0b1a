"""The compiled part of ``learn.lattice``."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def between(values, place, out):  # type: ignore[no-untyped-def]
    """Values (a, b, c, n) at places (m, 3), in steps of the lattice, by trilinear weights; outside
    those of the nearest border. ``out``: (m, n), filled."""
    size = values.shape
    for m in range(len(place)):
        low = np.empty(3, np.int64)
        part = np.empty(3, np.float32)
        for axis in range(3):
            at = min(max(place[m, axis], np.float32(0)), np.float32(size[axis] - 1))
            low[axis] = min(int(at), size[axis] - 2)
            part[axis] = at - np.float32(low[axis])
        i, j, k = low
        for n in range(size[3]):
            total = np.float32(0)
            for a in range(2):
                x = part[0] if a else 1 - part[0]
                for b in range(2):
                    y = part[1] if b else 1 - part[1]
                    row = values[i + a, j + b, k, n] * (1 - part[2])
                    row += values[i + a, j + b, k + 1, n] * part[2]
                    total += x * y * row
            out[m, n] = total
