"""Lay the organ's surface on the observed points: a few Gauss-Newton steps.

Unknown are a rigid motion and the coefficients of the body's modes. The most likely ones, given
points with errors and the library of states as a Gaussian prior, minimise

    n_effective / n * sum of rho(distance of a point, carried back to the CT, to the organ / sigma)
    + the squared Mahalanobis distance of the coefficients from the library's mean.

The distance is looked up in a field, so no nearest point is searched. The same curvature is the
estimate's uncertainty. Source: surface registration as maximum a posteriori with a statistical
shape prior, e.g. Heimann and Meinzer 2009 (doi 10.1016/j.media.2009.05.004); rho: Geman and
McClure 1987.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.core.config import Config
from tumortrack.registration.gauss_newton_kernels import descend
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape


class GaussNewtonConfig(Config, frozen=True):
    """``n_effective``: independent points that a cloud is worth: neighbours err alike.

    ``sigma_mm``: of a point that belongs to the organ, model errors included. ``first_mm`` and
    ``last_mm``: the distance where a point's pull is greatest falls from the one to the other;
    points far beyond do not count. ``shift_mm``, ``turn_rad``: how far the start may be off.
    """

    steps: int = 20
    n_effective: float = 300.0
    sigma_mm: float = 1.0
    first_mm: float = 5.0
    last_mm: float = 1.0
    narrowing: float = 0.7
    shift_mm: float = 20.0
    turn_rad: float = 0.5
    enough_mm: float = 0.02  # a step that moves less is the last


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """A motion, the squared error it minimises, and the distances left (signed, mm)."""

    motion: ElasticMotion
    cost: float
    distances_mm: Float[np.ndarray, " n"]
    steps: int


def refine(
    shape: RestShape,
    points_mm: Float[np.ndarray, "n 3"],
    start: ElasticMotion,
    config: GaussNewtonConfig,
) -> RegistrationResult:
    """The motion near ``start`` that fits points (camera frame, mm) and the library best."""
    descent = GaussNewton(shape, points_mm, start, config)
    descent.run(config.steps)
    return descent.refined()


class GaussNewton:
    """A refinement that can be stopped on its way and gone on with.

    Attributes:
        cost: of where it is, as ``RegistrationResult`` has it; infinite before the first step.
        steps: gone so far; ``settled``: more would not move it.
    """

    def __init__(
        self,
        shape: RestShape,
        points_mm: Float[np.ndarray, "n 3"],
        start: ElasticMotion,
        config: GaussNewtonConfig,
    ) -> None:
        body, field, count = shape.body, shape.distances[0], len(points_mm)
        self._shape, self._points = shape, np.ascontiguousarray(points_mm, np.float32)
        precision = _prior(shape, config)
        self._organ = (
            *(body.modes, body.origin_mm, np.float32(body.spacing_mm), body.center_ct),
            (field.values_mm, field.origin_mm, np.float32(field.spacing_mm)),
            *(precision, body.mean),
        )
        weight = min(config.n_effective / count, 1.0) / config.sigma_mm**2
        narrowing, enough = config.narrowing, config.enough_mm
        self._rules = weight, config.first_mm, config.last_mm, narrowing, enough
        given = start.rotation, start.centre_mm, start.coefficients
        # In C's order, whatever was given: the kernel is compiled for that.
        self._state = *(np.array(part, float, order="C") for part in given), np.zeros(6)
        gradient = np.empty(len(precision))
        self._left = np.empty(count, np.float32), np.empty_like(precision), gradient
        self.cost, self.steps, self.settled = np.inf, 0, False

    def run(self, steps: int) -> None:
        """Go on until ``steps`` are gone since the start, if it has not settled before."""
        if self.settled or (steps <= self.steps and np.isfinite(self.cost)):
            return
        whole = self._organ, self._points, self._rules, self._state, self._left
        self.steps, self.settled, self.cost = descend(*whole, self.steps, steps)

    def refined(self) -> RegistrationResult:
        """Where it is."""
        distances_mm, curvature, _ = self._left
        rotation, centre_mm, coefficients, _ = (part.copy() for part in self._state)
        covariance = np.linalg.inv(curvature)
        motion = ElasticMotion(self._shape, rotation, centre_mm, coefficients, covariance)
        return RegistrationResult(motion, self.cost, distances_mm.copy(), self.steps)


def _prior(shape: RestShape, config: GaussNewtonConfig) -> Float64[np.ndarray, "p p"]:
    modes = len(shape.body.mean)
    precision = np.zeros((6 + modes, 6 + modes))
    precision[:3, :3] = np.eye(3) / config.shift_mm**2
    precision[3:6, 3:6] = np.eye(3) / config.turn_rad**2
    precision[6:, 6:] = shape.body.precision
    return precision
