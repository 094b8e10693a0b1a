"""White noise, averaged away: a local surface at each pixel or point that is looked at.

A tissue's surface is nearly flat over a few millimetres, so neighbours tell a pixel's depth better
than its own noise. Depths that lie apart by more than noise and slope explain, across an edge or a
fold, do not take part (Tomasi and Manduchi 1998, doi 10.1109/ICCV.1998.710815). Of a cloud, points
with few neighbours are dropped first (Rusu et al. 2008, doi 10.1016/j.robot.2008.08.005).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from tumortrack.core.cloud import thin_cloud
from tumortrack.core.process import parallel_for
from tumortrack.core.types import DepthFrame, PointNoise, SensorCloud
from tumortrack.native import F32, I64, kernel
from tumortrack.segmentation.measured_noise import (
    CROWD,
    LONELY,
    TERMS,
    DepthNoise,
    cloud_noise,
    local_quadratics,
    scattered_share,
)

# Less noise than this is below what the fit's own ``sigma_mm`` contains, and flat patches of this
# radius leave 0.1 mm of a ball of 25 mm.
_LEFT_MM, _REACH_MM = 0.25, 3.0
_STEEPEST = 2.0  # slope up to which neighbours are of one surface
_AT_ONCE = 20  # rows
_FEW_SCATTERED = 0.12  # share of a cloud's points: up to 0.08 lie alone where it is seen aslant
_MOST_POINTS = 4000  # of a cloud that is cleaned
_SMOOTHED = 1000  # of these: as many as a fit takes
_NEIGHBOURS, _RADIUS_MM = (24, 120), 6.0  # a quadratic leaves 0.1 mm of a ball of 25 mm
_NOISY_MM = 0.4  # less the fit's ``sigma_mm`` contains, and averaging takes 5 ms of each frame

# Depths; rows and columns, which are some of theirs; reach, relative noise, slope; their depths.
smooth_depth = kernel(
    "smooth_depth",
    *(F32["height", "width"].any_value, I64["rows"], I64["columns"]),
    *(int, float, float, F32["rows", "columns"].out),
)


def window_px(frame: DepthFrame, noise: DepthNoise) -> int:
    """Half the side, px, of the window in which enough of the noise averages away; 0: none."""
    if noise.whole_mm <= _NOISY_MM:
        return 0
    most = max(1, round(_REACH_MM * frame.intrinsics.fx / noise.depth_mm))
    sides = range(most + 1)
    return next((n for n in sides if noise.mean_mm((2 * n + 1) ** 2) <= _LEFT_MM), most)


def smoothed(
    frame: DepthFrame, sampled: tuple[slice, slice], noise: DepthNoise, reach: int
) -> Float32[np.ndarray, "h w"]:
    """The depths of the ``sampled`` rows and columns, each by the plane through its neighbours
    within ``reach`` pixels."""
    depth_mm = np.ascontiguousarray(frame.depth_mm)
    rows, columns = (
        np.ascontiguousarray(np.arange(n)[s]) for n, s in zip(depth_mm.shape, sampled, strict=True)
    )
    out = np.empty((len(rows), len(columns)), np.float32)
    relative = noise.whole_mm / noise.depth_mm**2  # of disparities: it grows with the square
    slope = _STEEPEST / frame.intrinsics.fx
    parallel_for(
        lambda part: smooth_depth(depth_mm, rows[part], columns, reach, relative, slope, out[part]),
        len(rows),
        _AT_ONCE,
    )
    return out


def clean_cloud(cloud: SensorCloud) -> SensorCloud:
    """The cloud with its noise, as measured; without scattered points, if it has many; its white
    noise averaged away, if it is more than a camera near by has."""
    if cloud.noise is not None:
        return cloud
    if (share := scattered_share(cloud)) > _FEW_SCATTERED:
        cloud = _without_scattered(cloud, share)
    if (noise := cloud_noise(cloud)) is None:
        return cloud
    kept = noise.of_points(len(cloud.points_mm))
    if noise.white_mm > _NOISY_MM and not noise.bound:
        cloud, kept = _smoothed(cloud, noise)
    return replace(cloud, noise=kept)


def _without_scattered(cloud: SensorCloud, share: float) -> SensorCloud:
    from scipy.spatial import cKDTree

    points_mm = thin_cloud(cloud, _MOST_POINTS, np.random.default_rng(0)).points_mm
    for _ in range(2):  # a stray's neighbours may be outliers
        reach_mm = cKDTree(points_mm).query(points_mm, CROWD + 1)[0][:, -1]
        points_mm = points_mm[reach_mm < LONELY * np.quantile(reach_mm, 0.5 * (1 - share))]
    return replace(cloud, points_mm=points_mm)


def _smoothed(cloud: SensorCloud, noise: DepthNoise) -> tuple[SensorCloud, PointNoise]:
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    points_mm = thin_cloud(cloud, _MOST_POINTS, rng).points_mm.astype(float)
    tree, drawn = cKDTree(points_mm), points_mm[:_SMOOTHED]
    wanted = int(np.clip(TERMS / 2 * (noise.white_mm / _LEFT_MM) ** 2, *_NEIGHBOURS))
    distance_mm, near = tree.query(drawn, min(wanted, len(points_mm)))
    count = int(np.median((distance_mm < _RADIUS_MM).sum(1)))
    if count < 2 * TERMS:
        return cloud, noise.of_points(len(cloud.points_mm))
    off_mm, _ = local_quadratics(points_mm[near[:, :count]] - drawn[:, None])
    off_mm[distance_mm[:, count - 1] > 2 * _RADIUS_MM] = 0.0  # too sparse there
    white_mm = noise.white_mm * np.sqrt(TERMS / 2 / count)
    mean_mm = noise.white_mm / np.sqrt(len(points_mm))
    left = PointNoise(noise.white_mm, float(white_mm), float(mean_mm))
    return replace(cloud, points_mm=(drawn + off_mm).astype(np.float32)), left
