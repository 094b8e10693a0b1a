"""Samples and integrates a velocity field on a lattice (kernels: ``native/fast/flow.h``).

The deformation is the exponential of a stationary velocity field (Arsigny et al. 2006, doi
10.1007/11866565_113): points follow the field for one unit of time. It is one-to-one, its inverse
follows the opposite field, and a field without divergence preserves volume even for large motions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from tumortrack.native import F32, kernel

# Fields and modes are made of finite numbers, and too large to be checked in each call.
VELOCITY = F32["i", "j", "k", 3].any_value
MODES = (F32["i", "j", "k", 3, "m"].any_value, F32[3], float)
FLOW = (VELOCITY, F32[3], float, int)

BLOCK = 64  # points that take each step together, as in flow.h


class LatticeField(NamedTuple):
    """Values at the nodes ``origin_mm + spacing_mm * (i, j, k)``, all float32: a velocity
    (i, j, k, 3) in mm per unit of time, or modes (i, j, k, 3, m)."""

    values: Float32[np.ndarray, "i j k ..."]
    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: np.float32


class Flow(NamedTuple):
    """The velocity field that points follow for one unit of time, in ``steps``."""

    velocity: Float32[np.ndarray, "i j k 3"]  # mm
    origin_mm: Float32[np.ndarray, " 3"]
    spacing_mm: np.float32
    steps: int


_count_steps = kernel("count_steps", VELOCITY, float, result=int)
_combine = kernel("combine_modes", MODES[0], F32["m"], VELOCITY.out)
_follow = kernel("follow", FLOW, F32["n", 3], F32["n", 3].out)
_project = kernel("project", MODES, F32["n", 3], F32["n", 3], F32["n", "m"].out)


def steps_for(velocity: Float32[np.ndarray, "i j k 3"], spacing_mm: float) -> int:
    """Integration steps that a field needs: the more, the steeper it is."""
    return int(_count_steps(velocity, spacing_mm))


def combine(
    modes: Float32[np.ndarray, "i j k 3 m"], coefficients: Float32[np.ndarray, " m"]
) -> Float32[np.ndarray, "i j k 3"]:
    """``modes @ coefficients``, on one thread."""
    velocity = np.empty(modes.shape[:-1], np.float32)
    _combine(modes, coefficients, velocity)
    return velocity


def follow(
    field: LatticeField, points: Float32[np.ndarray, "n 3"], steps: int
) -> Float32[np.ndarray, "n 3"]:
    """Points, mm, after one unit of time in a velocity field."""
    out = np.empty_like(points)
    _follow((*field, steps), points, out)
    return out


def project(
    field: LatticeField,
    points: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n m"]:
    """Trilinear values of modes at points, mm, each along a direction. Points beyond the lattice
    are clamped to its border."""
    out = np.empty((len(points), field.values.shape[4]), np.float32)
    _project(field, points, directions, out)
    return out
