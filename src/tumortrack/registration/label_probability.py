"""Kernels of probabilities: the normal distribution, and the nearest of known places, looked up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numba
import numpy as np
from jaxtyping import Float, Float32, Float64, Int32

_NODES_MM = 2.0  # apart
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


@dataclass(frozen=True, eq=False)
class NearestLookup:
    """Which of some places is nearest, for every place in a box: that of the nearest node of a
    lattice, which may be another one where two are about as near."""

    origin_mm: Float32[np.ndarray, " 3"]
    nearest: Int32[np.ndarray, "i j k"]

    @classmethod
    def of(cls, places_mm: Float[np.ndarray, "k 3"]) -> NearestLookup:
        """Over the places' box and a node beyond; what is farther out counts as on its border."""
        from scipy.spatial import cKDTree

        lower, upper = places_mm.min(0) - _NODES_MM, places_mm.max(0) + _NODES_MM
        shape = tuple(np.ceil((upper - lower) / _NODES_MM).astype(int) + 1)
        nodes = lower + _NODES_MM * np.indices(shape).reshape(3, -1).T
        which = cKDTree(places_mm).query(nodes)[1].astype(np.int32)
        return cls(lower.astype(np.float32), which.reshape(shape))

    def to(self, points_mm: Float32[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
        """The place's number for every point."""
        return _look_up(self.nearest, self.origin_mm, np.float32(_NODES_MM), points_mm)


@numba.njit(cache=True, nogil=True)
def _look_up(nearest, origin, step, points):  # type: ignore[no-untyped-def]
    out, zero, half = np.empty(len(points), np.int32), np.float32(0), np.float32(0.5)
    x_last, y_last, z_last = nearest.shape[0] - 1, nearest.shape[1] - 1, nearest.shape[2] - 1
    for p in range(len(points)):
        i = int(max((points[p, 0] - origin[0]) / step + half, zero))
        j = int(max((points[p, 1] - origin[1]) / step + half, zero))
        k = int(max((points[p, 2] - origin[2]) / step + half, zero))
        out[p] = nearest[min(i, x_last), min(j, y_last), min(k, z_last)]
    return out
