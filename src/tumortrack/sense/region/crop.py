"""What lies outside the depth range, the region of interest, the last estimate's surroundings."""

from __future__ import annotations

import numba
import numpy as np

from tumortrack.sense.region.picture import Picture


def keep_inside(picture: Picture, corners_mm: np.ndarray, step: int) -> None:
    """Take everything outside a box: two corners (2, 3), camera frame, mm, in any order."""
    low, high = np.sort(np.asarray(corners_mm, np.float64), axis=0)
    _keep_inside(picture.depth_mm, picture.taken, picture.pinhole, low, high, step)


def keep_range(picture: Picture, near_mm: float, far_mm: float, step: int) -> None:
    """Take everything that is not strictly between two depths."""
    low = np.array([-np.inf, -np.inf, near_mm])
    high = np.array([np.inf, np.inf, far_mm])
    _keep_inside(picture.depth_mm, picture.taken, picture.pinhole, low, high, step)


@numba.njit(cache=True, nogil=True)
def _keep_inside(depth_mm, taken, pinhole, low, high, step):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = pinhole
    height, width = depth_mm.shape
    for v in range(height):
        slope_y = (v - cy) / fy
        for u in range(width):
            if taken[v, u]:
                continue
            z = depth_mm[v, u]
            x, y = (u - cx) / fx * z, slope_y * z
            inside = low[2] < z < high[2] and low[1] < y < high[1] and low[0] < x < high[0]
            if not inside:
                taken[v, u] = step
