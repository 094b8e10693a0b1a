"""Kernels of the refinement: all Gauss-Newton iterations in one compiled call.

A step takes less than half a millisecond; calling Python in between would take as long again, and
two starts refined on two cores would wait for each other's. See ``gauss_newton`` for what is
minimised.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from tumortrack.registration.residual_kernels import POSE, DistanceLattice, Flow, Pose, add_rows
from tumortrack.simulate.elastic.flow import BLOCK, block, combine, steps_of

_AT_ONCE = 256  # points whose rows stay in the cache; also so many are summed in single precision
_APART = 16  # numbers between rows of sums: rows a power of two apart share a cache's lines


class Organ(NamedTuple):
    """The organ at rest, and the prior of its motion; CT frame, mm."""

    modes: np.ndarray  # (i, j, k, 3, m), float32
    origin_mm: np.ndarray  # (3,)
    spacing_mm: np.float32
    center_ct: np.ndarray  # (3,), float64
    distances: DistanceLattice
    precision: np.ndarray  # (p, p), float64
    mean: np.ndarray  # (m,), float64


class Options(NamedTuple):
    """See ``GaussNewtonConfig``; ``weight`` of one point's squared distance."""

    weight: float
    first_mm: float
    last_mm: float
    narrowing: float
    enough_mm: float


class State(NamedTuple):
    """What is refined, float64, changed in place."""

    rotation: np.ndarray  # (3, 3)
    centre_mm: np.ndarray  # (3,)
    coefficients: np.ndarray  # (m,)
    moved: np.ndarray  # (6,): shift and turn since the start


class Residuals(NamedTuple):
    """Of the last state, changed in place."""

    distances_mm: np.ndarray  # (n,), float32
    curvature: np.ndarray  # (p, p), float64
    gradient: np.ndarray  # (p,), float64


class Workspace(NamedTuple):
    """Memory of ``normal_equations``."""

    rows: np.ndarray  # (BLOCK, p + 1), float32
    columns: np.ndarray  # (p + 1 or more, _AT_ONCE + _APART), float32, zero


@numba.njit(cache=True, fastmath=True, nogil=True)
def descend(organ, points, options, state, residuals, first, last):  # type: ignore[no-untyped-def]
    """Steps ``first`` to ``last`` of a refinement, fewer if it converges.

    Args:
        organ: ``Organ``; options: ``Options``; state: ``State``.
        points: observed, (n, 3), camera frame, mm, float32.
        residuals: ``Residuals``; where ``first`` is not 0, those that the steps before have left.

    Returns:
        The number of steps taken, whether it has converged, and the last state's cost.
    """
    unknowns = len(residuals.gradient)
    rows = np.empty((BLOCK, unknowns + 1), np.float32)
    columns = np.zeros((-(-(unknowns + 1) // 4) * 4, _AT_ONCE + _APART), np.float32)
    room, cost = Workspace(rows, columns), 0.0
    if first == 0:
        cost = _equations(organ, points, options, state, _width(options, 0), room, residuals)
    for step in range(first, last):
        change = np.linalg.solve(residuals.curvature, residuals.gradient)
        _turn(state.rotation, state.centre_mm, change)
        for n in range(POSE):
            state.moved[n] -= change[n]
        for n in range(len(state.coefficients)):
            state.coefficients[n] -= change[POSE + n]
        cost = _equations(organ, points, options, state, _width(options, step + 1), room, residuals)
        small = np.abs(change).max() < options.enough_mm
        if small and _width(options, step) == options.last_mm:
            return step + 1, True, cost
    return last, False, cost


@numba.njit(cache=True, nogil=True)
def _width(options, step):  # type: ignore[no-untyped-def]
    """The robust kernel's width (mm) after so many steps; a point pulls most at 0.58 of it."""
    return max(options.last_mm, options.first_mm * options.narrowing**step)


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def _equations(  # type: ignore[no-untyped-def]
    organ, points, options, state, width, room, residuals
):
    """Distances, curvature and gradient of the cost at a state into ``residuals``; the cost."""
    distances, curvature, gradient = residuals
    weight, last_mm, precision = options.weight, options.last_mm, organ.precision
    velocity = combine(organ.modes, (-state.coefficients).astype(np.float32))
    steps = steps_of(velocity, organ.spacing_mm)
    flow = Flow(velocity, organ.origin_mm, organ.spacing_mm, steps)
    pose = Pose(organ.center_ct, state.rotation, state.centre_mm)
    normal_equations(flow, organ, pose, np.float32(width), points, room, residuals)
    unknowns, cost = len(gradient), 0.0
    for p in range(len(distances)):  # rho of Geman and McClure: its derivative is the weight below
        square = (np.float64(distances[p]) / last_mm) ** 2
        cost += square / (1.0 + square)
    cost *= weight * last_mm**2
    off = np.empty(unknowns)
    off[:POSE] = state.moved
    off[POSE:] = state.coefficients - organ.mean
    for n in range(unknowns):
        pull = 0.0
        for m in range(unknowns):
            pull += precision[n, m] * off[m]
            curvature[n, m] = weight * curvature[n, m] + precision[n, m]
        gradient[n] = weight * gradient[n] + pull
        cost += off[n] * pull
    return cost


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def normal_equations(flow, organ, pose, width, points, room, out):  # type: ignore[no-untyped-def]
    """Distances as ``add_rows`` gives them, and the sums over points of ``pull * row * row'`` and
    of ``pull * row * distance`` into ``out`` (``Residuals``); ``pull`` is
    1 / (1 + (distance / width)^2)^2. ``flow`` has the opposite velocity."""
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
            add_rows(
                flow, organ.modes, pose, organ.distances, some, (places, speeds, middles), rows
            )
            for p in range(len(some)):
                distance = rows[p, unknowns]
                distances[first + p] = distance
                # The root of the kernel's weight: both factors of a product carry it.
                root_weight = one / (one + (distance * per_width) ** 2)
                for n in range(unknowns + 1):
                    across[n, first - start + p] = rows[p, n] * root_weight
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
