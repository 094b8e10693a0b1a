"""Lay the organ's surface on the observed points: a few Gauss-Newton steps.

Unknown are a rigid motion and the coefficients of the body's modes. The most likely ones, given
points with errors and the library of states as a Gaussian prior, minimise

    (last_mm / sigma_mm)^2 * min(n_effective / n, 1) * sum of rho(d / last_mm)
    + the squared Mahalanobis distance of pose and coefficients from the prior's mean,

d being the distance (mm) of a point, carried back to the CT, to the organ's surface, and rho a
robust kernel: (d / sigma_mm)^2 for small d.

The distance is looked up in a field, so no nearest point is searched. The same curvature is the
estimate's uncertainty. Source: surface registration as maximum a posteriori with a statistical
shape prior, e.g. Heimann and Meinzer 2009 (doi 10.1016/j.media.2009.05.004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.geometry import Points
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.registration import gauss_newton_kernels as kernels
from tumortrack.registration.discrepancy import FARTHEST, fit_discrepancy
from tumortrack.registration.kernels import POSE
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape
from tumortrack.sense.noise import CAMERA_STD
from tumortrack.simulate.elastic.flow import LatticeField


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """A motion, its cost (robust data term and prior), and the residuals (signed distances, mm).
    ``strays``: share of the points that lie farther off than ``discrepancy.FARTHEST`` widths;
    ``cost_without_strays``: if all lay as the others do. ``moved``: shift (mm) and turn (rad) from
    where the prior has the pose. ``rivals``: other minima that explain the points nearly as well;
    ``beyond``: one that explains them better, in a pose that is excluded (see
    ``registration.Registration.likeliest``)."""

    motion: ElasticMotion
    cost: float
    strays: float
    cost_without_strays: float
    distances_mm: Float[np.ndarray, " n"]
    steps: int
    moved: Float64[np.ndarray, " 6"]
    rivals: tuple[RegistrationResult, ...] = ()
    beyond: RegistrationResult | None = None

    @property
    def others(self) -> tuple[RegistrationResult, ...]:
        """Rivals, and what lies beyond."""
        return self.rivals if self.beyond is None else (*self.rivals, self.beyond)


def refine(
    rest: RestShape, points_mm: Points, start: ElasticMotion, config: GaussNewtonConfig
) -> RegistrationResult:
    """The motion near ``start`` that fits points (camera frame, mm) and the library best."""
    descent = GaussNewton(rest, points_mm, start, config)
    descent.run(config.steps)
    return descent.result()


class GaussNewton:
    """A refinement that can be stopped on its way and continued. ``cost``: of the present state, as
    in ``RegistrationResult``; infinite before the first step. ``steps``: taken so far;
    ``converged``: more would not move it. ``moved``: the start's, as in ``RegistrationResult``;
    None: the prior has the pose where it starts."""

    def __init__(
        self,
        rest: RestShape,
        points_mm: Points,
        start: ElasticMotion,
        config: GaussNewtonConfig,
        moved: Float64[np.ndarray, " 6"] | None = None,
    ) -> None:
        body, count, precision = rest.body, len(points_mm), _prior(rest, config)
        self._rest = rest
        # Copies in C's order, and floats, whatever was given: the kernel is compiled for that, and
        # would be once more for points that can't be written, or a whole number.
        self._problem = kernels.Problem(
            modes=LatticeField(body.modes, body.origin_mm, np.float32(body.spacing_mm)),
            center_ct=body.center_ct,
            distances=rest.distances[0],
            precision=precision,
            mean=body.mean,
            points=np.array(points_mm, np.float32, order="C"),
            weight=min(config.n_effective / count, 1.0) / config.sigma_mm**2,
            first_mm=float(config.first_mm),
            last_mm=float(config.last_mm),
            narrowing=float(config.narrowing),
            enough_mm=float(config.enough_mm),
        )
        given = start.rotation, start.centre_mm, start.coefficients
        rotation, centre_mm, coefficients = (np.array(part, float, order="C") for part in given)
        left = np.empty(count, np.float32), np.empty_like(precision), np.empty(len(precision))
        already = np.zeros(6) if moved is None else np.array(moved, float)
        self._state = kernels.State(rotation, centre_mm, coefficients, already, *left)
        self.cost, self.steps, self.converged = np.inf, 0, False

    def run(self, steps: int) -> None:
        """Continue until ``steps`` are taken since the start, or it has converged."""
        if self.converged or (steps <= self.steps and np.isfinite(self.cost)):
            return
        reached = kernels.descend(self._problem, self._state, self.steps, steps)
        self.steps, self.converged, self.cost = reached

    def result(self) -> RegistrationResult:
        """The present state."""
        state = kernels.State._make(part.copy() for part in self._state)
        covariance = np.linalg.inv(state.curvature)
        placed = state.rotation, state.centre_mm, state.coefficients
        motion = ElasticMotion(self._rest, *placed, covariance)
        squares = (state.distances_mm / self._problem.last_mm) ** 2
        far = squares > FARTHEST**2
        of_strays = (squares / (1 + squares))[far].sum()
        of_strays *= self._problem.weight * self._problem.last_mm**2
        strays = float(far.mean())
        without = float(self.cost - of_strays) / max(1 - strays, 1 / len(far))
        judged = self.cost, strays, without
        return RegistrationResult(motion, *judged, state.distances_mm, self.steps, state.moved)


def size_of(
    fit: RegistrationResult, looks: Looks, config: GaussNewtonConfig
) -> tuple[float, float]:
    """How large the points show the organ, times its true size, and how much less it would cost to
    fit them scaled about their cameras by that; to second order, as in Rao's score test."""
    motion = fit.motion
    assert motion.covariance is not None
    rows = motion.residual_rows(looks.points_mm).astype(float)
    slopes, distances = rows[:, :-1], rows[:, -1]
    outwards = -(slopes[:, :3] * (looks.rays_mm @ motion.rotation)).sum(1)  # of scaling the points
    weights = looks.weights(distances, config)
    weighed = outwards * weights
    cross = slopes.T @ weighed
    slope, curvature = weighed @ distances, weighed @ outwards - cross @ motion.covariance @ cross
    known, across = looks.precision(slopes, weights, motion.covariance)
    cross = looks.unknown(slopes).T @ weighed - across.T @ motion.covariance @ cross
    curvature -= cross @ np.linalg.solve(known, cross)  # taken up by the cameras' errors
    return float(1 + slope / curvature), float(slope**2 / curvature)


def posterior(motion: ElasticMotion, looks: Looks, config: GaussNewtonConfig) -> ElasticMotion:
    """A fitted motion with what its residuals leave unsure: see ``discrepancy``."""
    body, unknowns = motion.shape.body, POSE + len(motion.coefficients)
    from_mean = np.zeros(POSE), motion.coefficients - body.mean, looks.shifts[1:].ravel()
    pose_std = np.repeat([config.shift_mm, config.turn_rad], 3)
    cameras = np.tile(CAMERA_STD**2, looks.count - 1)
    prior = np.diag(np.concatenate([pose_std**2, np.zeros(len(body.mean)), cameras]))
    prior[POSE:unknowns, POSE:unknowns] = body.covariance
    rows = motion.residual_rows(looks.points_mm)
    slopes, distances = rows[:, :-1], rows[:, -1:]
    rows = np.concatenate([slopes, looks.unknown(slopes), distances], axis=1)
    rest_ct = motion.back(looks.points_mm)
    covariance, process = fit_discrepancy(
        rows, rest_ct, prior, -np.concatenate(from_mean), config.last_mm
    )
    process = replace(process, cross=process.cross[:unknowns])
    return replace(motion, covariance=covariance[:unknowns, :unknowns], discrepancy=process)


def _prior(rest: RestShape, config: GaussNewtonConfig) -> Float64[np.ndarray, "p p"]:
    """The precision of shift, turn and coefficients."""
    pose = [1 / config.shift_mm**2] * 3 + [1 / config.turn_rad**2] * 3
    precision = np.diag(pose + [0.0] * len(rest.body.mean))
    precision[6:, 6:] = rest.body.precision
    return precision
