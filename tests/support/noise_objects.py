"""A smooth organ before a table, and noise of known size on its image."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from tumortrack.core.types import DepthFrame, Intrinsics

RADII_MM = np.array([50.0, 30.0, 28.0])  # a kidney's, about


def seen(width: int, distance_mm: float, behind_mm: float = 40.0) -> DepthFrame:
    """An ellipsoid before a tilted plane."""
    camera = Intrinsics(width, width // 2, fx=width / 2, fy=width / 2, cx=width / 2, cy=width / 4)
    v, u = np.mgrid[: camera.height, :width]
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1
    )
    middle = np.array([0.0, 0.0, distance_mm + RADII_MM[2]])
    a, b, c = (np.sum(x * y / RADII_MM**2, -1) for x, y in ((rays, rays), (rays, middle),
                                                            (middle, middle)))  # fmt: skip
    inside = b * b - a * (c - 1)
    depth = np.where(
        inside > 0,
        (b - np.sqrt(np.maximum(inside, 0))) / a,
        distance_mm + behind_mm + 0.1 * (u - camera.cx) * distance_mm / camera.fx,
    )
    return DepthFrame(depth.astype(np.float32), camera)  # fmt: skip


def noisy(frame, white_mm, correlated_mm=0.0, length_px=1.0, step_mm=0.1, seed=0):
    rng = np.random.default_rng(seed)
    shape = frame.depth_mm.shape
    depth = frame.depth_mm + white_mm * rng.standard_normal(shape)
    if correlated_mm:  # 1/e at the length
        field = gaussian_filter(rng.standard_normal(shape), length_px / 2)
        depth += correlated_mm * field / field.std()
    if step_mm:
        depth = np.rint(depth / step_mm) * step_mm
    depth[rng.random(shape) < 0.002] = np.nan
    return frame.with_depth(depth.astype(np.float32))
