"""The kernel of the discrepancy: the most likely amplitude and noise."""

from __future__ import annotations

import math

import numpy as np

from tumortrack.core.compiled import njit


@njit(nogil=True)
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
