"""Observed points: fewer of them, and which one a click means."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32

from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import TrackingResult
from tumortrack.sense.camera import deproject_pixels

MOST_SEEN = 20_000  # points shown
_SAME_MM = 2.0  # points this near the ray are all under the pointer: the foremost is meant
_MISSED_MM = 10.0


def seen_points(update: TrackingResult) -> Float32[np.ndarray, "n 3"]:
    """Points that the frame shows, thinned while they are still pixels; camera frame."""
    assert update.seen is not None
    content = update.seen.content
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


def point_under(
    points_mm: Float[np.ndarray, "n 3"],
    origin_mm: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 3"] | None:
    """The point nearest a ray, all in one frame; of several under it the foremost. None if the
    nearest is more than 10 mm off, or behind the ray's origin."""
    offset = points_mm - origin_mm
    along = offset @ (direction / np.linalg.norm(direction))
    before = along > 0
    offset, along, points_mm = offset[before], along[before], points_mm[before]
    if not len(along):
        return None
    squared = np.maximum((offset**2).sum(1) - along**2, 0)
    if squared.min() > _MISSED_MM**2:
        return None
    under = squared <= max(_SAME_MM**2, float(squared.min()))
    return points_mm[np.flatnonzero(under)[np.argmin(along[under])]]
