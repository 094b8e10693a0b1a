"""Kernel: clouds without their strays."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def near(points, reach, out):  # type: ignore[no-untyped-def]
    """``network.without_strays`` of clouds (B, N, 3) into ``out``; all float32."""
    n = points.shape[1]
    which = np.empty(n, np.int64)
    for b in range(len(points)):
        middle = np.empty(3, np.float32)
        for axis in range(3):
            middle[axis] = np.partition(points[b, :, axis].copy(), (n - 1) // 2)[(n - 1) // 2]
        for _ in range(2):
            count = 0
            for p in range(n):
                x, y = points[b, p, 0] - middle[0], points[b, p, 1] - middle[1]
                z = points[b, p, 2] - middle[2]
                if not x * x + y * y + z * z > reach * reach:
                    which[count] = p
                    count += 1
            if count == 0:  # all are strays: the first stands for them
                which[0], count = 0, 1
            total = np.zeros(3)
            for p in range(n):
                for axis in range(3):
                    out[b, p, axis] = points[b, which[p % count], axis]
                    total[axis] += out[b, p, axis]
            for axis in range(3):
                middle[axis] = total[axis] / n
