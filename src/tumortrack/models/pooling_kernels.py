"""The compiled parts of ``models.pooling``, for a CPU.

Floating point numbers of 16 (bf16) or 32 bits come as signed integers: those from zero up have the
same order, and many of them are compared at once.
"""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True)
def greatest(values, infinity, out, chosen):  # type: ignore[no-untyped-def]
    """The greatest of every K numbers or zero; what is no number counts as greater than all.

    Args:
        values: (M, K, C).
        infinity: as such an integer, of the same type.
        out: (M, C); filled.
        chosen: (M, C), as ``values``: the first of the K that is so great, -1 for zero; filled.
    """
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


@numba.njit(cache=True, nogil=True)
def handed_back(gradient, chosen, out):  # type: ignore[no-untyped-def]
    """Every gradient (M, C) to the one of K that was chosen, zero to the others: ``out``
    (M, K, C) is filled."""
    n, k, channels = out.shape
    for m in range(n):
        for number in range(k):
            row = out[m, number]
            for c in range(channels):
                row[c] = gradient[m, c] if chosen[m, c] == number else 0
