"""What the points leave uncertain once a motion is fitted to them, and the size that they show."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.core.report import SizeFit
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion

_LEAST_KNOWN = 1.0  # of a size: nothing, where rounding leaves less
_LESS = 0.05  # share of the prior's weight: first order, and no float32 noise


def held_by_prior_mm(motion: ElasticMotion, prior_slope: Float64[np.ndarray, " p"]) -> list[float]:
    """How far the prior, against the points, holds the middle of each part: to first order, how far
    each moves per share of the prior's weight taken away. ``prior_slope``: see ``BentFit``."""
    assert motion.covariance is not None
    middles_ct = motion.shape.middles_ct
    freer = motion.changed(_LESS * motion.covariance @ prior_slope)
    away_mm = freer.carry(middles_ct) - motion.carry(middles_ct)
    return (np.linalg.norm(away_mm, axis=1) / _LESS).tolist()


def apparent_size(motion: ElasticMotion, looks: Looks, config: GaussNewtonConfig) -> SizeFit:
    """How large the points show the organ, times its true size, and how much less it would cost to
    fit them scaled about their cameras by that; to second order, as in Rao's score test."""
    assert motion.covariance is not None
    near = looks.residuals(motion, config)
    # To the surface, not to the points: their noise would make the organ larger.
    by_scale = -(near.by_motion[:, :3] * (looks.rays_mm @ motion.rotation)).sum(1)
    by_scale -= near.distances_mm
    weighted = by_scale * near.weights
    cross = near.by_motion.T @ weighted
    slope = weighted @ near.distances_mm
    curvature = weighted @ by_scale - cross @ motion.covariance @ cross
    precision, across = near.cameras_precision(motion.covariance)
    cross = near.by_cameras.T @ weighted - across.T @ motion.covariance @ cross
    curvature -= cross @ np.linalg.solve(precision, cross)  # what the cameras' errors take up
    curvature = max(curvature, _LEAST_KNOWN)
    times, gain = float(1 + slope / curvature), float(slope**2 / curvature)
    return SizeFit(times=times, gain=gain, std=float(curvature**-0.5))
