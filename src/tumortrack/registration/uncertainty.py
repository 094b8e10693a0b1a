"""What the points leave uncertain once a motion is fitted to them: see also ``discrepancy``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.discrepancy import fit_discrepancy
from tumortrack.registration.kernels import POSE
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion
from tumortrack.sense.noise import CAMERA_STD


def posterior(motion: ElasticMotion, looks: Looks, config: GaussNewtonConfig) -> ElasticMotion:
    """A fitted motion with the covariance and the discrepancy that its residuals give it."""
    body, unknowns = motion.shape.body, POSE + len(motion.coefficients)
    from_mean = np.zeros(POSE), motion.coefficients - body.mean, looks.shifts[1:].ravel()
    pose_std = np.repeat([config.shift_mm, config.turn_rad], 3)
    cameras = np.tile(CAMERA_STD**2, looks.count - 1)
    prior = np.diag(np.concatenate([pose_std**2, np.zeros(len(body.mean)), cameras]))
    prior[POSE:unknowns, POSE:unknowns] = body.covariance
    near = looks.residuals(motion, config)
    covariance, process = fit_discrepancy(
        np.column_stack([near.by_motion, near.by_cameras, near.distances_mm]),
        motion.back(looks.points_mm),
        prior,
        -np.concatenate(from_mean),
        config.last_mm,
    )
    process = replace(process, cross=process.cross[:unknowns])
    return replace(motion, covariance=covariance[:unknowns, :unknowns], discrepancy=process)


def apparent_size(
    motion: ElasticMotion, looks: Looks, config: GaussNewtonConfig
) -> tuple[float, float]:
    """How large the points show the organ, times its true size, and how much less it would cost to
    fit them scaled about their cameras by that; to second order, as in Rao's score test."""
    assert motion.covariance is not None
    near = looks.residuals(motion, config)
    by_scale = -(near.by_motion[:, :3] * (looks.rays_mm @ motion.rotation)).sum(1)
    weighted = by_scale * near.weights
    cross = near.by_motion.T @ weighted
    slope = weighted @ near.distances_mm
    curvature = weighted @ by_scale - cross @ motion.covariance @ cross
    precision, across = near.cameras_precision(motion.covariance)
    cross = near.by_cameras.T @ weighted - across.T @ motion.covariance @ cross
    curvature -= cross @ np.linalg.solve(precision, cross)  # what the cameras' errors take up
    return float(1 + slope / curvature), float(slope**2 / curvature)
