"""Every joint configuration that brings a flange to a pose: at most eight, in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms.dh import ArmModel

_TURN = 2 * np.pi
_EXACT_MM, _EXACT_RAD = 1e-3, 1e-5


def branches(
    model: ArmModel, base_from_flange: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "k 6"]:
    """Joint angles (k, 6) in -pi..pi, k from 0 to 8, that reach a pose of the flange (mm).

    Shoulder left or right, elbow up or down, wrist turned either way. Each is kept only if forward
    kinematics lead back to the pose: at its singular poses the closed form yields others too.
    """
    solver, pose_m = _solver(model), np.array(base_from_flange, order="C")
    pose_m[:3, 3] /= 1000
    found = [one for one in solver.inverse_kinematics(pose_m) if _reaches(solver, one, pose_m)]
    joints = np.array(found).reshape(-1, 6)
    return joints - _TURN * np.round(joints / _TURN)


def nearest_turn(
    model: ArmModel, joints_rad: Float64[np.ndarray, "... 6"], near_rad: Float64[np.ndarray, " 6"]
) -> Float64[np.ndarray, "... 6"]:
    """The same poses with each joint turned by whole turns to lie nearest to ``near_rad`` within
    its limits."""
    turned = joints_rad + _TURN * np.round((near_rad - joints_rad) / _TURN)
    turned = np.where(turned > model.limits_rad, turned - _TURN, turned)
    return np.where(turned < -model.limits_rad, turned + _TURN, turned)


def _solver(model: ArmModel) -> Any:
    import ur_analytic_ik

    return getattr(ur_analytic_ik, model.name)


def _reaches(solver: Any, joints_rad: np.ndarray, pose_m: np.ndarray) -> bool:
    """Also False where there is a NaN."""
    off = np.abs(solver.forward_kinematics(*joints_rad) - pose_m)
    off[:3, 3] *= _EXACT_RAD / (_EXACT_MM / 1000)
    return bool(off.max() < _EXACT_RAD)
