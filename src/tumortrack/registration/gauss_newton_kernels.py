"""Kernels of the refinement: all Gauss-Newton iterations in one compiled call.

A step takes less than half a millisecond; calling Python in between would take as long again, and
two hypotheses refined on two cores would wait for each other's. See ``gauss_newton`` for what is
minimised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tumortrack.core.compiled import njit
from tumortrack.registration.kernels import POSE, DistanceField, Flow, Pose, add_rows
from tumortrack.simulate.elastic.flow import BLOCK, LatticeField, block, combine, steps_of

_AT_ONCE = 256  # points whose rows stay in the cache; also so many are summed in single precision
_APART = 16  # numbers between rows of sums: rows a power of two apart share a cache's lines


@njit(fastmath=True, nogil=True, inline="always")
def rho(r):  # type: ignore[no-untyped-def]
    """The robust kernel, r^2 / (1 + r^2), of a distance in widths (Geman and McClure 1987)."""
    square = r**2
    return square / (1.0 + square)


@njit(fastmath=True, nogil=True, inline="always")
def root_weight(r):  # type: ignore[no-untyped-def]
    """The root of rho'(r) / (2 r), which is 1 / (1 + r^2): a residual and its derivatives are each
    multiplied by it in a Gauss-Newton step."""
    one = np.float32(1)
    return one / (one + r**2)


class Problem(NamedTuple):
    """The organ at rest and the prior of its motion (CT frame, mm), the observed points (camera
    frame, mm), and of ``GaussNewtonConfig``; ``weight`` of one point's squared distance."""

    modes: LatticeField
    center_ct: np.ndarray  # (3,), float64
    distances: DistanceField
    precision: np.ndarray  # (p, p), float64
    mean: np.ndarray  # (m,), float64
    points: np.ndarray  # (n, 3), float32
    weight: float
    first_mm: float
    last_mm: float
    narrowing: float
    enough_mm: float


class State(NamedTuple):
    """What is refined, and what its last step has left; float64, changed in place."""

    rotation: np.ndarray  # (3, 3)
    centre_mm: np.ndarray  # (3,)
    coefficients: np.ndarray  # (m,)
    moved: np.ndarray  # (6,): shift and turn since the start
    distances_mm: np.ndarray  # (n,), float32
    curvature: np.ndarray  # (p, p)
    gradient: np.ndarray  # (p,)


@njit(fastmath=True, nogil=True)
def descend(problem, state, first, last):  # type: ignore[no-untyped-def]
    """Steps ``first`` to ``last`` of a refinement, fewer if it converges: their number, whether it
    has converged, and the last cost. Where ``first`` is not 0, ``state`` is what is left by the
    steps before."""
    unknowns, cost = len(state.gradient), 0.0
    rows = np.empty((BLOCK, unknowns + 1), np.float32)
    columns = np.zeros((-(-(unknowns + 1) // 4) * 4, _AT_ONCE + _APART), np.float32)
    change = np.zeros(unknowns)
    # Before step 0 there are equations, no step. (One place of theirs compiles in half the time.)
    for step in range(first if first > 0 else -1, last):
        if step >= 0:
            change[:] = np.linalg.solve(state.curvature, state.gradient)
            turn(state.rotation, state.centre_mm, change)
            state.moved[:] -= change[:POSE]
            state.coefficients[:] -= change[POSE:]
        cost = _equations(problem, state, _width(problem, step + 1), (rows, columns))
        small = step >= 0 and np.abs(change).max() < problem.enough_mm
        if small and _width(problem, step) == problem.last_mm:
            return step + 1, True, cost
    return last, False, cost


@njit(nogil=True)
def _width(problem, step):  # type: ignore[no-untyped-def]
    """The robust kernel's width (mm) after so many steps; a point pulls most at 0.58 of it."""
    return max(problem.last_mm, problem.first_mm * problem.narrowing**step)


@njit(fastmath=True, nogil=True, inline="always")
def _equations(problem, state, width, buffers):  # type: ignore[no-untyped-def]
    """Distances, curvature and gradient of the cost at a state into it; the cost."""
    weight, last_mm, precision = problem.weight, problem.last_mm, problem.precision
    modes, origin, spacing = problem.modes
    curvature, gradient = state.curvature, state.gradient
    velocity = combine(modes, (-state.coefficients).astype(np.float32))
    flow = Flow(velocity, origin, spacing, steps_of(velocity, spacing))
    pose = Pose(problem.center_ct, state.rotation, state.centre_mm)
    normal_equations(problem, flow, pose, np.float32(width), buffers, state)
    unknowns, distances, cost = len(gradient), state.distances_mm, 0.0
    for p in range(len(distances)):
        cost += rho(np.float64(distances[p]) / last_mm)
    cost *= weight * last_mm**2
    change = np.empty(unknowns)  # from the prior's mean
    change[:POSE] = state.moved
    change[POSE:] = state.coefficients - problem.mean
    for n in range(unknowns):
        slope = 0.0  # of the prior, halved
        for m in range(unknowns):
            slope += precision[n, m] * change[m]
            curvature[n, m] = weight * curvature[n, m] + precision[n, m]
        gradient[n] = weight * gradient[n] + slope
        cost += change[n] * slope
    return cost


@njit(fastmath=True, nogil=True, inline="always")
def normal_equations(problem, flow, pose, width, buffers, state):  # type: ignore[no-untyped-def]
    """Distances as ``add_rows`` gives them, and the sums over points of ``weight * row * row'`` and
    ``weight * row * distance``, into ``state``; ``weight`` is ``root_weight`` squared. ``flow`` has
    the opposite velocity."""
    (rows, columns), points = buffers, problem.points
    modes, field = problem.modes.values, problem.distances
    distances, curvature, gradient = state.distances_mm, state.curvature, state.gradient
    unknowns = len(gradient)
    sums = np.zeros((len(columns), len(columns) + 4))
    along, per_width = block(), np.float32(1) / width
    for start in range(0, len(points), _AT_ONCE):
        count = min(_AT_ONCE, len(points) - start)
        for first in range(start, start + count, BLOCK):
            some = points[first : min(first + BLOCK, start + count)]
            add_rows(modes, field, flow, pose, some, along, rows)
            for p in range(len(some)):
                distance = rows[p, unknowns]
                distances[first + p] = distance
                weight = root_weight(distance * per_width)
                for n in range(unknowns + 1):
                    columns[n, first - start + p] = rows[p, n] * weight
        _add_products(columns, count, sums)
    for n in range(unknowns):
        for m in range(n + 1):
            curvature[n, m] = sums[n, m]
            curvature[m, n] = sums[n, m]
        gradient[n] = sums[unknowns, n]


@njit(fastmath=True, nogil=True, inline="always")
def _add_products(columns, count, sums):  # type: ignore[no-untyped-def]
    """Add the products of all pairs of columns, over ``count`` points, to the lower triangle of
    ``sums``: eight at a time, so that a number read is used more than once."""
    zero = np.float32(0)
    for n in range(0, len(columns), 2):
        a, b = columns[n], columns[n + 1]
        for m in range(0, n + 2, 4):
            c, d, e, f = columns[m], columns[m + 1], columns[m + 2], columns[m + 3]
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


@njit(nogil=True)
def turn(rotation, centre, change):  # type: ignore[no-untyped-def]
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
