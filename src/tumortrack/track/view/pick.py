"""Which observed point a click means."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_SAME_MM = 2.0  # points this near the ray are all under the pointer: the foremost is meant
_MISSED_MM = 10.0


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
