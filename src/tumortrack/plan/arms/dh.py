"""Kinematic numbers of UR5 and UR10e as their maker publishes them, and plain forward kinematics.

Lengths and angles: Universal Robots, 'DH parameters for calculations of kinematics and dynamics',
https://www.universal-robots.com/articles/ur/application-installation/
dh-parameters-for-calculations-of-kinematics-and-dynamics/. A real arm differs from them by its
calibration: one to two millimetres at the flange, which the arm's own controller knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

_TURN = 2 * np.pi
_QUARTER = np.pi / 2


@dataclass(frozen=True, eq=False)
class ArmModel:
    """One type of arm, standard Denavit-Hartenberg: Rz(joint) Tz(d) Tx(a) Rx(alpha) per joint.

    Attributes:
        name: as ``ur_analytic_ik`` calls it.
        a_mm, d_mm, alpha_rad: per joint (6,).
        limits_rad: of the joints, both ways (6,).
        speeds_rad_s: the greatest that the maker states (6,).
        reach_mm: the maker's figure, from the base to the flange's middle.
    """

    name: str
    a_mm: Float64[np.ndarray, " 6"]
    d_mm: Float64[np.ndarray, " 6"]
    alpha_rad: Float64[np.ndarray, " 6"]
    limits_rad: Float64[np.ndarray, " 6"]
    speeds_rad_s: Float64[np.ndarray, " 6"]
    reach_mm: float


_ALPHA = np.array([_QUARTER, 0.0, 0.0, _QUARTER, -_QUARTER, 0.0])
# All joints turn +-360 degrees; an elbow beyond 180 would pass through its own arm, so it is kept
# within (as Universal Robots' own ROS description does).
_LIMITS = np.array([_TURN, _TURN, np.pi, _TURN, _TURN, _TURN])

UR5 = ArmModel(
    name="ur5",
    a_mm=np.array([0.0, -425.0, -392.25, 0.0, 0.0, 0.0]),
    d_mm=np.array([89.159, 0.0, 0.0, 109.15, 94.65, 82.3]),
    alpha_rad=_ALPHA,
    limits_rad=_LIMITS,
    speeds_rad_s=np.radians([180.0] * 6),
    reach_mm=850.0,
)
UR10E = ArmModel(
    name="ur10e",
    a_mm=np.array([0.0, -612.7, -571.55, 0.0, 0.0, 0.0]),
    d_mm=np.array([180.7, 0.0, 0.0, 174.15, 119.85, 116.55]),
    alpha_rad=_ALPHA,
    limits_rad=_LIMITS,
    speeds_rad_s=np.radians([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]),
    reach_mm=1300.0,
)
MODELS = {model.name: model for model in (UR5, UR10E)}

# The maker states no limit of acceleration. 1.4 rad/s^2 is what its controller takes for a joint
# move where the program names none (URScript manual, movej): a pace meant for beside people, and
# far below what either arm can do.
ACCELERATION_RAD_S2 = 1.4
JERK_RAD_S3 = 10.0


def flange_pose(
    model: ArmModel, joints_rad: Float64[np.ndarray, " 6"]
) -> Float64[np.ndarray, "4 4"]:
    """``base_from_flange``, mm, by the plain product of the six transforms.

    Slow, and independent of every library: what the others are checked against.
    """
    base_from_flange = np.eye(4)
    rows = zip(joints_rad, model.a_mm, model.d_mm, model.alpha_rad, strict=True)
    for theta, a, d, alpha in rows:
        (ct, st), (ca, sa) = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
        base_from_flange = base_from_flange @ np.array(
            [
                [ct, -st * ca, st * sa, a * ct],
                [st, ct * ca, -ct * sa, a * st],
                [0.0, sa, ca, d],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    return base_from_flange
