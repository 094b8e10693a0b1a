"""The fit goes on in the body's compliance: what no state of the library can follow.

Forces anywhere on the surface displace it (``organ.modes.compliance_modes``), by
independent coefficients of one standard deviation. Each frame chooses it, and how far states
spread, by marginal likelihood (Laplace's approximation), so that an organ that is as the library
has it stays so.

The choice is made on groups of neighbouring points, whose distances are taken to be linear in the
unknowns. Then follow true steps, in which evidence is true or false (a mixture). Neighbours share
errors of the model (``rest_shape``). The curvature is the precision of the answer: far from what
is seen the compliance says by how much the organ may be elsewhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from jaxtyping import Float, Float64, Int64

from tumortrack.core.mesh_kernels import farthest
from tumortrack.native import F64, kernel
from tumortrack.organ.rest_shape import error_covariance_mm2
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import Terms
from tumortrack.registration.gauss_newton import RegistrationResult, prior_precision
from tumortrack.registration.motion import POSE, ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud, Residuals
from tumortrack.simulation.noise import CAMERA_STD

# Of the coefficients: hardly any; as loads like the library's would have them; strong ones.
_STDS_MM = (0.5, 2.0, 6.0)
# What fits leave of groups of points where the model errs as ``sigma_mm`` and ``ModelError`` say;
# where less or more is left, it errs by less or more.
_USUAL_MISFIT_MM, _SCALES = 0.3, (0.32, 0.8)
_FAR_OFF, _FAR_MM = 3.0, 0.3  # medians, and mm: groups farther off are none of the organ
# Of coefficients that the points tell no better than by so much; as the library's loads have them.
_UNSEEN_MM, _TOLD_MM = 2.0, 1.0
# Of the library's states about their mean: most organs lie nearer to it than one normal
# distribution says, some far off. Of one that shows little deformation evidence makes up no more.
_SPREADS = (0.3, 1.0, 2.0)
_LINEAR_STEPS = 2
_GROUPS = 64  # of neighbouring points, some 8 mm apart
_ALIKE_MM = 1.0  # points farther from their group's median count little in its mean
_LESS = 0.05  # share of the prior's weight: first order, and no float32 noise
_JUDGED_WIDTH = 2.0  # neighbours that lie off together are rather the organ than outliers


@dataclass(frozen=True, eq=False)
class RefinedFit:
    """As ``RegistrationResult``; the motion's last coefficients are the compliance's, which have
    this standard deviation. ``prior_slope``: of half the prior's cost, by the unknowns;
    ``misfit_mm``: what the library's fit leaves of groups of points, root mean square."""

    motion: ElasticMotion
    views: MultiViewCloud
    distances_mm: Float[np.ndarray, " n"]
    steps: int
    compliance_std_mm: float
    misfit_mm: float
    prior_slope: Float64[np.ndarray, " p"]
    terms: Terms | None

    @property
    def prior_pull_mm(self) -> list[float]:
        """How far the prior, against the points, holds the middle of each part: to first order, how
        far each moves per share of the prior's weight taken away."""
        motion, middles_ct = self.motion, self.motion.shape.middles_ct
        assert motion.covariance is not None
        freer = motion.changed(_LESS * motion.covariance @ self.prior_slope)
        away_mm = freer.forward(middles_ct) - motion.forward(middles_ct)
        return (np.linalg.norm(away_mm, axis=1) / _LESS).tolist()


def refine_compliance(fit: RegistrationResult, config: GaussNewtonConfig) -> RefinedFit:
    """A fit of the library, continued in the compliance that its points ask for; with its
    alternatives, which stay as they are."""
    start, views = with_compliance(fit.motion), fit.views
    near, usual = views.residuals(start, config), views.weight(config)
    means = Means.from_residuals(near, start.inverse(views.points_mm))
    scale = min(max(means.misfit_mm / _USUAL_MISFIT_MM, _SCALES[0]), _SCALES[1])
    config = msgspec.structs.replace(config, sigma_mm=scale * config.sigma_mm)
    near = replace(near, weights=near.weights * (views.weight(config) / usual))
    terms = None if views.evidence is None else views.evidence.at(start)
    std_mm, spread = Groups.near(fit, means, config, terms, scale).select_best()
    of_library = prior_precision(fit.motion.shape, config)
    states = slice(POSE, len(of_library) - fit.motion.shape.flap_modes)
    of_library[states, states] /= spread**2
    precision = _blocks(of_library, _precision_of_forces(near, len(of_library), std_mm))
    at = Linear.at(start, fit.pose_offset, near, views, precision, terms, scale)
    steps = 1 if terms is None else 2  # more leave the same errors; evidence is judged on the way
    for _ in range(steps):
        at = at.moved_by(views, precision, config, scale)
    count = len(precision)  # the rest are the cameras' errors
    covariance = np.linalg.inv(at.curvature)[:count, :count]
    covariance[:3, :3] += views.noise.shift_mm**2 * np.eye(3)
    motion = replace(at.motion, covariance=covariance, alternatives=fit.motion.alternatives)
    return RefinedFit(
        motion=motion,
        views=views,
        distances_mm=at.distances_mm,
        steps=fit.steps + steps,
        compliance_std_mm=std_mm,
        misfit_mm=means.misfit_mm,
        prior_slope=precision
        @ np.append(at.pose_offset, motion.coefficients - start.shape.body.mean),
        terms=at.terms,
    )


def with_compliance(motion: ElasticMotion) -> ElasticMotion:
    """The same motion, of the shape with compliance."""
    shape = motion.shape.compliant
    coefficients = np.zeros(shape.body.modes.shape[-1])
    coefficients[: len(motion.coefficients)] = motion.coefficients
    return replace(motion, shape=shape, coefficients=coefficients, covariance=None)


def _precision_of_forces(near: Residuals, known: int, std_mm: float) -> Float64[np.ndarray, "c c"]:
    """Of the compliance's coefficients, after the first ``known`` unknowns: those that the points
    tell are as the points say, those that they hardly tell may be of loads out of sight."""
    rows = near.by_motion[:, known:]
    told, axes = np.linalg.eigh(rows.T @ (rows * near.weights[:, None]))
    told = np.maximum(told, 0.0) * _TOLD_MM**2
    variances = (told * std_mm**2 + max(std_mm, _UNSEEN_MM) ** 2) / (told + 1)
    return (axes / variances) @ axes.T


@dataclass(frozen=True, eq=False)
class Linear:
    """A Gauss-Newton step's equations at a motion that has ``pose_offset`` from where the prior has
    the pose: of it, and of further cameras' errors; those that neighbours share, and those of
    tools, are marginalised."""

    motion: ElasticMotion
    pose_offset: Float64[np.ndarray, " 6"]
    distances_mm: Float64[np.ndarray, " n"]
    terms: Terms | None
    curvature: Float64[np.ndarray, "p p"]
    gradient: Float64[np.ndarray, " p"]

    @classmethod
    def at(
        cls,
        motion: ElasticMotion,
        pose_offset: Float64[np.ndarray, " 6"],
        near: Residuals,
        views: MultiViewCloud,
        precision: Float64[np.ndarray, "p p"],
        terms: Terms | None,
        scale: float,
    ) -> Linear:
        """``near``, ``terms``: of the views' points and evidence, there; ``scale``: of the model's
        error."""
        by_all = np.concatenate([near.by_motion, near.by_cameras], axis=1)
        count, cameras = len(precision), by_all.shape[1] - len(precision)
        rows, weights = np.column_stack([by_all, near.distances_mm]), near.weights
        on, places_mm = np.arange(len(rows)), views.points_mm  # the organ: rows, and where
        by_shifts, error = np.zeros((len(rows), 0)), motion.shape.model_error
        if terms is not None and views.evidence is not None:
            on = np.append(on, len(rows) + views.evidence.on_organ)
            places_mm = np.concatenate(
                [places_mm, views.evidence.places_mm[views.evidence.on_organ]]
            )
            by_shifts = np.pad(terms.by_shifts, ((len(rows), 0), (0, 0)))
            more = np.pad(terms.by_motion, ((0, 0), (0, cameras)))
            rows = np.concatenate([rows, np.column_stack([more, terms.residuals_mm])])
            weights = np.append(weights, terms.weights)
        node = error.nearest(motion.inverse(places_mm))
        together = np.column_stack([rows, by_shifts])
        own, across = error.equations(node, together[on], weights[on], scale)
        across, mixed = np.split(across, [rows.shape[1]], axis=1)
        weighted = by_shifts.T * weights  # tools' shifts are marginalised with the field
        own = np.block([[own, mixed], [mixed.T, np.eye(len(weighted)) + weighted @ by_shifts]])
        across = np.concatenate([across, weighted @ rows])
        whole = rows.T @ (rows * weights[:, None]) - across.T @ np.linalg.solve(own, across)
        errors = np.diag(np.tile(CAMERA_STD**-2, cameras // POSE))
        curvature, gradient = whole[:-1, :-1] + _blocks(precision, errors), whole[:-1, -1]
        change = np.append(pose_offset, motion.coefficients - motion.shape.body.mean)
        gradient[:count] += precision @ change
        return cls(motion, pose_offset, near.distances_mm, terms, curvature, gradient)

    def moved_by(
        self,
        views: MultiViewCloud,
        precision: Float64[np.ndarray, "p p"],
        config: GaussNewtonConfig,
        scale: float,
    ) -> Linear:
        """After a step."""
        count = len(precision)  # the cameras stay
        change = -np.linalg.solve(self.curvature[:count, :count], self.gradient[:count])
        motion, evidence = self.motion.changed(change), views.evidence
        terms = None if evidence is None else evidence.at(motion).judged
        near, pose_offset = views.residuals(motion, config), self.pose_offset + change[:POSE]
        return self.at(motion, pose_offset, near, views, precision, terms, scale)


@dataclass(frozen=True, eq=False)
class Means:
    """Of groups of neighbouring points, without what lies off the median distance: derivatives and,
    last, distance; how many points each has, and their middle."""

    rows: Float64[np.ndarray, "g q"]
    counts: Int64[np.ndarray, " g"]
    middles_ct: Float64[np.ndarray, "g 3"]

    @classmethod
    def from_residuals(cls, near: Residuals, points_ct: Float64[np.ndarray, "n 3"]) -> Means:
        """``near``: of the points, at a motion by which they are carried back."""
        group, distances = _grouped(points_ct), near.distances_mm
        order = np.lexsort([distances, group])
        group, distances = group[order], distances[order]
        counts = np.bincount(group)
        first = np.cumsum(counts) - counts
        median = distances[first + counts // 2]
        weights = 1 / (1 + ((distances - median[group]) / _ALIKE_MM) ** 2) ** 2
        weights /= np.add.reduceat(weights, first)[group]
        rows = np.column_stack([near.by_motion, near.distances_mm]).astype(np.float32)[order]
        means = np.add.reduceat(rows * weights.astype(np.float32)[:, None], first)
        middles_ct = np.add.reduceat(points_ct[order], first) / counts[:, None]
        return cls(means.astype(float), counts, middles_ct)

    @property
    def misfit_mm(self) -> float:
        """What a fit leaves of the groups, root mean square, without what is none of it."""
        off_mm = np.abs(self.rows[:, -1])
        near = off_mm < _FAR_OFF * np.median(off_mm) + _FAR_MM
        return float(np.sqrt(np.average(off_mm[near] ** 2, weights=self.counts[near])))


@dataclass(frozen=True, eq=False)
class Groups:
    """Mean distances of neighbouring points near a fit, and evidence, linear in the unknowns.

    Attributes:
        distances_mm: at the fit; ``at_mean_mm``: with the unknowns at their prior's mean.
        by_pose_mm2: the distances' covariance by the pose, a flap, and what neighbours share;
            ``by_library_mm2``: by the states; ``by_compliance_mm2``: by the compliance with a
            standard deviation of 1 mm.
        weights: of the distances' squares in the cost.
        width_mm: the robust kernel's.
    """

    distances_mm: Float64[np.ndarray, " g"]
    at_mean_mm: Float64[np.ndarray, " g"]
    by_pose_mm2: Float64[np.ndarray, "g g"]
    by_library_mm2: Float64[np.ndarray, "g g"]
    by_compliance_mm2: Float64[np.ndarray, "g g"]
    weights: Float64[np.ndarray, " g"]
    width_mm: Float64[np.ndarray, " g"]

    @classmethod
    def near(
        cls,
        fit: RegistrationResult,
        of_groups: Means,
        config: GaussNewtonConfig,
        terms: Terms | None,
        scale: float,
    ) -> Groups:
        """``of_groups``, ``terms``: at the fit's motion, with compliance."""
        body, counts, means = fit.motion.shape.body, of_groups.counts, of_groups.rows
        weights = fit.views.weight(config) * counts
        width_mm = np.full(len(counts), fit.views.width_mm(config))
        if terms is not None:
            means = np.concatenate([means, np.column_stack([terms.by_motion, terms.residuals_mm])])
            weights = np.append(weights, terms.std_mm**-2.0)
            width_mm = np.append(width_mm, terms.width_mm)
        shared = np.zeros((len(means), len(means)))
        shared[: len(counts), : len(counts)] = scale**2 * error_covariance_mm2(of_groups.middles_ct)
        if terms is not None:
            shared[len(counts) :, len(counts) :] = terms.by_shifts @ terms.by_shifts.T
        by_library, by_compliance, distances_mm = np.split(means, [POSE + len(body.mean), -1], 1)
        pose_std = np.repeat([config.shift_mm, config.turn_rad], 3)
        by_pose = by_library[:, :POSE] * pose_std
        by_states, covariance = by_library[:, POSE:], body.covariance
        library = len(covariance) - fit.motion.shape.flap_modes
        by_flap = by_states[:, library:]
        shared += by_flap @ covariance[library:, library:] @ by_flap.T
        by_states, covariance = by_states[:, :library], covariance[:library, :library]
        off = np.append(fit.pose_offset, fit.motion.coefficients - body.mean)
        return cls(
            distances_mm=np.ascontiguousarray(distances_mm[:, 0]),
            at_mean_mm=distances_mm[:, 0] - by_library @ off,
            by_pose_mm2=by_pose @ by_pose.T + shared,
            by_library_mm2=by_states @ covariance @ by_states.T,
            by_compliance_mm2=by_compliance @ by_compliance.T,
            weights=weights,
            width_mm=width_mm,
        )

    def select_best(self) -> tuple[float, float]:
        """Standard deviation of the compliance, and by what the library's are multiplied (root mean
        square over all that are likely)."""
        costs = np.array([[self.cost(std, s) for s in _SPREADS] for std in _STDS_MM])
        shares = np.exp((costs.min() - costs) / 2)
        squares = np.average(np.tile(np.square(_SPREADS), (len(costs), 1)), weights=shares)
        return _STDS_MM[int(costs.min(1).argmin())], float(np.sqrt(squares))

    def cost(self, std_mm: float, spread: float = 1.0, steps: int = _LINEAR_STEPS) -> float:
        """-2 log of the evidence of the compliance's deviation and the library's spread, up to a
        constant.

        See ``native/fast/compliance.c``. Raises numpy.linalg.LinAlgError.
        """
        explained = self.by_pose_mm2 + spread**2 * self.by_library_mm2
        explained += std_mm**2 * self.by_compliance_mm2
        given = self.weights, self.at_mean_mm, self.distances_mm, self.width_mm
        room = np.empty_like(explained), np.empty((3, len(explained)))
        cost = float(_linear_cost(explained, *given, _JUDGED_WIDTH, steps, *room))
        if not math.isfinite(cost):
            raise np.linalg.LinAlgError("the evidence of a compliance cannot be told")
        return cost


_linear_cost = kernel(
    "linear_cost", F64["n", "n"], F64["n"], F64["n"], F64["n"], F64["n"], float, int,
    F64["n", "n"].out, F64[3, "n"].out, result=float,
)  # fmt: skip


def _blocks(a: Float64[np.ndarray, "p p"], b: Float64[np.ndarray, "c c"]) -> np.ndarray:
    none = np.zeros((len(a), len(b)))
    return np.block([[a, none], [none.T, b]])


def _grouped(points_ct: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """The number of each point's group: of the nearest of some that lie far apart."""
    points = np.ascontiguousarray(points_ct.T[None], np.float32)
    away = points[0] - points[0].mean(axis=1, keepdims=True)
    first = np.array([(away**2).sum(axis=0).argmax()])
    chosen = np.empty((1, min(_GROUPS, len(points_ct))), np.int64)
    farthest(points, first, chosen)
    middles = points_ct[chosen[0]]
    nearest = ((middles**2).sum(1) / 2 - points_ct @ middles.T).argmin(axis=1)
    return np.unique(nearest, return_inverse=True)[1]  # where points coincide some have none
