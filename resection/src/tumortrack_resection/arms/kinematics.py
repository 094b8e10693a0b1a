"""Kinematics of UR5 and UR10e: their maker's published numbers
(https://www.universal-robots.com/articles/ur/application-installation/dh-parameters-for-calculations-of-kinematics-and-dynamics/).
A real arm is off by one to two millimetres at the flange: by its calibration, which its own
controller knows."""

from __future__ import annotations

import math
from collections.abc import Iterator
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
    """Standard Denavit-Hartenberg: Rz(joint) Tz(d) Tx(a) Rx(alpha) per joint. ``speeds_rad_s``
    and ``reach_mm`` (base to flange): the maker's maxima; ``limits_rad``: in both directions."""

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


# Inverse kinematics: the approach is that of Hawkins 2013, 'Analytic inverse kinematics for the
# Universal Robots UR-5/UR-10 arms' (Georgia Institute of Technology); no code was copied. Axes 2, 3
# and 4 are parallel; their common direction, the side, depends on joint 1 alone. In the flange's
# frame it gives joints 5 and 6; joints 2 to 4 then move a chain in the plane across it.

# Rounding brings a sine or cosine of 1 to 1 + 1e-15; this far beyond 1 it is taken for 1, and a
# sine of joint 5 below this for 0. Either moves the flange by less than 1e-6 mm and 1e-9 rad.
_ROUNDING = 1e-10


def inverse_kinematics(model: ArmModel, base_from_flange: Pose) -> Float64[np.ndarray, "k 6"]:
    """Joint angles (k, 6) in -pi..pi, k from 0 to 8, that bring the flange to a rigid pose (mm).

    In the order of joint 1 (shoulder on either side), joint 5 (0 to pi, then the flipped wrist)
    and joint 3 (elbow bent either way); with the elbow stretched out two are equal. With
    sin(joint 5) = 0 joint 6 is free: it is chosen so that the offset ``d5`` points straight away
    from the shoulder, or towards it with the flipped wrist. If the elbow reaches with any joint
    6, it does with one of these."""
    x, y, up = base_from_flange[:3].tolist()  # each of the flange's three axes and its origin
    branches = []
    for joint_1 in _shoulders(model, x, y):
        cos_1, sin_1 = math.cos(joint_1), math.sin(joint_1)
        ahead = [cos_1 * a + sin_1 * b for a, b in zip(x, y, strict=True)]
        side = [sin_1 * a - cos_1 * b for a, b in zip(x, y, strict=True)]
        for joint_5, joint_6 in _wrists(model, ahead, up, side):
            elbows = _elbows(model, ahead, up, joint_5, joint_6)
            branches += [(joint_1, *joints, joint_5, joint_6) for joints in elbows]
    return wrapped(np.array(branches, float).reshape(-1, 6))


def _shoulders(model: ArmModel, x: list[float], y: list[float]) -> Iterator[float]:
    """Joint 1: the origin of frame 5, ``d6`` behind the flange, lies ``d4`` to the side."""
    d4, d6 = float(model.d_mm[3]), float(model.d_mm[5])
    middle_x, middle_y = x[3] - d6 * x[2], y[3] - d6 * y[2]
    far_mm = math.hypot(middle_x, middle_y)
    if d4 <= far_mm * (1 + _ROUNDING):
        towards, off = math.atan2(middle_y, middle_x), math.asin(min(d4 / far_mm, 1.0))
        yield towards + math.pi - off
        yield towards + off


def _wrists(
    model: ArmModel, ahead: list[float], up: list[float], side: list[float]
) -> Iterator[tuple[float, float]]:
    """Joints 5 and 6: the side is (sin5 cos6, -sin5 sin6, cos5) in the flange's frame."""
    a, b, cos_5, _ = side
    sin_5 = math.hypot(a, b)
    if sin_5 < _ROUNDING:
        d1, d6 = model.d_mm[[0, 5]].tolist()
        far_mm, high_mm = ahead[3] - d6 * ahead[2], up[3] - d6 * up[2] - d1
        a, b = -far_mm * ahead[1] - high_mm * up[1], far_mm * ahead[0] + high_mm * up[0]
    yield math.atan2(sin_5, cos_5), math.atan2(-b, a)
    yield math.atan2(-sin_5, cos_5), math.atan2(b, -a)


def _elbows(
    model: ArmModel, ahead: list[float], up: list[float], joint_5: float, joint_6: float
) -> Iterator[tuple[float, float, float]]:
    """Joints 2, 3 and 4: upper arm and forearm end where frame 4 begins, and frame 4's x points
    where the flange's orientation and the wrist want it."""
    (a2, a3), (d1, _, _, _, d5, d6) = model.a_mm[1:3].tolist(), model.d_mm.tolist()
    cos_5, sin_5 = math.cos(joint_5), math.sin(joint_5)
    cos_6, sin_6 = math.cos(joint_6), math.sin(joint_6)
    points, ends = [], []  # ahead and up: where frame 4's x points, and the forearm's end
    for x, y, z, origin in (ahead, up):
        points.append(cos_5 * (cos_6 * x - sin_6 * y) - sin_5 * z)
        ends.append(origin - d6 * z + d5 * (sin_6 * x + cos_6 * y))
    end_ahead, end_up = ends[0], ends[1] - d1
    cos_3 = (end_ahead**2 + end_up**2 - a2**2 - a3**2) / (2 * a2 * a3)
    if abs(cos_3) <= 1 + _ROUNDING:
        bent = math.acos(max(-1.0, min(cos_3, 1.0)))
        for joint_3 in (bent, -bent):
            across, along = a3 * math.sin(joint_3), a2 + a3 * math.cos(joint_3)
            joint_2 = math.atan2(end_up, end_ahead) - math.atan2(across, along)
            yield joint_2, joint_3, math.atan2(points[1], points[0]) - joint_2 - joint_3
