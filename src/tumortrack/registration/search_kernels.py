"""Kernel of the search: a rigid body fitted to a few points from many starts, in one compiled call.

See ``gauss_newton`` for what is minimised; here without an elastic state and without a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.core.compiled import njit
from tumortrack.registration.gauss_newton_kernels import rho, root_weight, turn
from tumortrack.registration.kernels import POSE, DistanceField, distance_at

_MOST_RAD, _MOST_MM = 0.5, 25.0  # a step: linear beyond these it is not


class RigidProblem(NamedTuple):
    """The organ at rest (CT frame, mm), points (camera frame, mm), the robust kernel's width (mm)
    in each step, and the width by which starts are compared; ``damping`` (6,) of shift and turn."""

    distances: DistanceField
    center_ct: np.ndarray  # (3,), float64
    points: np.ndarray  # (n, 3), float32
    widths_mm: np.ndarray  # (steps,), float64
    last_mm: float
    damping: np.ndarray  # (6,), float64


@njit(fastmath=True, nogil=True)
def descend_rigidly(problem, rotations, centres, costs):  # type: ignore[no-untyped-def]
    """Refine each start's rotation (s, 3, 3) and centre (s, 3) in place; the mean ``rho`` of the
    points' distances, by ``last_mm``, into ``costs`` (s,)."""
    columns = np.empty((POSE + 1, len(problem.points)), np.float32)
    curvature, gradient = np.empty((POSE, POSE)), np.empty(POSE)
    for start in range(len(rotations)):
        rotation, centre = rotations[start], centres[start]
        for step in range(len(problem.widths_mm) + 1):  # the last one tells the cost alone
            whole = step == len(problem.widths_mm)
            width = problem.last_mm if whole else problem.widths_mm[step]
            costs[start] = _weighed_rows(problem, rotation, centre, np.float32(width), columns)
            if whole:
                break
            _equations(problem, columns, curvature, gradient)
            change = np.linalg.solve(curvature, gradient)
            for part, most in ((0, _MOST_MM), (3, _MOST_RAD)):
                size = np.sqrt((change[part : part + 3] ** 2).sum())
                if size > most:
                    change[part : part + 3] *= most / size
            turn(rotation, centre, change)


@njit(fastmath=True, nogil=True, inline="always")
def _weighed_rows(problem, rotation, centre, width, columns):  # type: ignore[no-untyped-def]
    """What shift and turn do to each point's distance, and the distance last, times ``root_weight``
    (p + 1, n); the mean of ``rho``."""
    values, origin, spacing = problem.distances
    cell, points, turned = np.float32(spacing), problem.points, rotation.astype(np.float32)
    at, center = centre.astype(np.float32), problem.center_ct.astype(np.float32)
    per_width, cost = np.float32(1) / width, np.float32(0)
    for p in range(len(points)):
        x, y, z = points[p, 0] - at[0], points[p, 1] - at[1], points[p, 2] - at[2]
        ox = turned[0, 0] * x + turned[1, 0] * y + turned[2, 0] * z
        oy = turned[0, 1] * x + turned[1, 1] * y + turned[2, 1] * z
        oz = turned[0, 2] * x + turned[1, 2] * y + turned[2, 2] * z
        px, py, pz = ox + center[0], oy + center[1], oz + center[2]
        off, sx, sy, sz = distance_at(values, origin, cell, px, py, pz)
        weight = root_weight(off * per_width)
        cost += rho(off * per_width)
        sx, sy, sz = -sx * weight, -sy * weight, -sz * weight
        columns[0, p], columns[1, p], columns[2, p] = sx, sy, sz
        columns[3, p] = sz * oy - sy * oz
        columns[4, p] = sx * oz - sz * ox
        columns[5, p] = sy * ox - sx * oy
        columns[6, p] = off * weight
    return cost / len(points)


@njit(fastmath=True, nogil=True, inline="always")
def _equations(problem, columns, curvature, gradient):  # type: ignore[no-untyped-def]
    """Curvature and gradient of the mean cost."""
    count = columns.shape[1]
    for n in range(POSE):
        for m in range(n, POSE + 1):
            total = np.float32(0)
            for p in range(count):
                total += columns[n, p] * columns[m, p]
            if m == POSE:
                gradient[n] = total / count
            else:
                curvature[n, m] = curvature[m, n] = total / count
        curvature[n, n] += problem.damping[n]
