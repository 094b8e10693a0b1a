"""Kernels of the discrepancy: points in groups, and the most likely amplitude and noise."""

from __future__ import annotations

import math

import numpy as np

from tumortrack.core.compiled import numba


@numba.njit(cache=True, nogil=True)
def group(points, count):  # type: ignore[no-untyped-def]
    """The number of the nearest of ``count`` points (n, 3) that lie far apart: each is the farthest
    from those before it."""
    out, nearest = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    farthest = 0
    for number in range(count):
        middle, most = points[farthest], -1.0
        for p in range(len(points)):
            square = 0.0
            for axis in range(3):
                square += (points[p, axis] - middle[axis]) ** 2
            if square < nearest[p]:
                nearest[p], out[p] = square, number
            if nearest[p] > most:
                most, farthest = nearest[p], p
    return out


@numba.njit(cache=True, nogil=True)
def most_likely(explained, alike, per_noise, residuals, tried):  # type: ignore[no-untyped-def]
    """The pair of ``tried`` amplitudes and noises under which residuals (m,) are most likely, if
    they are normal, of covariance ``explained + amplitude^2 alike + noise^2 diag(per_noise)``."""
    amplitudes, noises = tried
    best, least = (amplitudes[0], noises[0]), np.inf
    for amplitude in amplitudes:
        for noise in noises:
            covariance = explained + amplitude**2 * alike
            for n in range(len(residuals)):
                covariance[n, n] += noise**2 * per_noise[n]
            root, unlikely = np.linalg.cholesky(covariance), 0.0
            white = np.empty(len(residuals))
            for n in range(len(residuals)):
                rest = residuals[n]
                for m in range(n):
                    rest -= root[n, m] * white[m]
                white[n] = rest / root[n, n]
                unlikely += 0.5 * white[n] ** 2 + math.log(root[n, n])
            if unlikely < least:
                best, least = (amplitude, noise), unlikely
    return best
