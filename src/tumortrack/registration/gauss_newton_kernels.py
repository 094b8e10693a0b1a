"""Kernels of the refinement: Gauss-Newton steps without a word to Python in between.

A step needs less than half a millisecond, of which calls from Python would take as much again,
and two starts that go down at once would wait for each other's. See ``refine`` for what is
minimised.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from tumortrack.registration.residual_kernels import POSE, add_rows
from tumortrack.simulate.elastic.flow import BLOCK, block, combine, steps_of

_AT_ONCE = 256  # points whose rows stay in the cache; also so many are summed in single precision
_APART = 16  # numbers between rows of sums: rows a power of two apart share a cache's lines


@numba.njit(cache=True, fastmath=True, nogil=True)
def descend(organ, points, rules, state, left, first, last):  # type: ignore[no-untyped-def]
    """Steps ``first`` to ``last`` of a refinement, fewer if it settles.

    Args:
        organ: (modes, origin, spacing, center_ct, field, precision, mean); ``field`` is (values,
            origin, spacing) of the distances, ``precision`` (p, p) and ``mean`` (m,) the prior's.
        points: observed, (n, 3), camera frame, mm, float32.
        rules: (weight, first_mm, last_mm, narrowing, enough_mm) as numbers.
        state: rotation (3, 3), centre (3,), coefficients (m,), and how far the pose is from the
            start's, shift and turn (6,); float64, changed in place.
        left: distances (n,), curvature (p, p) and gradient (p,) of the last state; where ``first``
            is not 0, what ran up to there has left them.

    Returns:
        The number of steps gone, whether it has settled, and the last state's cost.
    """
    rotation, centre, coefficients, moved = state
    _, curvature, gradient = left
    unknowns, last_mm, enough_mm = len(gradient), rules[2], rules[4]
    rows = np.empty((BLOCK, unknowns + 1), np.float32)
    across = np.zeros((-(-(unknowns + 1) // 4) * 4, _AT_ONCE + _APART), np.float32)
    room, cost = (rows, across), 0.0
    if first == 0:
        cost = _equations(organ, points, rules, state, _width(rules, 0), room, left)
    for step in range(first, last):
        change = np.linalg.solve(curvature, gradient)
        _turn(rotation, centre, change)
        for n in range(POSE):
            moved[n] -= change[n]
        for n in range(len(coefficients)):
            coefficients[n] -= change[POSE + n]
        cost = _equations(organ, points, rules, state, _width(rules, step + 1), room, left)
        if np.abs(change).max() < enough_mm and _width(rules, step) == last_mm:
            return step + 1, True, cost
    return last, False, cost


@numba.njit(cache=True, nogil=True)
def _width(rules, step):  # type: ignore[no-untyped-def]
    """The distance (mm) where a point's pull is greatest, after so many steps."""
    _, first_mm, last_mm, narrowing, _ = rules
    return max(last_mm, first_mm * narrowing**step)


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def _equations(organ, points, rules, state, width, room, left):  # type: ignore[no-untyped-def]
    """Distances, curvature and gradient of the cost at a state into ``left``; the cost."""
    modes, origin, spacing, center, field, precision, mean = organ
    rotation, centre, coefficients, moved = state
    distances, curvature, gradient = left
    weight, last_mm = rules[0], rules[2]
    velocity = combine(modes, (-coefficients).astype(np.float32))
    lattice = velocity, origin, spacing
    pose = center, rotation, centre
    normal_equations(
        lattice,
        steps_of(velocity, spacing),
        modes,
        pose,
        field,
        np.float32(width),
        points,
        room,
        left,
    )
    unknowns, cost = len(gradient), 0.0
    for p in range(len(distances)):
        square = (np.float64(distances[p]) / last_mm) ** 2
        cost += square / (1.0 + square)
    cost *= weight * last_mm**2
    off = np.empty(unknowns)
    off[:POSE] = moved
    off[POSE:] = coefficients - mean
    for n in range(unknowns):
        pull = 0.0
        for m in range(unknowns):
            pull += precision[n, m] * off[m]
            curvature[n, m] = weight * curvature[n, m] + precision[n, m]
        gradient[n] = weight * gradient[n] + pull
        cost += off[n] * pull
    return cost


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def normal_equations(  # type: ignore[no-untyped-def]
    lattice, steps, modes, pose, field, width, points, room, out
):
    """Distances as ``kernels.add_rows`` gives them (n,), and the sums over points of ``pull * row
    * row'`` (p, p) and of ``pull * row * distance`` (p,), float64: ``out``; ``pull`` is
    1 / (1 + (distance / width)^2)^2. ``room`` is overwritten."""
    rows, across = room
    distances, square, mixed = out
    unknowns = len(mixed)
    sums = np.zeros((len(across), len(across) + 4))
    places, speeds, middles = block()
    one, per_width = np.float32(1), np.float32(1) / width
    for start in range(0, len(points), _AT_ONCE):
        count = min(_AT_ONCE, len(points) - start)
        for first in range(start, start + count, BLOCK):
            some = points[first : min(first + BLOCK, start + count)]
            add_rows(lattice, steps, modes, pose, field, some, (places, speeds, middles), rows)
            for p in range(len(some)):
                distance = rows[p, unknowns]
                distances[first + p] = distance
                share = one / (one + (distance * per_width) ** 2)
                for n in range(unknowns + 1):
                    across[n, first - start + p] = rows[p, n] * share
        _add_products(across, count, sums)
    for n in range(unknowns):
        for m in range(n + 1):
            square[n, m] = sums[n, m]
            square[m, n] = sums[n, m]
        mixed[n] = sums[unknowns, n]


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def _add_products(across, count, sums):  # type: ignore[no-untyped-def]
    """Add the products of all pairs of rows (over ``count`` columns) to the lower triangle of
    ``sums``: eight at a time, so that a number read is used more than once."""
    zero = np.float32(0)
    for n in range(0, len(across), 2):
        a, b = across[n], across[n + 1]
        for m in range(0, n + 2, 4):
            c, d, e, f = across[m], across[m + 1], across[m + 2], across[m + 3]
            ac, ad, ae, af, bc, bd, be, bf = zero, zero, zero, zero, zero, zero, zero, zero
            for p in range(count):
                ac += a[p] * c[p]
                ad += a[p] * d[p]
                ae += a[p] * e[p]
                af += a[p] * f[p]
                bc += b[p] * c[p]
                bd += b[p] * d[p]
                be += b[p] * e[p]
                bf += b[p] * f[p]
            upper, lower = sums[n], sums[n + 1]
            upper[m] += ac
            upper[m + 1] += ad
            upper[m + 2] += ae
            upper[m + 3] += af
            lower[m] += bc
            lower[m + 1] += bd
            lower[m + 2] += be
            lower[m + 3] += bf


@numba.njit(cache=True, nogil=True)
def _turn(rotation, centre, change):  # type: ignore[no-untyped-def]
    """Move a pose by ``-change`` in the organ's axes: rotation times the rotation vector's matrix
    (Rodrigues), centre along the axes of before."""
    before, axis = rotation.copy(), -change[3:POSE]
    for n in range(3):
        for m in range(3):
            centre[n] -= before[n, m] * change[m]
    angle = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    sine = math.sin(angle) / angle if angle > 0 else 1.0
    flat = (1 - math.cos(angle)) / angle**2 if angle > 1e-8 else 0.5
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    for n in range(3):
        for m in range(3):
            total = before[n, m]
            for k in range(3):
                twice = 0.0
                for j in range(3):
                    twice += cross[k, j] * cross[j, m]
                total += before[n, k] * (sine * cross[k, m] + flat * twice)
            rotation[n, m] = total
