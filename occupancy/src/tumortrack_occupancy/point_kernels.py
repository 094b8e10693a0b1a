"""Kernels of encoders, compiled on a CPU: balls, maxima, strays."""

from __future__ import annotations

import numpy as np

from tumortrack.core.compiled import njit


@njit(nogil=True)
def balls(points, centres, radius_2, found):  # type: ignore[no-untyped-def]
    """The first points (B, 3, N) within the root of ``radius_2`` of every centre (B, 3, M), the
    first repeated where they are few, into ``found`` (B, M, k), int64; all others float32."""
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


@njit(nogil=True)
def greatest(values, infinity, out, chosen):  # type: ignore[no-untyped-def]
    """The greatest of every K numbers (M, K, C) or zero, NaN greater than all, into ``out`` (M, C);
    which of the K it is, the first one or -1 for zero, into ``chosen``. ``values`` and ``infinity``
    are bits of floating point numbers as integers."""
    n, k, channels = values.shape
    for m in range(n):
        best, which = out[m], chosen[m]
        for c in range(channels):
            best[c] = 0
            which[c] = -1
        for number in range(k):
            row = values[m, number]
            for c in range(channels):
                bare = row[c] & (infinity | (infinity - 1))  # without its sign
                value = bare if bare > infinity else row[c]
                better = value > best[c]
                best[c] = value if better else best[c]
                which[c] = number if better else which[c]


@njit(nogil=True)
def handed_back(gradient, chosen, out):  # type: ignore[no-untyped-def]
    """Every gradient (M, C) to the one of K that was chosen, zero to the others: ``out``
    (M, K, C) is filled."""
    n, k, channels = out.shape
    for m in range(n):
        for number in range(k):
            row = out[m, number]
            for c in range(channels):
                row[c] = gradient[m, c] if chosen[m, c] == number else 0


@njit(nogil=True)
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
