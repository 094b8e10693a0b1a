"""Kinematics of UR5 and UR10e: their maker's published numbers, and turns of their joints.

Lengths and angles: Universal Robots, 'DH parameters for calculations of kinematics and dynamics',
https://www.universal-robots.com/articles/ur/application-installation/
dh-parameters-for-calculations-of-kinematics-and-dynamics/. A real arm differs from them by its
calibration: one to two millimetres at the flange, which the arm's own controller knows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import rigid, rotation_onto

Pose = Float64[np.ndarray, "4 4"]  # of frame b in frame a: ``a_from_b``, mm
TURN = 2 * np.pi
_QUARTER = np.pi / 2
_ALPHA = np.array([_QUARTER, 0.0, 0.0, _QUARTER, -_QUARTER, 0.0])
# All joints turn +-360 degrees; an elbow beyond 180 would pass through its own arm, so it is kept
# within (as Universal Robots' own ROS description does).
_LIMITS = np.array([TURN, TURN, np.pi, TURN, TURN, TURN])


class ArmModel(NamedTuple):
    """One type of arm, standard Denavit-Hartenberg: Rz(joint) Tz(d) Tx(a) Rx(alpha) per joint.

    Arrays are per joint (6,). ``speeds_rad_s`` and ``reach_mm`` (from the base to the flange's
    middle): the maker's maxima; ``limits_rad``: of the joints, in both directions.
    """

    name: str
    a_mm: Float64[np.ndarray, " 6"]
    d_mm: Float64[np.ndarray, " 6"]
    speeds_rad_s: Float64[np.ndarray, " 6"]
    reach_mm: float
    alpha_rad: Float64[np.ndarray, " 6"] = _ALPHA
    limits_rad: Float64[np.ndarray, " 6"] = _LIMITS


UR5 = ArmModel(
    name="ur5",
    a_mm=np.array([0.0, -425.0, -392.25, 0.0, 0.0, 0.0]),
    d_mm=np.array([89.159, 0.0, 0.0, 109.15, 94.65, 82.3]),
    speeds_rad_s=np.radians([180.0] * 6),
    reach_mm=850.0,
)
UR10E = ArmModel(
    name="ur10e",
    a_mm=np.array([0.0, -612.7, -571.55, 0.0, 0.0, 0.0]),
    d_mm=np.array([180.7, 0.0, 0.0, 174.15, 119.85, 116.55]),
    speeds_rad_s=np.radians([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]),
    reach_mm=1300.0,
)
MODELS = {model.name: model for model in (UR5, UR10E)}

# The maker states no limit of acceleration. 1.4 rad/s^2 is its controller's default for a joint
# move (URScript manual, movej): a pace for work beside people, far below what either arm can do.
ACCELERATION_RAD_S2 = 1.4


def wrapped(angles_rad: np.ndarray) -> np.ndarray:
    """The same angles in -pi..pi."""
    return angles_rad - TURN * np.round(angles_rad / TURN)


def nearest_turn(
    model: ArmModel, joints_rad: Float64[np.ndarray, "... 6"], near_rad: Float64[np.ndarray, " 6"]
) -> Float64[np.ndarray, "... 6"]:
    """The same poses, each joint turned by whole turns to lie nearest to ``near_rad`` within its
    limits."""
    turned = joints_rad + TURN * np.round((near_rad - joints_rad) / TURN)
    turned = np.where(turned > model.limits_rad, turned - TURN, turned)
    return np.where(turned < -model.limits_rad, turned + TURN, turned)


def level_pose(position_mm: Float64[np.ndarray, " 3"], yaw_rad: float) -> Pose:
    """``table_from_frame`` of a frame whose z is up and whose x points towards the yaw."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return rigid(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), position_mm)


def upright(up: Float64[np.ndarray, " 3"], yaw_rad: float = 0.0) -> Float64[np.ndarray, "3 3"]:
    """The shortest turn of ``level_pose``'s frame that brings its z to ``up``, a unit vector."""
    return rotation_onto(np.array([0.0, 0.0, 1.0]), up) @ level_pose(np.zeros(3), yaw_rad)[:3, :3]


def yaw_of(table_from_frame: Pose) -> float:
    """Where a level frame's x points, radians."""
    return float(np.arctan2(table_from_frame[1, 0], table_from_frame[0, 0]))
