"""Fit the organ's surface to the observed points: a few Gauss-Newton steps.

Unknown are a rigid motion and the coefficients of the body's modes. The most likely ones, given
points with errors and the library of states as a Gaussian prior, minimise

    (last_mm / sigma_mm)^2 * min(n_effective / n, 1) * sum of rho(d / last_mm)
    + the squared Mahalanobis distance of pose and coefficients from the prior's mean,

d being the distance (mm) of a point, carried back to the CT, to the organ's surface, and rho a
robust kernel: (d / sigma_mm)^2 for small d.

The distance is looked up in a field, so no nearest point is searched; all steps are one call of C
(``native/fast/gauss_newton.c``). The same curvature is the estimate's uncertainty. Source: surface
registration as maximum a posteriori with a statistical shape prior, e.g. Heimann and Meinzer 2009
(doi 10.1016/j.media.2009.05.004).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from tumortrack.native import F32, F64, kernel
from tumortrack.organ.flow import BLOCK, MODES, VELOCITY, LatticeField
from tumortrack.organ.rest_shape import DISTANCES, DistanceField, RestShape
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import EvidenceTerms, Terms
from tumortrack.registration.motion import POSE, ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud

FARTHEST = 2.0  # widths of the robust kernel: what lies beyond weighs less than 1/25
_STRIDE = 256 + 16  # of the columns in native/fast/gauss_newton.c


class _Problem(NamedTuple):
    """The organ at rest and the prior of its motion (CT frame, mm), the observed points (camera
    frame, mm), and of ``GaussNewtonConfig``; ``weight`` of one point's squared distance."""

    modes: LatticeField
    center_ct: np.ndarray  # (3,), float64
    distances: DistanceField
    precision: np.ndarray  # (p, p), float64
    mean: np.ndarray  # (m,), float64
    points: np.ndarray  # (n, 3), float32
    weight: float
    first_mm: float
    last_mm: float
    narrowing: float
    enough_mm: float


class _State(NamedTuple):
    """What is refined, and what its last step has left; float64, changed in place."""

    rotation: np.ndarray  # (3, 3)
    centre_mm: np.ndarray  # (3,)
    coefficients: np.ndarray  # (m,)
    pose_offset: np.ndarray  # (6,): shift and turn since the start
    distances_mm: np.ndarray  # (n,), float32
    curvature: np.ndarray  # (p, p)
    gradient: np.ndarray  # (p,)


# Problem, state, room, first and last step, what it ended with.
_descend = kernel(
    "descend",
    (MODES, F64[3], DISTANCES, F64["p", "p"], F64["m"], F32["n", 3], *[float] * 5),
    (F64[3, 3].out, F64[3].out, F64["m"].out, F64[6].out, F32["n"].out, F64["p", "p"].out,
     F64["p"].out),
    (VELOCITY.out, F32["m"].out, F32[BLOCK, "q"].out, F32["c", _STRIDE].out, F64["c", "s"].out,
     F64["p", "p"].out, F64["p"].out),
    int, int, F64[2].out, result=int,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """A motion fitted to views.

    Attributes:
        views: with the places of further cameras as they are corrected for this motion.
        cost: robust data term, prior of the motion, and the further cameras' errors.
        outliers: share of the points farther off than ``FARTHEST`` widths;
            ``cost_without_strays``: if all lay as the others do.
        distances_mm: the residuals, signed.
        pose_offset: shift (mm) and turn (rad) from where the prior has the pose.
        terms: of the evidence, at the motion.
        alternatives: other minima that explain the points nearly as well; ``excluded_pose``: one
            that explains them better, in a pose that is excluded (see
            ``registration.select_best``).
    """

    motion: ElasticMotion
    views: MultiViewCloud
    cost: float
    outliers: float
    cost_without_strays: float
    distances_mm: Float[np.ndarray, " n"]
    steps: int
    pose_offset: Float64[np.ndarray, " 6"]
    terms: Terms | None = None
    alternatives: tuple[RegistrationResult, ...] = ()
    excluded_pose: RegistrationResult | None = None

    @property
    def points_cost(self) -> float:
        """The cost without that of evidence."""
        return self.cost - (0.0 if self.terms is None else self.terms.cost)

    def with_evidence(self, evidence: EvidenceTerms | None) -> RegistrationResult:
        """A fit to points alone, judged by evidence as well."""
        if evidence is None:
            return self
        terms = evidence.at(self.motion)
        more = terms.cost
        return replace(
            self,
            terms=terms,
            views=replace(self.views, evidence=evidence),
            cost=self.cost + more,
            cost_without_strays=self.cost_without_strays + more,
        )

    @property
    def others(self) -> tuple[RegistrationResult, ...]:
        return (
            self.alternatives
            if self.excluded_pose is None
            else (*self.alternatives, self.excluded_pose)
        )


def refine(
    rest: RestShape, views: MultiViewCloud, start: ElasticMotion, config: GaussNewtonConfig
) -> RegistrationResult:
    """The motion near ``start`` that fits the views' points and the library best."""
    descent = GaussNewton(rest, views, start, config)
    descent.run(config.steps)
    return descent.result()


class GaussNewton:
    """A refinement that can be stopped on its way and continued. ``cost``: of the present state, as
    in ``RegistrationResult``; infinite before the first step. ``steps``: taken so far;
    ``converged``: more would not move it. ``pose_offset``: the start's, as in
    ``RegistrationResult``;
    None: the prior has the pose where it starts. ``state``: pose, coefficients and shift, and at
    them the distances, the curvature and the gradient of the cost."""

    def __init__(
        self,
        rest: RestShape,
        views: MultiViewCloud,
        start: ElasticMotion,
        config: GaussNewtonConfig,
        pose_offset: Float64[np.ndarray, " 6"] | None = None,
    ) -> None:
        body, count = rest.body, len(views.points_mm)
        precision = prior_precision(rest, config)
        self._rest, self._views, last_mm = rest, views, views.width_mm(config)
        self._problem = _Problem(
            modes=body.mode_field,
            center_ct=body.center_ct,
            distances=rest.distances[0],
            precision=precision,
            mean=body.mean,
            points=np.array(views.points_mm, np.float32, order="C"),
            weight=views.weight(config),
            first_mm=max(config.first_mm, last_mm),
            last_mm=last_mm,
            narrowing=config.narrowing,
            enough_mm=config.enough_mm,
        )
        given = start.rotation, start.centre_mm, start.coefficients
        rotation, centre_mm, coefficients = (np.array(part, float, order="C") for part in given)
        left = np.empty(count, np.float32), np.empty_like(precision), np.empty(len(precision))
        already = np.zeros(6) if pose_offset is None else np.array(pose_offset, float)
        self.state = _State(rotation, centre_mm, coefficients, already, *left)
        self.cost, self.steps, self.converged = np.inf, 0, False
        self._terms: Terms | None = None  # of the evidence, at the present state

    def run(self, steps: int) -> None:
        """Continue until ``steps`` are taken since the start, or it has converged."""
        if self.converged or (steps <= self.steps and np.isfinite(self.cost)):
            return
        if self._views.evidence is None:
            self.steps, self.converged, self.cost = self._descend(self.steps, steps)
            return
        if not np.isfinite(self.cost):
            self._step(0, 0)
        while self.steps < steps and not self.converged:
            self._step(self.steps + 1, self.steps + 2)  # from 1 on: only then no equations first
            self.steps += 1

    def _step(self, first: int, last: int) -> None:
        """With the evidence in the equations that it leaves."""
        state, evidence = self.state, self._views.evidence
        _, self.converged, cost = self._descend(first, last)
        motion = ElasticMotion(self._rest, state.rotation, state.centre_mm, state.coefficients)
        assert evidence is not None
        self._terms = evidence.at(motion)
        self.cost = cost + self._terms.add_to(state.curvature, state.gradient)

    def _descend(self, first: int, last: int) -> tuple[int, bool, float]:
        """Steps ``first`` to ``last``, fewer if it converges, in one call of the kernel: their
        number, whether it has converged, and the last cost. Where ``first`` is not 0, the state is
        what the steps before have left. Raises numpy.linalg.LinAlgError: the curvature is not
        positive definite."""
        mean, ended = self._problem.mean, np.empty(2)
        unknowns = POSE + len(mean)
        columns = -(-(unknowns + 1) // 4) * 4
        room = (
            np.empty(self._problem.modes.values.shape[:-1], np.float32),
            np.empty(len(mean), np.float32),
            np.empty((BLOCK, unknowns + 1), np.float32),
            np.empty((columns, _STRIDE), np.float32),
            np.empty((columns, columns + 4)),
            np.empty((unknowns, unknowns)),
            np.empty(unknowns),
        )
        steps = _descend(self._problem, self.state, room, first, last, ended)
        if steps < 0:
            raise np.linalg.LinAlgError("the refinement's curvature is not positive definite")
        return steps, bool(ended[0]), float(ended[1])

    def result(self) -> RegistrationResult:
        state = _State._make(part.copy() for part in self.state)
        covariance = np.linalg.inv(state.curvature)
        placed = state.rotation, state.centre_mm, state.coefficients
        motion = ElasticMotion(self._rest, *placed, covariance)
        squares = (state.distances_mm / self._problem.last_mm) ** 2
        far = squares > FARTHEST**2
        of_strays = (squares / (1 + squares))[far].sum()
        of_strays *= self._problem.weight * self._problem.last_mm**2
        outliers = float(far.mean())
        without = float(self.cost - of_strays) / max(1 - outliers, 1 / len(far))
        costs = self.cost, outliers, without
        left = state.distances_mm, self.steps, state.pose_offset
        return RegistrationResult(motion, self._views, *costs, *left, self._terms)


def prior_precision(rest: RestShape, config: GaussNewtonConfig) -> Float64[np.ndarray, "p p"]:
    """The precision of shift, turn and coefficients."""
    pose = [1 / config.shift_mm**2] * 3 + [1 / config.turn_rad**2] * 3
    precision = np.diag(pose + [0.0] * len(rest.body.mean))
    precision[6:, 6:] = rest.body.precision
    return precision
