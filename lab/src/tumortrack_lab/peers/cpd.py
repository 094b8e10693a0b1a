"""Coherent point drift, non-rigid, from a rigid start (pycpd).

Myronenko, Song 2010, doi 10.1109/TPAMI.2010.46. The observed cloud is the data, the part of the
model's surface that the camera should see is the drifting set: drawing the whole organ onto one
side of it would fail at once. The displacement follows CPD's own Gaussian kernel into the depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.peers.base import Carry, Fit, stopwatch
from tumortrack_lab.peers.rigid import Pose, PoseSearch, RigidConfig
from tumortrack_lab.peers.surface import trimmed_mean

_KEPT = 0.9  # of the distances


class CpdConfig(Config, frozen=True):
    """Settings of CPD, lengths in mm.

    ``kernel_mm`` is the paper's beta, the distance over which points move together; ``smooth``
    its lambda, the weight of smoothness (of points scaled to a spread of 1, as the paper scales
    them); ``outliers`` its w. ``first_sigma_mm`` starts the
    annealing at the error that a rigid pose leaves, instead of at the size of the cloud.
    """

    rigid: RigidConfig = RigidConfig()
    starts: int = 2  # the best rigid poses, each fitted
    kernel_mm: float = 50.0
    smooth: float = 1000.0
    outliers: float = 0.1
    first_sigma_mm: float = 6.0
    iterations: int = 60
    points: int = 400  # of the visible surface


@dataclass(frozen=True, eq=False)
class Drift:
    """Displacements that drift coherently: v(z) = sum over n of G(z, y_n) w_n, camera frame."""

    points_mm: Float64[np.ndarray, "n 3"]
    weights: Float64[np.ndarray, "n 3"]
    kernel_mm: float

    def __call__(self, at_mm: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3"]:
        """The displaced points."""
        from scipy.spatial.distance import cdist

        kernel = np.exp(-cdist(at_mm, self.points_mm, "sqeuclidean") / (2 * self.kernel_mm**2))
        return at_mm + kernel @ self.weights


class Cpd:
    """Coherent point drift as a peer."""

    name = "cpd"

    def __init__(
        self,
        anatomy_ct: Anatomy,
        up_lps: tuple[float, float, float],
        config: CpdConfig | None = None,
    ) -> None:
        self.config = config or CpdConfig()
        with stopwatch() as watch:
            self._search = PoseSearch(anatomy_ct, up_lps, self.config.rigid)
        self.prepare_s = watch.seconds

    def fit(self, scene: Scene) -> Fit:
        """The drift, from the best rigid poses, that leaves the cloud nearest the surface.

        Raises:
            NoEstimate: fewer than 20 points.
        """
        cloud = scene.cloud.points_mm.astype(float)
        with stopwatch() as watch:
            poses = self._search.poses(scene.cloud)[: self.config.starts]
            fits = [self._drift(pose, cloud) for pose in poses]
            errors = [mutual_error_mm(drift(drift.points_mm), cloud) for drift, _ in fits]
            best = int(np.argmin(errors))
        drift, iterations = fits[best]
        report = {
            "start": poses[best].start,
            "iterations": iterations,
            "residual_mm": errors[best],
        }
        return Fit(drifting_carry(poses[best], drift), watch.seconds, report)

    def _drift(self, pose: Pose, cloud: Float64[np.ndarray, "n 3"]) -> tuple[Drift, int]:
        from pycpd import DeformableRegistration

        config = self.config
        source = self._search.seen(cloud, pose.camera_from_ct)
        source = source[:: max(1, len(source) // config.points)]
        registration = DeformableRegistration(
            X=cloud,
            Y=source,
            sigma2=config.first_sigma_mm**2,
            alpha=config.smooth / ((cloud - cloud.mean(0)) ** 2).mean(),
            beta=config.kernel_mm,
            w=config.outliers,
            max_iterations=config.iterations,
        )
        registration.register()
        return Drift(source, registration.W, config.kernel_mm), int(registration.iteration)


def drifting_carry(pose: Pose, drift: Drift) -> Carry:
    """Pose first, then drift."""
    return lambda points_ct: drift(transform_points(pose.camera_from_ct, points_ct))


def mutual_error_mm(moved: Float64[np.ndarray, "m 3"], cloud: Float64[np.ndarray, "n 3"]) -> float:
    """Trimmed mean distance of the drifted surface to the cloud and back: it compares starts."""
    out, back = cKDTree(moved).query(cloud)[0], cKDTree(cloud).query(moved)[0]
    return (trimmed_mean(out, _KEPT) + trimmed_mean(back, _KEPT)) / 2
