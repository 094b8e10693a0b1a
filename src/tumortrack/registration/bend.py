"""The fit goes on in the body's compliance: what no state of the library can follow.

Forces anywhere on the surface displace it (``simulate.elastic.modes.compliance_modes``), by
independent coefficients of one standard deviation. Each frame chooses it by marginal likelihood
(Laplace's approximation), so that an organ that is as the library has it stays so.

The choice is made on groups of neighbouring points, whose distances are taken to be linear in the
unknowns. Then follows a true step. The curvature there is the precision of the answer: far from
what is seen the compliance says by how much the organ may be elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from scipy.linalg import cho_factor, cho_solve

from tumortrack.core.mesh_kernels import farthest
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import Terms
from tumortrack.registration.gauss_newton import GaussNewton, RegistrationResult, prior_precision
from tumortrack.registration.kernels import POSE
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion

# Of the coefficients: hardly any; as loads like the library's would have them; strong ones. Five
# values from 0.5 to 8 choose no better.
_STDS_MM = (0.5, 2.0, 6.0)
_LINEAR_STEPS = 2
_STEPS = 1  # true ones; two and six leave the same errors
_EVERY = 3  # the choice takes one of so many points, and is as good as with all
_GROUPS = 64  # of neighbouring points, some 8 mm apart
_ALIKE_MM = 1.0  # points farther from their group's median count little in its mean
_JUDGED_WIDTH = 2.0  # neighbours that lie off together are rather the organ than strays
# Of the determinants in the evidence. Points' noise is nearer to 0.5 mm than to ``sigma_mm``, which
# also stands for the library's errors: so much less do they count beside the cost.
_DETERMINANTS = 0.3


@dataclass(frozen=True, eq=False)
class BentFit:
    """As ``RegistrationResult``; the motion's last coefficients are the compliance's, which have
    this standard deviation. ``prior_slope``: of half the prior's cost, by the unknowns."""

    motion: ElasticMotion
    looks: Looks
    cost: float
    distances_mm: Float[np.ndarray, " n"]
    steps: int
    compliance_std_mm: float
    prior_slope: Float64[np.ndarray, " p"]
    terms: Terms | None


def bend(fit: RegistrationResult, config: GaussNewtonConfig) -> BentFit:
    """A fit of the library, continued in the compliance that its points ask for; with its rivals,
    which stay as they are."""
    start = _with_compliance(fit.motion)
    evidence = fit.looks.evidence
    terms = None if evidence is None else evidence.at(start)
    std_mm = _Groups.near(fit, start, config, terms).likeliest_std_mm()
    forces = np.eye(len(start.coefficients) - len(fit.motion.coefficients)) / std_mm**2
    precision = _blocks(prior_precision(fit.motion.shape, config), forces)
    near = msgspec.structs.replace(config, first_mm=config.last_mm)
    descent = GaussNewton(start.shape, fit.looks, start, near, fit.moved, precision, terms)
    descent.run(_STEPS)
    bent = descent.result()
    motion, steps = replace(bent.motion, rivals=fit.motion.rivals), fit.steps + bent.steps
    slope = precision @ np.append(bent.moved, motion.coefficients - start.shape.body.mean)
    return BentFit(
        motion, fit.looks, bent.cost, bent.distances_mm, steps, std_mm, slope, bent.terms
    )


def _with_compliance(motion: ElasticMotion) -> ElasticMotion:
    """The same motion, of the shape with compliance."""
    shape = motion.shape.compliant
    coefficients = np.zeros(shape.body.modes.shape[-1])
    coefficients[: len(motion.coefficients)] = motion.coefficients
    return replace(motion, shape=shape, coefficients=coefficients, covariance=None)


@dataclass(frozen=True, eq=False)
class _Groups:
    """Mean distances of neighbouring points near a fit, and evidence, linear in the unknowns.

    Attributes:
        distances_mm: at the fit; ``at_mean_mm``: with the unknowns at their prior's mean.
        by_library_mm2: the distances' covariance by pose and library; ``by_compliance_mm2``: by the
            compliance with a standard deviation of 1 mm.
        weights: of the distances' squares in the cost.
        width_mm: the robust kernel's.
    """

    distances_mm: Float64[np.ndarray, " g"]
    at_mean_mm: Float64[np.ndarray, " g"]
    by_library_mm2: Float64[np.ndarray, "g g"]
    by_compliance_mm2: Float64[np.ndarray, "g g"]
    weights: Float64[np.ndarray, " g"]
    width_mm: Float64[np.ndarray, " g"]

    @classmethod
    def near(
        cls,
        fit: RegistrationResult,
        start: ElasticMotion,
        config: GaussNewtonConfig,
        terms: Terms | None,
    ) -> _Groups:
        """``start``: the fit's motion, with compliance; ``terms``: of evidence, there."""
        points_mm, body = fit.looks.points_mm[::_EVERY], fit.motion.shape.body
        means, counts = _means_of_groups(start.residual_rows(points_mm), start.back(points_mm))
        weights = _EVERY * fit.looks.weight(config) * counts
        width_mm = np.full(len(counts), fit.looks.width_mm(config))
        if terms is not None:
            means = np.concatenate([means, np.column_stack([terms.by_motion, terms.residuals_mm])])
            weights = np.append(weights, terms.std_mm**-2.0)
            width_mm = np.append(width_mm, terms.width_mm)
        shared = np.zeros((len(means), len(means)))
        if terms is not None:
            shared[len(counts) :, len(counts) :] = terms.by_shifts @ terms.by_shifts.T
        by_library, by_compliance, distances_mm = np.split(means, [POSE + len(body.mean), -1], 1)
        pose_std = np.repeat([config.shift_mm, config.turn_rad], 3)
        prior = _blocks(np.diag(pose_std**2), body.covariance)
        off = np.append(fit.moved, fit.motion.coefficients - body.mean)
        return cls(
            distances_mm=distances_mm[:, 0],
            at_mean_mm=distances_mm[:, 0] - by_library @ off,
            by_library_mm2=by_library @ prior @ by_library.T + shared,
            by_compliance_mm2=by_compliance @ by_compliance.T,
            weights=weights,
            width_mm=width_mm,
        )

    def likeliest_std_mm(self) -> float:
        """Of the compliance."""
        return min(_STDS_MM, key=self.cost)

    def cost(self, std_mm: float) -> float:
        """-2 log of the evidence of a standard deviation, up to a constant.

        With distances d + J x, covariance C of x, and robust weights W, the likeliest x is -C J' z,
        where z = (J C J' + 1 / W)^-1 d: a small system, since groups are fewer than unknowns. Its
        determinant, times W's, is that of the posterior's precision over the prior's.
        """
        explained = self.by_library_mm2 + std_mm**2 * self.by_compliance_mm2
        residuals_mm = self.distances_mm
        for _ in range(_LINEAR_STEPS):
            roots = np.sqrt(self.weights) / (1 + (residuals_mm / self.width_mm) ** 2)
            system = roots[:, None] * explained * roots + np.eye(len(roots))
            factor = cho_factor(system, lower=True, check_finite=False)
            pulls = roots * cho_solve(factor, roots * self.at_mean_mm, check_finite=False)
            residuals_mm = self.at_mean_mm - explained @ pulls
        width_mm = _JUDGED_WIDTH * self.width_mm
        squares = (residuals_mm / width_mm) ** 2
        misfit = (width_mm**2 * self.weights) @ (squares / (1 + squares))
        determinant = _DETERMINANTS * 2 * np.log(np.diag(factor[0])).sum()
        return float(misfit + pulls @ explained @ pulls + determinant)


def _blocks(a: Float64[np.ndarray, "p p"], b: Float64[np.ndarray, "c c"]) -> np.ndarray:
    none = np.zeros((len(a), len(b)))
    return np.block([[a, none], [none.T, b]])


def _means_of_groups(
    rows: Float32[np.ndarray, "n q"], points_ct: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "g q"], Int64[np.ndarray, " g"]]:
    """Each group's mean row, without what lies off the median distance (the last column), and how
    many points it has."""
    group, distances = _grouped(points_ct), rows[:, -1]
    order = np.lexsort([distances, group])
    group, distances = group[order], distances[order]
    counts = np.bincount(group)
    first = np.cumsum(counts) - counts
    median = distances[first + counts // 2]
    weights = 1 / (1 + ((distances - median[group]) / _ALIKE_MM) ** 2) ** 2
    weights /= np.add.reduceat(weights, first)[group]
    means = np.add.reduceat(rows[order] * weights.astype(np.float32)[:, None], first)
    return means.astype(float), counts


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
