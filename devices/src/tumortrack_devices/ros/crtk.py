"""A result in the words of CRTK (https://crtk-robotics.readthedocs.io), in types that SlicerROS2
reads but for the covariance. Metres and radians.

A pose is valid in good results alone. In others its stamp is 0, which is CRTK's word for invalid,
and its numbers are NaN, so that who looks at neither stamp nor verdict has no place to go to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import Affine, transform_points
from tumortrack.live.values import TrackingResult
from tumortrack.registration.motion import ElasticMotion
from tumortrack_devices.display import wxyz_of
from tumortrack_devices.extra_status import NextTouch
from tumortrack_devices.ros.messages import MM_PER_M, Messages, Outgoing, xyz

POSE = "geometry_msgs/msg/PoseStamped"
_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_POSES, _TEXT = "geometry_msgs/msg/PoseArray", "std_msgs/msg/String"
_NUMBERS = "std_msgs/msg/Float64MultiArray"
_SI = np.array([1 / MM_PER_M] * 3 + [1.0] * 3)  # of a pose's six coordinates: mm, rad
_NOWHERE, _UNKNOWN = (np.full(3, np.nan), np.full(4, np.nan)), np.full(36, np.nan)
_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


def crtk_messages(
    result: TrackingResult, parts: Sequence[str], touches: Sequence[NextTouch], messages: Messages
) -> list[Outgoing]:
    """Of each part ``measured_cp`` and, with its covariance, ``measured_cp_covariance``; of all
    ``next_touch``, ``verdict`` and ``bounds``, whose label names the parts of its numbers."""
    stamp_ns, frame_id = result.stamp_ns, result.published_frame.frame_id
    good = result.quality == "good"
    known = {name: result.part_pose(name) for name in parts if good}
    poses = {name: pose for name, pose in known.items() if pose is not None}
    turns = wxyz_of(np.array([pose[:3, :3] for pose in poses.values()])) if poses else ()
    places = {n: (pose[:3, 3], turn) for (n, pose), turn in zip(poses.items(), turns, strict=True)}
    covariances = _covariances(result, poses)
    headers = [messages.header(ns, frame_id) for ns in (0, stamp_ns)]
    out: list[Outgoing] = []
    for name in parts:
        header, pose = headers[name in poses], pose_fields(*places.get(name, _NOWHERE))
        covariance = {"pose": pose, "covariance": covariances.get(name, _UNKNOWN)}
        stated = messages.make(_COVARIANCE, header=header, pose=covariance)
        plain = messages.make(POSE, header=header, pose=stated.pose.pose)
        out.append(Outgoing(f"{name}/measured_cp", POSE, plain))
        out.append(Outgoing(f"{name}/measured_cp_covariance", _COVARIANCE, stated))
    to_touch = [pose_fields(each.place_mm, _UNTURNED) for each in touches]
    bounds = [result.bounds.get(name) for name in parts]
    bounds_m = [np.nan if each is None else each.error_bound95_mm / MM_PER_M for each in bounds]
    layout = {"dim": [{"label": ",".join(parts), "size": len(parts), "stride": len(parts)}]}
    for suffix, kind, fields in (
        ("next_touch", _POSES, {"header": headers[1], "poses": to_touch}),
        ("verdict", _TEXT, {"data": result.describe()}),
        ("bounds", _NUMBERS, {"layout": layout, "data": np.array(bounds_m)}),
    ):
        out.append(Outgoing(suffix, kind, messages.make(kind, **fields)))
    return out


def pose_fields(
    place_mm: Float64[np.ndarray, " 3"], wxyz: Float64[np.ndarray, " 4"]
) -> dict[str, Any]:
    """The fields of a Pose."""
    orientation = dict(zip("wxyz", wxyz.tolist(), strict=True))
    return {"position": xyz(place_mm / MM_PER_M), "orientation": orientation}


def _covariances(
    result: TrackingResult, poses: dict[str, Affine]
) -> dict[str, Float64[np.ndarray, " 36"]]:
    """Of place (m) and turn (rad) about the published frame's axes: the motion's, and the bounds of
    the calibration's error, where it states them, each taken for one standard deviation. Empty: the
    method knows none."""
    motion = None if result.estimate is None else result.estimate.motion
    if not poses or not isinstance(motion, ElasticMotion):
        return {}
    published = result.published_frame
    published_from_camera = published.published_from_camera
    places_mm = np.array([pose[:3, 3] for pose in poses.values()])
    camera_mm = transform_points(np.linalg.inv(published_from_camera), places_mm)
    known = motion.pose_covariance(motion.inverse(camera_mm))
    if known is None:
        return {}
    turn = np.kron(np.eye(2), published_from_camera[:3, :3])
    known = turn @ known @ turn.T
    for each, place_mm in zip(known, camera_mm, strict=True):
        error_mm = published.error_at(float(np.linalg.norm(place_mm))) or 0.0
        error_rad = np.radians(published.error_deg)
        each[np.diag_indices(6)] += np.repeat([error_mm**2, error_rad**2], 3)
    return dict(zip(poses, (known * np.outer(_SI, _SI)).reshape(-1, 36), strict=True))
