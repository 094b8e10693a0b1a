"""What one or several cameras see of a still organ, laid together.

A camera's place relative to the first is known by a calibration, which errs. So each further one
has six unknowns of its own, with that error as their prior. They are found in turns with the
organ's motion, and what is left unsure widens the motion's covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from jaxtyping import Float, Float64, Int64

from tumortrack.core.geometry import Affine, Points, rigid, transform_points, turned_by
from tumortrack.core.report import LooksReport
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.registration.kernels import POSE
from tumortrack.registration.motion import ElasticMotion
from tumortrack.sense.noise import CAMERA_STD


@dataclass(frozen=True, eq=False)
class Looks:
    """Points of the organ in the first camera's frame, mm.

    Attributes:
        points_mm: of all looks, one after the other; ``look``: the number of each point's.
        camera_from_look: where each look's camera is, the first one's being the identity.
        shifts: by how much the organ was found to lie elsewhere before each camera (mm, rad; its
            axes, about its centre): the camera's error, of which points and places are freed.
    """

    points_mm: Points
    look: Int64[np.ndarray, " n"]
    camera_from_look: tuple[Affine, ...]
    shifts: Float64[np.ndarray, "k 6"]

    @classmethod
    def of(
        cls, points_mm: Sequence[Float[np.ndarray, "_ 3"]], camera_from_look: Sequence[Affine] = ()
    ) -> Looks:
        """Points of each look in its own camera's frame; further ones with where it is."""
        moved = [*points_mm[:1], *map(_moved, camera_from_look, points_mm[1:])]
        numbers = np.repeat(np.arange(len(moved)), [len(points) for points in moved])
        every = moved[0] if len(moved) == 1 else np.concatenate(moved)
        return cls(every, numbers, (np.eye(4), *camera_from_look), np.zeros((len(moved), POSE)))

    @property
    def count(self) -> int:
        """Of looks."""
        return len(self.camera_from_look)

    @property
    def rays_mm(self) -> Points:
        """From each point's camera to it."""
        origins = np.array([pose[:3, 3] for pose in self.camera_from_look], np.float32)
        return self.points_mm - origins[self.look]

    @property
    def cost(self) -> float:
        """Of the cameras' errors: their squared Mahalanobis distance."""
        return float(((self.shifts / CAMERA_STD) ** 2).sum())

    def described(self) -> LooksReport:
        """For a report: where the cameras were found, and how far from where they were said to be,
        as the organ's centre shows it."""
        return LooksReport(
            camera_from_look=tuple(pose.tolist() for pose in self.camera_from_look),
            shift_mm=np.linalg.norm(self.shifts[:, :3], axis=1).tolist(),
            turn_degrees=np.rad2deg(np.linalg.norm(self.shifts[:, 3:], axis=1)).tolist(),
        )

    def weighed(self, config: GaussNewtonConfig) -> GaussNewtonConfig:
        """As much is known of the organ by each look as by one."""
        return msgspec.structs.replace(config, n_effective=self.count * config.n_effective)

    def unknown(self, rows: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n q"]:
        """What the organ's motion before one further camera alone does to distances, which is what
        that camera's error does: the pose's columns, first in ``rows``, for its points."""
        flat = [rows[:, :POSE] * (self.look == n)[:, None] for n in range(1, self.count)]
        return np.concatenate([rows[:, :0], *flat], axis=1)

    def weights(
        self, distances_mm: Float64[np.ndarray, " n"], config: GaussNewtonConfig
    ) -> Float64[np.ndarray, " n"]:
        """Of the points' squared distances, in all looks' cost."""
        each = min(self.weighed(config).n_effective / len(distances_mm), 1.0) / config.sigma_mm**2
        return each / (1 + (distances_mm / config.last_mm) ** 2) ** 2

    def precision(
        self,
        slopes: Float64[np.ndarray, "n p"],
        weights: Float64[np.ndarray, " n"],
        covariance: Float64[np.ndarray, "p p"],
    ) -> tuple[Float64[np.ndarray, "q q"], Float64[np.ndarray, "p q"]]:
        """Of the further cameras' errors, if the organ's motion, which has this covariance where
        they are known, follows them; and the curvature's block of that motion and these errors."""
        mine = self.unknown(slopes)
        weighed = weights[:, None] * mine
        across, prior = slopes.T @ weighed, np.tile(CAMERA_STD**-2, self.count - 1)
        return mine.T @ weighed + np.diag(prior) - across.T @ covariance @ across, across

    def corrected(self, motion: ElasticMotion, config: GaussNewtonConfig) -> Looks:
        """The further cameras, and their points, moved by a Gauss-Newton step of all unknowns from
        where the organ's ``motion`` fits the points best."""
        assert motion.covariance is not None
        rows = motion.residual_rows(self.points_mm).astype(float)
        slopes, distances_mm = rows[:, :-1], rows[:, -1]
        weights, further = self.weights(distances_mm, config), self.shifts[1:]
        gradient = self.unknown(slopes).T @ (weights * distances_mm)
        gradient += (further / CAMERA_STD**2).ravel()
        known = self.precision(slopes, weights, motion.covariance)[0]
        changes = -np.linalg.solve(known, gradient).reshape(further.shape)
        points_mm, poses = self.points_mm.copy(), list(self.camera_from_look)
        for n, change in enumerate(changes, start=1):
            # As if the organ moved before this camera alone: then the points move back by it.
            turned = motion.rotation @ turned_by(change[3:])
            centre_mm = motion.centre_mm + motion.rotation @ change[:3]
            turn = motion.rotation @ turned.T
            back = rigid(turn, motion.centre_mm - turn @ centre_mm)
            mine = self.look == n
            points_mm[mine], poses[n] = _moved(back, points_mm[mine]), back @ poses[n]
        shifts = self.shifts + np.concatenate([np.zeros((1, POSE)), changes])
        return Looks(points_mm, self.look, tuple(poses), shifts)


def seen_from_first(motion: ElasticMotion, camera_from_look: Affine) -> ElasticMotion:
    """A motion before another camera, as the first one sees it."""
    turn = camera_from_look[:3, :3]
    centre_mm = turn @ motion.centre_mm + camera_from_look[:3, 3]
    rivals = tuple((seen_from_first(one, camera_from_look), share) for one, share in motion.rivals)
    return replace(motion, rotation=turn @ motion.rotation, centre_mm=centre_mm, rivals=rivals)


def _moved(pose: Affine, points: Points) -> Points:
    return transform_points(pose, points).astype(np.float32)
