"""Points of a still organ from one or several cameras: where these are, and what their errors do.

A camera's place relative to the first is known by a calibration, which errs. So each further camera
has six unknowns of its own, with that error as their prior. They are found in turns with the
organ's motion, and what remains uncertain widens the motion's covariance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from tumortrack.core.geometry import Affine, Points, rigid, transform_points
from tumortrack.core.report import SizeFit, ViewsReport
from tumortrack.core.types import DepthError, PointNoise
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import EvidenceTerms
from tumortrack.registration.motion import POSE, ElasticMotion
from tumortrack.simulation.noise import CAMERA_STD

_CONTAINED_MM = 0.4  # of noise, in ``GaussNewtonConfig.sigma_mm``: a D405's at 150 mm, doubled
_FACING = 0.15  # cosine to the line of sight: what is steeper is not told from what it stands on
_WIDTHS = 2.5  # standard deviations of noise: the robust kernel then loses 5 % of its efficiency
_ACROSS = 0.85  # of noise along the line of sight, across a surface that is seen at 0 to 60 degrees
_NODES, _SHARES = np.polynomial.hermite_e.hermegauss(8)  # of a normal distribution
_SHARES = _SHARES / _SHARES.sum()
_LEAST_KNOWN = 1.0  # of a size: nothing, where rounding leaves less
# Of a camera of which nothing is stated: mostly as its maker calibrates it (a D405's data sheets
# say 1.4 % and 2 %), else as the one D405 that others measured (-1.3 % and -5 mm). Shares assumed.
_UNSTATED = (0.8, DepthError(2.0, 0.01)), (0.2, DepthError(5.0, 0.02))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Points at a motion: signed distances to the organ's surface, and what shifts them.

    Attributes:
        distances_mm: of the points, carried back, to the surface at rest.
        by_motion: their derivatives by shift, turn and coefficients.
        by_cameras: by the errors of the further cameras, six each.
        weights: of their squares in the cost, with the robust kernel's.
    """

    distances_mm: Float64[np.ndarray, " n"]
    by_motion: Float64[np.ndarray, "n p"]
    by_cameras: Float64[np.ndarray, "n q"]
    weights: Float64[np.ndarray, " n"]

    def cameras_precision(
        self, covariance: Float64[np.ndarray, "p p"]
    ) -> tuple[Float64[np.ndarray, "q q"], Float64[np.ndarray, "p q"]]:
        """Of the cameras' errors, if the organ's motion, which has this covariance where they are
        known, follows them (Schur complement); and the curvature's block of motion and errors."""
        weighted = self.weights[:, None] * self.by_cameras
        across = self.by_motion.T @ weighted
        prior = np.tile(CAMERA_STD**-2, weighted.shape[1] // POSE)
        own = self.by_cameras.T @ weighted + np.diag(prior)
        return own - across.T @ covariance @ across, across


@dataclass(frozen=True, eq=False)
class MultiViewCloud:
    """Points of the organ in the first camera's frame, mm.

    Attributes:
        points_mm: of all views, one after the other; ``view``: the number of each point's.
        camera_from_view: where each view's camera is, the first one's being the identity.
        shifts: by how much the organ was found to lie elsewhere before each camera (mm, rad; its
            axes, about its centre): the camera's error, which points and places are rid of.
        evidence: what is known beside the points.
        noise: of the points; where views differ, that of the worst.
        candidates_mm: points of a single view that may be the organ's too.
        depth_error: of the cameras, of the worst; None: of one of them nobody has stated it.
    """

    points_mm: Points
    view: Int64[np.ndarray, " n"]
    camera_from_view: tuple[Affine, ...]
    shifts: Float64[np.ndarray, "k 6"]
    evidence: EvidenceTerms | None = None
    noise: PointNoise = PointNoise()  # noqa: RUF009 (an immutable tuple)
    candidates_mm: Float[np.ndarray, "c 3"] | None = None
    depth_error: DepthError | None = None

    @classmethod
    def from_points(
        cls,
        points_mm: Sequence[Float[np.ndarray, "_ 3"]],
        camera_from_view: Sequence[Affine] = (),
        evidence: EvidenceTerms | None = None,
        noises: Iterable[PointNoise] = (),
        candidates_mm: Float[np.ndarray, "c 3"] | None = None,
        depth_error: DepthError | None = None,
    ) -> MultiViewCloud:
        """Points of each view in its own camera's frame; further ones with where it is."""
        moved = [*points_mm[:1], *map(_moved, camera_from_view, points_mm[1:])]
        numbers = np.repeat(np.arange(len(moved)), [len(points) for points in moved])
        together = moved[0] if len(moved) == 1 else np.concatenate(moved)
        poses, shifts = (np.eye(4), *camera_from_view), np.zeros((len(moved), POSE))
        worst = [max(values) for values in zip(*noises, strict=True)]
        noise = PointNoise(*worst) if worst else PointNoise()
        return cls(together, numbers, poses, shifts, evidence, noise, candidates_mm, depth_error)

    @property
    def count(self) -> int:
        return len(self.camera_from_view)

    @property
    def cost(self) -> float:
        """Of the cameras' errors: their squared Mahalanobis distance."""
        return float(((self.shifts / CAMERA_STD) ** 2).sum())

    def described(self) -> ViewsReport:
        """For a report: where the cameras were found, and how far from where they were said to be,
        as the organ's centre shows it."""
        return ViewsReport(
            camera_from_view=tuple(pose.tolist() for pose in self.camera_from_view),
            shift_mm=np.linalg.norm(self.shifts[:, :3], axis=1).tolist(),
            turn_degrees=np.rad2deg(np.linalg.norm(self.shifts[:, 3:], axis=1)).tolist(),
        )

    def with_points_on(self, motion: ElasticMotion, within_mm: float) -> MultiViewCloud:
        """With those candidates that lie near the organ's surface where it faces the camera."""
        if self.candidates_mm is None or not len(self.candidates_mm):
            return self
        on = self.candidates_mm[lies_on(motion, self.candidates_mm, within_mm)]
        numbers = np.append(self.view, np.zeros(len(on), int))
        return replace(self, points_mm=np.concatenate([self.points_mm, on]), view=numbers)

    def weight(self, config: GaussNewtonConfig) -> float:
        """Of a point's squared distance in the cost. Each view tells as much as a single one."""
        points = len(self.points_mm) / self.count
        model_mm2 = config.sigma_mm**2 / min(config.n_effective, points)
        return 1 / (points * (model_mm2 + self.noise.mean_mm**2))

    def width_mm(self, config: GaussNewtonConfig) -> float:
        """Of the robust kernel in the last steps."""
        return kernel_width_mm(config, self.noise)

    def noise_cost(self, config: GaussNewtonConfig) -> float:
        """What the points' noise adds to the cost of a right fit."""
        squares = (_ACROSS * _more_mm(self.noise) * _NODES) ** 2
        robust_mm2 = squares / (1 + squares / self.width_mm(config) ** 2)
        return float(len(self.points_mm) * self.weight(config) * (_SHARES @ robust_mm2))

    def residuals(self, motion: ElasticMotion, config: GaussNewtonConfig) -> Residuals:
        """At a motion. A camera's error does what the organ's motion before it alone would do."""
        rows = motion.residual_rows(self.points_mm).astype(float)
        by_motion, distances_mm = rows[:, :-1], rows[:, -1]
        each = [by_motion[:, :POSE] * (self.view == n)[:, None] for n in range(1, self.count)]
        by_cameras = np.concatenate([by_motion[:, :0], *each], axis=1)
        weights = self.weight(config) / (1 + (distances_mm / self.width_mm(config)) ** 2) ** 2
        return Residuals(distances_mm, by_motion, by_cameras, weights)

    def apparent_size(self, motion: ElasticMotion, config: GaussNewtonConfig) -> SizeFit:
        """How large the points show the organ, times its true size, and how much less it would cost
        to fit them scaled about their cameras by that; to second order, as in Rao's score test."""
        assert motion.covariance is not None
        near = self.residuals(motion, config)
        origins = np.array([pose[:3, 3] for pose in self.camera_from_view], np.float32)
        rays_mm = self.points_mm - origins[self.view]  # from each point's camera
        # To the surface, not to the points: their noise would make the organ larger.
        by_scale = -(near.by_motion[:, :3] * (rays_mm @ motion.rotation)).sum(1)
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

    def corrected(self, motion: ElasticMotion, config: GaussNewtonConfig) -> MultiViewCloud:
        """The further cameras, and their points, moved by a Gauss-Newton step of all unknowns from
        where the organ's ``motion`` fits the points best."""
        assert motion.covariance is not None
        near, further = self.residuals(motion, config), self.shifts[1:]
        gradient = near.by_cameras.T @ (near.weights * near.distances_mm)
        gradient += (further / CAMERA_STD**2).ravel()
        precision, _ = near.cameras_precision(motion.covariance)
        changes = -np.linalg.solve(precision, gradient).reshape(further.shape)
        points_mm, poses = self.points_mm.copy(), list(self.camera_from_view)
        for n, change in enumerate(changes, start=1):
            # As if the organ moved before this camera alone: then the points move back by it.
            moved = motion.changed(np.append(change, np.zeros(len(motion.coefficients))))
            turn = motion.rotation @ moved.rotation.T
            back = rigid(turn, motion.centre_mm - turn @ moved.centre_mm)
            mine = self.view == n
            points_mm[mine], poses[n] = _moved(back, points_mm[mine]), back @ poses[n]
        shifts = self.shifts + np.concatenate([np.zeros((1, POSE)), changes])
        return replace(self, points_mm=points_mm, camera_from_view=tuple(poses), shifts=shifts)


def depth_share(size: SizeFit, depth_mm: float, stated: DepthError | None) -> float:
    """Root mean square error of a camera's depths, all alike, as a share of them: the posterior's,
    by the apparent size, about the depths as measured.

    No fit sees such an error but by the organ's size: what is seen too near looks too small. Places
    are left as they were measured. ``depth_mm``: of the organ.
    """
    known = _UNSTATED if stated is None else ((1.0, stated),)
    chances, off = np.array([chance for chance, _ in known]), size.times - 1
    prior = np.array([error.share(depth_mm) for _, error in known]) ** 2
    both = prior + size.std**2
    share = prior / both
    logs = np.log(chances / np.sqrt(both)) - off**2 / both / 2
    weights = np.exp(logs - logs.max())  # one of them is 1, however far off the size is
    return float(np.sqrt(np.average((share * off) ** 2 + share * size.std**2, weights=weights)))


def kernel_width_mm(config: GaussNewtonConfig, noise: PointNoise) -> float:
    """Of the robust kernel in the last steps: so wide that noise makes no outliers."""
    return float(np.hypot(config.last_mm, _WIDTHS * _more_mm(noise)))


def _more_mm(noise: PointNoise) -> float:
    """Of a point, beyond what ``GaussNewtonConfig.sigma_mm`` contains."""
    return float(np.sqrt(max(noise.point_mm**2 - _CONTAINED_MM**2, 0.0)))


def lies_on(
    motion: ElasticMotion, points_mm: Float[np.ndarray, "n 3"], within_mm: float
) -> Bool[np.ndarray, " n"]:
    """Which points lie near the organ's surface where it faces the camera."""
    rows = motion.residual_rows(points_mm)
    towards = (rows[:, :3] * (points_mm @ motion.rotation)).sum(1)
    facing = towards > _FACING * np.linalg.norm(points_mm, axis=1)
    return np.asarray(facing & (np.abs(rows[:, -1]) < within_mm))


def _moved(pose: Affine, points: Points) -> Points:
    return transform_points(pose, points).astype(np.float32)
