"""Depth images of simple things, for the sensor's tests."""

from __future__ import annotations

import numpy as np

from tumortrack.core.camera import d405
from tumortrack.core.types import DepthFrame, Intrinsics

SMALL = d405(424, 240)


def pixels(camera: Intrinsics) -> list[np.ndarray]:
    return np.meshgrid(np.arange(camera.width), np.arange(camera.height))


def dome(camera: Intrinsics = SMALL, stamp_ns: int = 7) -> DepthFrame:
    """A smooth dome 120..145 mm away that ends inside the image."""
    u, v = pixels(camera)
    r2 = ((u - camera.cx) / camera.fx / 0.45) ** 2 + ((v - camera.cy) / camera.fy / 0.25) ** 2
    depth = np.where(r2 < 1, 145 - 25 * np.sqrt(np.clip(1 - r2, 0, 1)), np.nan)
    return DepthFrame(depth, camera, stamp_ns)


def wall(depth_mm: float, camera: Intrinsics = SMALL) -> DepthFrame:
    return DepthFrame(np.full((camera.height, camera.width), depth_mm), camera)
