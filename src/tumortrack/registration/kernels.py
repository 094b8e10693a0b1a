"""Kernels of a motion and of an organ at rest: points carried to the camera and back, distances,
labels, probabilities, and derivatives by every unknown.

Modes lie on the flow's lattice. Unknowns are shift, turn and coefficients, in this order.
Derivatives by coefficients are to first order: the modes halfway along a point's path.
"""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from tumortrack.core.compiled import njit
from tumortrack.simulate.elastic.flow import BLOCK, add_modes, block, enter, travel

POSE = 6  # unknowns before the coefficients
NODES_MM = 2.0  # apart, of the lattice for ``look_up``
_MOST_STD, _PER_STD = 8, 1024  # so wide a table, in such steps, is right to 1e-7
_NORMAL = np.array([NormalDist().cdf(n / _PER_STD) for n in range(_MOST_STD * _PER_STD + 2)])


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


class DistanceField(NamedTuple):
    """Signed distances (mm, negative inside) to one closed surface on a lattice of the CT frame."""

    values_mm: np.ndarray  # (i, j, k), float32
    origin_mm: np.ndarray  # (3,), float32
    spacing_mm: float


@njit(fastmath=True, nogil=True)
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


@njit(fastmath=True, nogil=True)
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


@njit(fastmath=True, nogil=True)
def effects(flow, modes, center, points, out):  # type: ignore[no-untyped-def]
    """What each unknown does to the place of each point (n, 3), float32, in the organ's axes, into
    ``out`` (n, 3, p), float64."""
    velocity, origin, spacing, steps = flow
    places, speeds, middles = block()
    along, row = np.eye(3, dtype=np.float32), np.empty(modes.shape[-1], np.float32)
    for first in range(0, len(points), BLOCK):
        some = points[first : first + BLOCK]
        enter(some, origin, spacing, places)
        travel(velocity, spacing, steps, len(some), places, speeds, middles)
        for p in range(len(some)):
            x, y, z = middles[0, p], middles[1, p], middles[2, p]
            for axis in range(3):
                after, before = (axis + 1) % 3, (axis + 2) % 3
                effect = out[first + p, axis]
                effect[:POSE] = 0
                effect[axis] = 1
                effect[3 + after] = origin[before] + spacing * places[before, p] - center[before]
                effect[3 + before] = center[after] - origin[after] - spacing * places[after, p]
                row[:] = 0
                add_modes(modes, x, y, z, along[axis], row)
                effect[POSE:] = row


@njit(fastmath=True, nogil=True)
def residual_rows(modes, field, flow, pose, points, out):  # type: ignore[no-untyped-def]
    """``add_rows`` of any number of points (n, 3), into ``out`` (n, p + 1), float32."""
    buffers = block()
    for first in range(0, len(points), BLOCK):
        some = points[first : first + BLOCK]
        add_rows(modes, field, flow, pose, some, buffers, out[first : first + BLOCK])


@njit(fastmath=True, nogil=True, inline="always")
def add_rows(modes, field, flow, pose, points, buffers, rows):  # type: ignore[no-untyped-def]
    """What each unknown does to the signed distance of one block of points (n, 3; camera frame,
    mm), carried back, to a surface at rest; the distance itself stands in the last column of
    ``rows`` (n, p + 1). ``flow`` has the opposite velocity; ``field`` is the surface's
    ``DistanceField``; ``buffers`` are those of ``elastic.flow.block()``."""
    velocity, origin, spacing, steps = flow
    center, rotation, centre = pose
    values, corner, width = field.values_mm, field.origin_mm, np.float32(field.spacing_mm)
    places, speeds, middles = buffers
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


@njit(fastmath=True, nogil=True, inline="always")
def distance_at(values, origin, spacing, x, y, z):  # type: ignore[no-untyped-def]
    """Distance and its slope along x, y, z at one place (mm), by trilinear interpolation."""
    zero, one, most = np.float32(0), np.float32(1), np.float32(1.001)
    per_cell = one / spacing
    x = min(max((x - origin[0]) * per_cell, zero), np.float32(values.shape[0]) - most)
    y = min(max((y - origin[1]) * per_cell, zero), np.float32(values.shape[1]) - most)
    z = min(max((z - origin[2]) * per_cell, zero), np.float32(values.shape[2]) - most)
    i, j, k = int(x), int(y), int(z)
    a, b, c = np.float32(x - i), np.float32(y - j), np.float32(z - k)
    v000, v001 = values[i, j, k], values[i, j, k + 1]
    v010, v011 = values[i, j + 1, k], values[i, j + 1, k + 1]
    v100, v101 = values[i + 1, j, k], values[i + 1, j, k + 1]
    v110, v111 = values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1]
    l00, l01 = v000 + (v001 - v000) * c, v010 + (v011 - v010) * c
    l10, l11 = v100 + (v101 - v100) * c, v110 + (v111 - v110) * c
    f0, f1 = l00 + (l01 - l00) * b, l10 + (l11 - l10) * b
    by_y = (l01 - l00) * (one - a) + (l11 - l10) * a
    d0 = (v001 - v000) * (one - b) + (v011 - v010) * b
    d1 = (v101 - v100) * (one - b) + (v111 - v110) * b
    by_z = d0 * (one - a) + d1 * a
    return f0 + (f1 - f0) * a, (f1 - f0) * per_cell, by_y * per_cell, by_z * per_cell


@njit(fastmath=True, nogil=True)
def mark(field, label, points, labels, margin):  # type: ignore[no-untyped-def]
    """Labels points inside, and lowers each point's margin to its distance from the surface."""
    values, origin, spacing = field.values_mm, field.origin_mm, np.float32(field.spacing_mm)
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        distance = distance_at(values, origin, spacing, x, y, z)[0]
        if distance < 0:
            labels[p] = label
        margin[p] = min(margin[p], abs(distance))


@njit(nogil=True)
def probabilities(margins, per_std, which):  # type: ignore[no-untyped-def]
    """Of normal errors below margins (n,), 0 or more; ``per_std[which]`` is one over a point's
    standard deviation. Float32 (n,)."""
    out = np.empty(len(margins), np.float32)
    for p in range(len(margins)):
        place = min(margins[p] * per_std[which[p]], np.float64(_MOST_STD)) * _PER_STD
        n = int(place)
        out[p] = _NORMAL[n] + (place - n) * (_NORMAL[n + 1] - _NORMAL[n])
    return out


@njit(nogil=True)
def look_up(origin, nearest, points):  # type: ignore[no-untyped-def]
    """The number of the place nearest to each point: that of the nearest node of a lattice, which
    may be another where two are about as near; outside the lattice that of its border."""
    step = np.float32(NODES_MM)
    out, zero, half = np.empty(len(points), np.int32), np.float32(0), np.float32(0.5)
    x_last, y_last, z_last = nearest.shape[0] - 1, nearest.shape[1] - 1, nearest.shape[2] - 1
    for p in range(len(points)):
        i = int(max((points[p, 0] - origin[0]) / step + half, zero))
        j = int(max((points[p, 1] - origin[1]) / step + half, zero))
        k = int(max((points[p, 2] - origin[2]) / step + half, zero))
        out[p] = nearest[min(i, x_last), min(j, y_last), min(k, z_last)]
    return out
