"""Kernels that sample and integrate a velocity field on a lattice.

The deformation is the exponential of a stationary velocity field (Arsigny et al. 2006, doi
10.1007/11866565_113): points follow the field for one unit of time. It is one-to-one, its inverse
follows the opposite field, and a field without divergence preserves volume even for large motions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from tumortrack.core.compiled import njit

_PER_SLOPE = 10  # steps over the steepest slope: the inverse then leads back within 0.01 mm
_FEWEST, _MOST = 3, 24  # steps
BLOCK = 64  # points that take each step together; a single one stalls on its previous step


class LatticeField(NamedTuple):
    """Values at the nodes ``origin_mm + spacing_mm * (i, j, k)``, all float32: a velocity
    (i, j, k, 3) in mm per unit of time, or modes (i, j, k, 3, m)."""

    values: Float32[np.ndarray, "i j k ..."]
    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: np.float32


def steps_for(velocity: Float32[np.ndarray, "i j k 3"], spacing_mm: float) -> int:
    """Integration steps that a field needs: the more, the steeper it is."""
    return int(steps_of(velocity, np.float32(spacing_mm)))


# Fast math: see simulate.deform.drag; sums here are too short to add more error.
@njit(fastmath=True, nogil=True)
def _steepest(velocity):  # type: ignore[no-untyped-def]
    """Largest difference between neighbouring nodes of a field (i, j, k, 3)."""
    most = np.float32(0)
    nodes = velocity.reshape(velocity.shape[0], velocity.shape[1], -1)
    for i in range(len(nodes)):
        for j in range(nodes.shape[1]):
            here = nodes[i, j]
            most = max(most, _largest_difference(here[3:], here[:-3]))
            if i > 0:
                most = max(most, _largest_difference(here, nodes[i - 1, j]))
            if j > 0:
                most = max(most, _largest_difference(here, nodes[i, j - 1]))
    return most


@njit(fastmath=True, nogil=True)
def _largest_difference(a, b):  # type: ignore[no-untyped-def]
    most = np.float32(0)
    for n in range(len(a)):
        difference = abs(a[n] - b[n])
        most = difference if difference > most else most
    return most


@njit(nogil=True)
def steps_of(velocity, spacing):  # type: ignore[no-untyped-def]
    """``steps_for``, for kernels."""
    slope = np.float64(_steepest(velocity)) / np.float64(spacing)
    return min(max(math.ceil(_PER_SLOPE * slope), _FEWEST), _MOST)


@njit(fastmath=True, nogil=True)
def combine(modes, coefficients):  # type: ignore[no-untyped-def]
    """``modes @ coefficients``, (..., m) by (m,), float32. BLAS would wake threads that then
    busy-wait and slow down those that move points."""
    rows = modes.reshape(-1, len(coefficients))
    out = np.empty(len(rows), np.float32)
    for n in range(len(rows)):
        total, row = np.float32(0), rows[n]
        for mode in range(len(row)):
            total += row[mode] * coefficients[mode]
        out[n] = total
    return out.reshape(modes.shape[:-1])


@njit(fastmath=True, nogil=True, error_model="numpy")
def advance(velocity, places, speeds, count, half, move):  # type: ignore[no-untyped-def]
    """One step of ``count`` points: ``places`` and ``speeds`` (3, BLOCK), in cells and mm per unit
    of time. A place moves by ``move`` times the speed at ``places + half * speeds``.

    Trilinear; places beyond the lattice are clamped to its border.
    """
    flat = velocity.reshape(-1)
    zero, one, most = np.float32(0), np.float32(1), np.float32(1.001)
    most_x = np.float32(velocity.shape[0]) - most
    most_y = np.float32(velocity.shape[1]) - most
    most_z = np.float32(velocity.shape[2]) - most
    # Unsigned indices spare the check for negative ones, which count from the end.
    row = np.uint32(3 * velocity.shape[2])
    plane = np.uint32(velocity.shape[1] * row)
    for p in range(count):
        x = min(max(places[0, p] + half * speeds[0, p], zero), most_x)
        y = min(max(places[1, p] + half * speeds[1, p], zero), most_y)
        z = min(max(places[2, p] + half * speeds[2, p], zero), most_z)
        i, j, k = np.uint32(x), np.uint32(y), np.uint32(z)
        a, b, c = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        a0, b0, c0 = one - a, one - b, one - c
        w00, w01, w10, w11 = a0 * b0, a0 * b, a * b0, a * b
        n00 = np.uint32(i * plane + j * row + np.uint32(3) * k)
        n01, n10 = np.uint32(n00 + row), np.uint32(n00 + plane)
        n11 = np.uint32(n01 + plane)
        for axis in range(3):
            d, e = np.uint32(axis), np.uint32(axis + 3)
            near = w00 * flat[n00 + d] + w01 * flat[n01 + d]
            near += w10 * flat[n10 + d] + w11 * flat[n11 + d]
            far = w00 * flat[n00 + e] + w01 * flat[n01 + e]
            far += w10 * flat[n10 + e] + w11 * flat[n11 + e]
            speed = c0 * near + c * far
            speeds[axis, p] = speed
            places[axis, p] += move * speed


@njit(fastmath=True, nogil=True)
def block():  # type: ignore[no-untyped-def]
    """Buffers for the places, speeds and midway places of one block of points."""
    buffers = np.empty((3, 3, BLOCK), np.float32)
    return buffers[0], buffers[1], buffers[2]


@njit(fastmath=True, nogil=True)
def enter(points, origin, spacing, places):  # type: ignore[no-untyped-def]
    """Write up to ``BLOCK`` points (n, 3), mm, as places in cells."""
    per_cell = np.float32(1) / spacing
    for p in range(len(points)):
        for axis in range(3):
            places[axis, p] = (points[p, axis] - origin[axis]) * per_cell


@njit(fastmath=True, nogil=True)
def travel(velocity, spacing, steps, count, places, speeds, middles):  # type: ignore[no-untyped-def]
    """Move ``count`` places of a block for one unit of time; ``middles`` are those at half time.

    Midpoint rule, with the middle of a step predicted from the last step's velocity: second order
    with one sample a step, and nearly symmetric, so that the opposite field leads back to within
    a few micrometres.
    """
    zero = np.float32(0)
    dt = np.float32(1) / (spacing * np.float32(steps))
    half = np.float32(0.5) * dt
    speeds[:, :count] = zero
    advance(velocity, places, speeds, count, half, zero)
    for step in range(steps):
        if step == steps // 2:  # half of the time has passed, or will in the middle of this step
            past = half if steps % 2 else zero
            for axis in range(3):
                for p in range(count):
                    middles[axis, p] = places[axis, p] + past * speeds[axis, p]
        advance(velocity, places, speeds, count, half, dt)


@njit(fastmath=True, nogil=True)
def follow(field, points, steps):  # type: ignore[no-untyped-def]
    """Points (n, 3), mm, float32, after one unit of time in a velocity field; see ``travel``."""
    velocity, origin, spacing = field.values, field.origin_mm, field.spacing_mm
    out = np.empty_like(points)
    places, speeds, middles = block()
    for first in range(0, len(points), BLOCK):
        part = points[first : first + BLOCK]
        enter(part, origin, spacing, places)
        travel(velocity, spacing, steps, len(part), places, speeds, middles)
        for p in range(len(part)):
            for axis in range(3):
                out[first + p, axis] = origin[axis] + spacing * places[axis, p]
    return out


@njit(fastmath=True, nogil=True)
def project(field, points, directions):  # type: ignore[no-untyped-def]
    """Trilinear values (n, m) of modes at points (n, 3), mm, each along a direction (n, 3); all
    float32. Points beyond the lattice are clamped to its border."""
    modes, origin, spacing = field.values, field.origin_mm, field.spacing_mm
    n, m = len(points), modes.shape[4]
    out = np.zeros((n, m), np.float32)
    per_cell = np.float32(1) / spacing
    for p in range(n):
        x = (points[p, 0] - origin[0]) * per_cell
        y = (points[p, 1] - origin[1]) * per_cell
        z = (points[p, 2] - origin[2]) * per_cell
        add_modes(modes, x, y, z, directions[p], out[p])
    return out


@njit(fastmath=True, nogil=True, inline="always")
def add_modes(modes, x, y, z, direction, out):  # type: ignore[no-untyped-def]
    """Add the modes at a place in cells, along a direction (3,), to ``out`` (m,)."""
    zero, one, most = np.float32(0), np.float32(1), np.float32(1.001)
    x = min(max(x, zero), np.float32(modes.shape[0]) - most)
    y = min(max(y, zero), np.float32(modes.shape[1]) - most)
    z = min(max(z, zero), np.float32(modes.shape[2]) - most)
    i, j, k = int(x), int(y), int(z)
    a, b, c = x - np.float32(i), y - np.float32(j), z - np.float32(k)
    for column in range(4):
        u, v = column >> 1, column & 1
        share = (a if u else one - a) * (b if v else one - b)
        near, far = modes[i + u, j + v, k], modes[i + u, j + v, k + 1]
        s0, s1, s2 = share * direction[0], share * direction[1], share * direction[2]
        n0, n1, n2 = (one - c) * s0, (one - c) * s1, (one - c) * s2
        f0, f1, f2 = c * s0, c * s1, c * s2
        for mode in range(len(out)):
            out[mode] += (
                n0 * near[0, mode] + n1 * near[1, mode] + n2 * near[2, mode]
                + f0 * far[0, mode] + f1 * far[1, mode] + f2 * far[2, mode]
            )  # fmt: skip
