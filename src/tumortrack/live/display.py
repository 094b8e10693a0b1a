"""What ROS and the viewer share: which observed points are shown, and rotations as quaternions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation
from tumortrack.sense.camera import deproject_pixels

MOST_SEEN = 20_000  # points shown


def seen_points(observation: Observation) -> Float32[np.ndarray, "n 3"]:
    """Points of an observation, thinned while they are still pixels; camera frame."""
    content = observation.content
    if isinstance(content, SensorCloud):
        return content.points_mm
    assert isinstance(content, DepthFrame)
    height, width = content.depth_mm.shape
    step = max(1, int(np.ceil(np.sqrt(height * width / MOST_SEEN))))
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    depth_mm = content.depth_mm[::step, ::step].ravel()
    there = np.flatnonzero(np.isfinite(depth_mm) & (depth_mm > 0))
    index = (rows * width + columns).ravel()[there]
    return deproject_pixels(index, depth_mm[there].astype(np.float64), content.intrinsics)


def thinned(rows: np.ndarray, most: int) -> np.ndarray:
    """Evenly spaced rows, ``most`` at the most."""
    return rows[:: max(1, -(-len(rows) // most))]


def wxyz_of(rotation: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Quaternions, w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)
