"""Kernels of a motion: points carried to the camera and back, and derivatives by every unknown.

Modes lie on the flow's lattice. Unknowns are shift, turn and coefficients, in this order.
Derivatives by coefficients are to first order: the modes halfway along a point's path.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from tumortrack.registration.rest_shape import distance_at
from tumortrack.simulate.elastic.flow import BLOCK, add_modes, block, enter, travel

POSE = 6  # unknowns before the coefficients


class Flow(NamedTuple):
    """The velocity field that points follow for one unit of time, in ``steps``."""

    velocity: np.ndarray  # (i, j, k, 3), mm, float32
    origin_mm: np.ndarray  # (3,)
    spacing_mm: np.float32
    steps: int


class Pose(NamedTuple):
    """x -> rotation (x - center_ct) + centre_mm; float64."""

    center_ct: np.ndarray  # (3,)
    rotation: np.ndarray  # (3, 3)
    centre_mm: np.ndarray  # (3,)


class DistanceLattice(NamedTuple):
    """Signed distances to a surface on a lattice, CT frame, mm, float32."""

    values_mm: np.ndarray  # (i, j, k)
    origin_mm: np.ndarray  # (3,)
    spacing_mm: np.float32


@numba.njit(cache=True, fastmath=True, nogil=True)
def carry(flow, pose, points, out):  # type: ignore[no-untyped-def]
    """The pose of where the flow carries points (n, 3), float32, into ``out``, float64."""
    velocity, origin, spacing, steps = flow
    center, turn, to = pose
    places, speeds, middles = block()
    for first in range(0, len(points), BLOCK):
        some = points[first : first + BLOCK]
        enter(some, origin, spacing, places)
        travel(velocity, spacing, steps, len(some), places, speeds, middles)
        for p in range(len(some)):
            x = np.float64(origin[0] + spacing * places[0, p]) - center[0]
            y = np.float64(origin[1] + spacing * places[1, p]) - center[1]
            z = np.float64(origin[2] + spacing * places[2, p]) - center[2]
            for axis in range(3):
                moved = turn[axis, 0] * x + turn[axis, 1] * y + turn[axis, 2] * z
                out[first + p, axis] = moved + to[axis]


@numba.njit(cache=True, fastmath=True, nogil=True)
def back(flow, pose, points, out):  # type: ignore[no-untyped-def]
    """The inverse of ``carry``, if ``flow`` has the opposite velocity."""
    velocity, origin, spacing, steps = flow
    center, turn, to = pose
    per_cell = np.float32(1) / spacing
    places, speeds, middles = block()
    for first in range(0, len(points), BLOCK):
        some = points[first : first + BLOCK]
        for p in range(len(some)):
            x, y, z = some[p, 0] - to[0], some[p, 1] - to[1], some[p, 2] - to[2]
            for axis in range(3):
                turned = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z
                rest = np.float32(turned + center[axis])
                places[axis, p] = (rest - origin[axis]) * per_cell
        travel(velocity, spacing, steps, len(some), places, speeds, middles)
        for p in range(len(some)):
            for axis in range(3):
                out[first + p, axis] = origin[axis] + spacing * places[axis, p]


@numba.njit(cache=True, fastmath=True, nogil=True)
def variances(flow, modes, center, root, points, out):  # type: ignore[no-untyped-def]
    """The mean over x, y, z of each point's variance (n,), if ``root @ root.T`` (p, p) is the
    covariance of the unknowns: their effects times the root, squared. All float32."""
    velocity, origin, spacing, steps = flow
    places, speeds, middles = block()
    along = np.eye(3, dtype=np.float32)
    row, mixed = np.empty(len(root), np.float32), np.empty(len(root), np.float32)
    for first in range(0, len(points), BLOCK):
        some = points[first : first + BLOCK]
        enter(some, origin, spacing, places)
        travel(velocity, spacing, steps, len(some), places, speeds, middles)
        for p in range(len(some)):
            offset = (
                origin[0] + spacing * places[0, p] - center[0],
                origin[1] + spacing * places[1, p] - center[1],
                origin[2] + spacing * places[2, p] - center[2],
            )
            out[first + p] = 0
            for axis in range(3):
                row[:] = 0
                row[axis] = 1
                after, before = (axis + 1) % 3, (axis + 2) % 3
                row[3 + after] = offset[before]
                row[3 + before] = -offset[after]
                x, y, z = middles[0, p], middles[1, p], middles[2, p]
                add_modes(modes, x, y, z, along[axis], row[POSE:])
                mixed[:] = 0
                for n in range(len(root)):
                    for m in range(n + 1):  # the root is lower triangular
                        mixed[m] += row[n] * root[n, m]
                for m in range(len(root)):
                    out[first + p] += mixed[m] ** 2
            out[first + p] /= 3


@numba.njit(cache=True, fastmath=True, nogil=True, inline="always")
def add_rows(flow, modes, pose, field, points, room, rows):  # type: ignore[no-untyped-def]
    """What each unknown does to the signed distance of one block of points (n, 3; camera frame,
    mm), carried back, to a surface at rest; the distance itself stands in the last column of
    ``rows`` (n, p + 1).

    ``flow`` has the opposite velocity; ``field`` is the surface's ``DistanceLattice``; ``room`` is
    ``elastic.flow.block()``.
    """
    velocity, origin, spacing, steps = flow
    center, rotation, centre = pose
    values, corner, width = field
    places, speeds, middles = room
    per_cell, inwards = np.float32(1) / spacing, np.empty(3, np.float32)
    offsets = np.empty((BLOCK, 3), np.float32)
    for p in range(len(points)):
        x, y, z = points[p, 0] - centre[0], points[p, 1] - centre[1], points[p, 2] - centre[2]
        for axis in range(3):
            turned = rotation[0, axis] * x + rotation[1, axis] * y + rotation[2, axis] * z
            offsets[p, axis] = turned
            places[axis, p] = (np.float32(turned + center[axis]) - origin[axis]) * per_cell
    travel(velocity, spacing, steps, len(points), places, speeds, middles)
    for p in range(len(points)):
        x = origin[0] + spacing * places[0, p]
        y = origin[1] + spacing * places[1, p]
        z = origin[2] + spacing * places[2, p]
        row = rows[p]
        row[-1], sx, sy, sz = distance_at(values, corner, width, x, y, z)
        inwards[0], inwards[1], inwards[2] = -sx, -sy, -sz
        ox, oy, oz = offsets[p, 0], offsets[p, 1], offsets[p, 2]
        row[0], row[1], row[2] = -sx, -sy, -sz
        row[3], row[4], row[5] = sy * oz - sz * oy, sz * ox - sx * oz, sx * oy - sy * ox
        row[POSE:-1] = 0
        add_modes(modes, middles[0, p], middles[1, p], middles[2, p], inwards, row[POSE:-1])
