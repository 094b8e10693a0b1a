"""Shared by ROS and the viewer: which observed points are shown, and rotations as quaternions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from tumortrack.core.camera import deproject_pixels
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation

MOST_SEEN = 20_000  # points shown


def seen_points(observation: Observation) -> Float32[np.ndarray, "n 3"]:
    """Points of an observation, camera frame; a depth image's are thinned."""
    content = observation.content
    if isinstance(content, SensorCloud):
        return content.points_mm
    index = _seen_pixels(content)
    depth_mm = content.depth_mm.ravel()[index].astype(np.float64)
    return deproject_pixels(index, depth_mm, content.intrinsics)


def seen_colours(observation: Observation) -> UInt8[np.ndarray, "n 3"] | None:
    """Of these points; None without a picture."""
    content, picture = observation.content, observation.picture
    if picture is None or isinstance(content, SensorCloud):
        return None
    colours = picture.reshape(content.depth_mm.size, -1)[_seen_pixels(content)]
    return np.broadcast_to(colours, (len(colours), 3))


def _seen_pixels(frame: DepthFrame) -> Int[np.ndarray, " n"]:
    height, width = frame.depth_mm.shape
    step = max(1, int(np.ceil(np.sqrt(height * width / MOST_SEEN))))
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    return (rows * width + columns)[frame.depth_mm[::step, ::step] > 0]


def thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` rows, evenly spaced."""
    return rows[:: max(1, -(-len(rows) // most))]


def wxyz_of(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Quaternions, w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
