"""Kernels of a motion and of an organ at rest (C: ``native/fast/motion.c``, ``exact/lookup.c``):
points carried to the camera and back, distances, labels, probabilities, and derivatives by every
unknown.

Modes lie on the flow's lattice. Unknowns are shift, turn and coefficients, in this order.
Derivatives by coefficients are to first order: the modes halfway along a point's path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32

from tumortrack.native import F32, F64, I32, U8, kernel
from tumortrack.simulate.elastic.flow import FLOW, MODES, Flow, LatticeField

POSE = 6  # unknowns before the coefficients
NODES_MM = 2.0  # apart, of the lattice for ``look_up``


class Pose(NamedTuple):
    """x -> rotation (x - center_ct) + centre_mm; float64."""

    center_ct: Float64[np.ndarray, " 3"]
    rotation: Float64[np.ndarray, "3 3"]
    centre_mm: Float64[np.ndarray, " 3"]


class DistanceField(NamedTuple):
    """Signed distances (mm, negative inside) to one closed surface on a lattice of the CT frame."""

    values_mm: Float32[np.ndarray, "i j k"]
    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: float


POSE_GIVEN = (F64[3], F64[3, 3], F64[3])
DISTANCES = (F32["x", "y", "z"].any_value, F32[3], float)  # finite, and too large to look each time
_POINTS = F32["n", 3]

carry = kernel("carry", FLOW, POSE_GIVEN, _POINTS, F64["n", 3].out)
"""The pose of where the flow carries points."""

back = kernel("back", FLOW, POSE_GIVEN, _POINTS, F64["n", 3].out)
"""The inverse of ``carry``, if the flow has the opposite velocity."""

mark = kernel("mark", DISTANCES, int, _POINTS, U8["n"].out, F32["n"].out)
"""Gives points inside a label, and lowers each point's margin to its distance from the surface."""

_effects = kernel("effects", FLOW, MODES, F64[3], _POINTS, F32["m"].out, F64["n", 3, "p"].out)
_residual_rows = kernel(
    "residual_rows", MODES, DISTANCES, FLOW, POSE_GIVEN, _POINTS, F32["n", "q"].out
)
_probabilities = kernel("probabilities", F32["n"], F64["s"], I32["n"], F32["n"].out, result=int)
_look_up = kernel(
    "look_up", F32[3], I32["i", "j", "k"], _POINTS, float, I32["n"].out
)  # fmt: skip


def effects(
    flow: Flow,
    modes: LatticeField,
    center_ct: Float64[np.ndarray, " 3"],
    points: Float32[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3 p"]:
    """What each unknown does to the place of each point, in the organ's axes."""
    m = modes.values.shape[-1]
    out = np.empty((len(points), 3, POSE + m))
    _effects(flow, modes, center_ct, points, np.empty(m, np.float32), out)
    return out


def residual_rows(
    modes: LatticeField,
    field: DistanceField,
    flow: Flow,
    pose: Pose,
    points: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n q"]:
    """What each unknown does to the signed distance of points (camera frame, mm), carried back, to
    a surface at rest; the distance itself stands in the last column. ``flow`` has the opposite
    velocity."""
    out = np.empty((len(points), POSE + modes.values.shape[-1] + 1), np.float32)
    _residual_rows(modes, field, flow, pose, points, out)
    return out


def probabilities(
    margins: Float32[np.ndarray, " n"],
    per_std: Float64[np.ndarray, " s"],
    which: Int32[np.ndarray, " n"],
) -> Float32[np.ndarray, " n"]:
    """Of normal errors below margins, 0 or more; ``per_std[which]`` is one over a point's standard
    deviation. Raises IndexError."""
    out = np.empty(len(margins), np.float32)
    if _probabilities(margins, per_std, which, out):
        raise IndexError(f"which has numbers beyond the {len(per_std)} standard deviations")
    return out


def look_up(
    origin: Float32[np.ndarray, " 3"],
    nearest: Int32[np.ndarray, "i j k"],
    points: Float32[np.ndarray, "n 3"],
) -> Int32[np.ndarray, " n"]:
    """The number of the place nearest to each point: that of the nearest node of a lattice, which
    may be another where two are about as near; outside the lattice that of its border."""
    out = np.empty(len(points), np.int32)
    _look_up(origin, nearest, points, NODES_MM, out)
    return out
