"""The search's kernel (C: ``native/fast/search.c``): a rigid body fitted to a few points from many
starts, in one call.

See ``gauss_newton`` for what is minimised; here without an elastic state and without a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.native import F32, F64, kernel
from tumortrack.registration.kernels import DISTANCES, POSE, DistanceField


class RigidProblem(NamedTuple):
    """The organ at rest (CT frame, mm), points (camera frame, mm), the robust kernel's width (mm)
    in each step, and the width by which starts are compared; ``damping`` (6,) of shift and turn."""

    distances: DistanceField
    center_ct: np.ndarray  # (3,), float64
    points: np.ndarray  # (n, 3), float32
    widths_mm: np.ndarray  # (steps,), float64
    last_mm: float
    damping: np.ndarray  # (6,), float64


_descend_rigidly = kernel(
    "descend_rigidly", (DISTANCES, F64[3], F32["n", 3], F64["steps"], float, F64[POSE]),
    F32[POSE + 1, "n"].out, F64["s", 3, 3].out, F64["s", 3].out, F64["s"].out, result=int,
)  # fmt: skip


def descend_rigidly(
    problem: RigidProblem,
    rotations: Float64[np.ndarray, "s 3 3"],
    centres: Float64[np.ndarray, "s 3"],
    costs: Float64[np.ndarray, " s"],
) -> None:
    """Refine each start's rotation and centre in place; the mean ``rho`` of the points' distances,
    by ``last_mm``, into ``costs``. Raises numpy.linalg.LinAlgError."""
    columns = np.empty((POSE + 1, len(problem.points)), np.float32)
    if _descend_rigidly(problem, columns, rotations, centres, costs) < len(costs):
        raise np.linalg.LinAlgError("the search's curvature is not positive definite")
