"""Kernel: the normal distribution, looked up."""

from __future__ import annotations

from functools import cache

import numba
import numpy as np
from jaxtyping import Float64

_MOST, _PER_STD = 8, 1024  # so wide a table, in such steps, is right to 1e-7


@cache
def normal_table() -> Float64[np.ndarray, " n"]:
    """The normal distribution's integral from 0 standard deviations on."""
    from scipy.special import ndtr

    return ndtr(np.arange(_MOST * _PER_STD + 2) / _PER_STD)


@numba.njit(cache=True, nogil=True)
def probabilities(margins, per_std, which, table):  # type: ignore[no-untyped-def]
    """That normal errors do not exceed margins (n,), 0 or more; ``per_std[which]`` of them make
    one standard deviation, ``table`` is ``normal_table()``. Float32 (n,)."""
    out = np.empty(len(margins), np.float32)
    for p in range(len(margins)):
        place = min(margins[p] * per_std[which[p]], np.float64(_MOST)) * _PER_STD
        n = int(place)
        out[p] = table[n] + (place - n) * (table[n + 1] - table[n])
    return out
