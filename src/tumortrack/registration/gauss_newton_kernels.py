"""The refinement's kernel (C: ``native/fast/gauss_newton.c``): all Gauss-Newton iterations in one
call.

A step takes less than half a millisecond; calling Python in between would take as long again, and
two hypotheses refined on two cores would wait for each other's. See ``gauss_newton`` for what is
minimised.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.native import F32, F64, kernel
from tumortrack.registration.kernels import DISTANCES, POSE, DistanceField
from tumortrack.simulate.elastic.flow import BLOCK, MODES, VELOCITY, LatticeField

_STRIDE = 256 + 16  # of gauss_newton.c's columns


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


_PROBLEM = (
    MODES, F64[3], DISTANCES, F64["p", "p"], F64["m"], F32["n", 3], float, float, float, float,
    float,
)  # fmt: skip
_STATE = (
    F64[3, 3].out, F64[3].out, F64["m"].out, F64[6].out, F32["n"].out, F64["p", "p"].out,
    F64["p"].out,
)  # fmt: skip
_ROOM = (
    VELOCITY.out, F32["m"].out, F32[BLOCK, "q"].out, F32["c", _STRIDE].out, F64["c", "s"].out,
    F64["p", "p"].out, F64["p"].out,
)  # fmt: skip
_descend = kernel("descend", _PROBLEM, _STATE, _ROOM, int, int, F64[2].out, result=int)


def descend(problem: Problem, state: State, first: int, last: int) -> tuple[int, bool, float]:
    """Steps ``first`` to ``last`` of a refinement, fewer if it converges: their number, whether it
    has converged, and the last cost. Where ``first`` is not 0, ``state`` is what is left by the
    steps before. Raises numpy.linalg.LinAlgError: the curvature is not positive definite."""
    unknowns, ended = POSE + len(problem.mean), np.empty(2)
    columns = -(-(unknowns + 1) // 4) * 4
    room = (
        np.empty(problem.modes.values.shape[:-1], np.float32),
        np.empty(len(problem.mean), np.float32),
        np.empty((BLOCK, unknowns + 1), np.float32),
        np.empty((columns, _STRIDE), np.float32),
        np.empty((columns, columns + 4)),
        np.empty((unknowns, unknowns)),
        np.empty(unknowns),
    )
    steps = _descend(problem, state, room, first, last, ended)
    if steps < 0:
        raise np.linalg.LinAlgError("the refinement's curvature is not positive definite")
    return steps, bool(ended[0]), float(ended[1])
