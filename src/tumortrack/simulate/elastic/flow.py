"""Kernels: a velocity on a lattice, sampled and followed.

The deformation is the exponential of a stationary velocity field (Arsigny et al. 2006, doi
10.1007/11866565_113): points follow the field for one unit of time. It is one-to-one, its inverse
follows the opposite field, and a field without divergence keeps volumes, however far points go.
"""

from __future__ import annotations

import numba
import numpy as np
from jaxtyping import Float32

_PER_SLOPE = 10  # steps, times the field's steepest slope: back within 0.01 mm of the start
_FEWEST, _MOST = 3, 24


def steps_for(velocity: Float32[np.ndarray, "i j k 3"], spacing_mm: float) -> int:
    """Steps that a field needs: as many as points beside each other part from each other."""
    slope = max(float(np.abs(np.diff(velocity, axis=a)).max()) for a in range(3)) / spacing_mm
    return int(np.clip(np.ceil(_PER_SLOPE * slope), _FEWEST, _MOST))


# Fast math: see simulate.deform.drag; here no sum is long enough to matter more.
@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def sample(field, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value of a float32 field (i, j, k, 3) at a place in cells; beyond the lattice that
    of its nearest border."""
    zero, most = np.float32(0), np.float32(1.001)
    x = min(max(x, zero), np.float32(field.shape[0]) - most)
    y = min(max(y, zero), np.float32(field.shape[1]) - most)
    z = min(max(z, zero), np.float32(field.shape[2]) - most)
    i, j, k = int(x), int(y), int(z)
    a, b, c = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    one = np.float32(1)
    a0, b0, c0 = one - a, one - b, one - c
    w00, w01, w10, w11 = a0 * b0, a0 * b, a * b0, a * b
    w000, w001, w010, w011 = w00 * c0, w00 * c, w01 * c0, w01 * c
    w100, w101, w110, w111 = w10 * c0, w10 * c, w11 * c0, w11 * c
    f00, f01 = field[i, j], field[i, j + 1]
    f10, f11 = field[i + 1, j], field[i + 1, j + 1]
    u = (
        w000 * f00[k, 0] + w001 * f00[k + 1, 0] + w010 * f01[k, 0] + w011 * f01[k + 1, 0]
        + w100 * f10[k, 0] + w101 * f10[k + 1, 0] + w110 * f11[k, 0] + w111 * f11[k + 1, 0]
    )  # fmt: skip
    v = (
        w000 * f00[k, 1] + w001 * f00[k + 1, 1] + w010 * f01[k, 1] + w011 * f01[k + 1, 1]
        + w100 * f10[k, 1] + w101 * f10[k + 1, 1] + w110 * f11[k, 1] + w111 * f11[k + 1, 1]
    )  # fmt: skip
    w = (
        w000 * f00[k, 2] + w001 * f00[k + 1, 2] + w010 * f01[k, 2] + w011 * f01[k + 1, 2]
        + w100 * f10[k, 2] + w101 * f10[k + 1, 2] + w110 * f11[k, 2] + w111 * f11[k + 1, 2]
    )  # fmt: skip
    return u, v, w


@numba.njit(cache=True, fastmath=True, nogil=True)
def follow(velocity, origin, spacing, points, steps):  # type: ignore[no-untyped-def]
    """Where points (n, 3) are after one unit of time, all float32.

    ``velocity`` (i, j, k, 3) is in mm, ``origin`` (3,) and ``spacing`` in mm. Midpoint rule, with
    the middle of a step predicted from the last step's velocity: of second order for one sample a
    step, and nearly symmetric, so that the opposite field leads back to within some micrometres.
    """
    out = np.empty_like(points)
    per_cell = np.float32(1) / spacing
    dt = per_cell / np.float32(steps)  # positions are in cells from here on
    half = np.float32(0.5) * dt
    for p in range(len(points)):
        x = (points[p, 0] - origin[0]) * per_cell
        y = (points[p, 1] - origin[1]) * per_cell
        z = (points[p, 2] - origin[2]) * per_cell
        u, v, w = sample(velocity, x, y, z)
        for _ in range(steps):
            u, v, w = sample(velocity, x + half * u, y + half * v, z + half * w)
            x += dt * u
            y += dt * v
            z += dt * w
        out[p, 0] = origin[0] + spacing * x
        out[p, 1] = origin[1] + spacing * y
        out[p, 2] = origin[2] + spacing * z
    return out


@numba.njit(cache=True, fastmath=True, nogil=True)
def project(modes, origin, spacing, points, directions):  # type: ignore[no-untyped-def]
    """Trilinear values of modes (i, j, k, 3, m) at points (n, 3), each along a direction (n, 3);
    all float32. Beyond the lattice those of its nearest border."""
    n, m = len(points), modes.shape[4]
    out = np.zeros((n, m), np.float32)
    zero, one, most = np.float32(0), np.float32(1), np.float32(1.001)
    per_cell = one / spacing
    for p in range(n):
        x = min(max((points[p, 0] - origin[0]) * per_cell, zero), modes.shape[0] - most)
        y = min(max((points[p, 1] - origin[1]) * per_cell, zero), modes.shape[1] - most)
        z = min(max((points[p, 2] - origin[2]) * per_cell, zero), modes.shape[2] - most)
        i, j, k = int(x), int(y), int(z)
        a, b, c = np.float32(x - i), np.float32(y - j), np.float32(z - k)
        d0, d1, d2 = directions[p, 0], directions[p, 1], directions[p, 2]
        for corner in range(8):
            u, v, w = corner >> 2, (corner >> 1) & 1, corner & 1
            share = (a if u else one - a) * (b if v else one - b) * (c if w else one - c)
            here = modes[i + u, j + v, k + w]
            s0, s1, s2 = share * d0, share * d1, share * d2
            for mode in range(m):
                out[p, mode] += s0 * here[0, mode] + s1 * here[1, mode] + s2 * here[2, mode]
    return out
