"""What a fit says of itself, as entries of an estimate's report."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.report import AllowedPoses, ExcludedFit, FitCost, MotionReport, RivalFit
from tumortrack.registration.bend import BentFit
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import FARTHEST, RegistrationResult
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.search import PosePrior


def cost_entry(
    fit: RegistrationResult, prior: PosePrior, usual_cost: float, config: GaussNewtonConfig
) -> FitCost:
    """``usual_cost``: of one look, without its noise. Of several looks the one with most strays
    counts."""
    looks, strays, now = fit.looks, fit.strays, fit.points_cost
    if looks.count > 1:
        far = np.abs(fit.distances_mm) > FARTHEST * looks.width_mm(config)
        strays = max(float(far[looks.look == n].mean()) for n in range(looks.count))
    rivals = [
        RivalFit(more=rival.cost - fit.cost, share=share, **_beside(fit.motion, rival.motion))
        for rival, (_, share) in zip(fit.rivals, fit.motion.rivals, strict=False)
    ]
    return FitCost(
        now=now,
        without_strays=fit.cost_without_strays - (fit.cost - now),
        usual=usual_cost * looks.count + looks.noise_cost(config),
        strays=strays,
        others=tuple(rivals),
        beyond=_excluded(fit, prior),
    )


def _beside(motion: ElasticMotion, rival: ElasticMotion) -> dict[str, Any]:
    """Where the middles of the parts lie in another motion, how far from this one's, and by how
    much the organ is turned."""
    middles_ct, names = motion.shape.middles_ct, motion.shape.anatomy_ct.names
    there = rival.carry(middles_ct)
    apart_mm = np.linalg.norm(there - motion.carry(middles_ct), axis=1).tolist()
    cosine = (np.trace(rival.rotation @ motion.rotation.T) - 1) / 2
    return {
        "apart_mm": dict(zip(names, apart_mm, strict=True)),
        "center_mm": dict(zip(names, map(tuple, there.tolist()), strict=True)),
        "turn_degrees": float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
    }


def _excluded(fit: RegistrationResult, prior: PosePrior) -> ExcludedFit | None:
    """A pose with the other side up that explains the points as well, or better in one that is
    excluded; or the fit itself, if it is in one."""
    other = fit if prior.excludes(fit.motion.rotation) else fit.beyond
    if other is None:
        return None
    tilt_degrees = float(prior.tilt_degrees_of(other.motion.rotation))
    return ExcludedFit(less=fit.cost - other.cost, tilt_degrees=tilt_degrees)


def poses_entry(prior: PosePrior) -> AllowedPoses:
    return AllowedPoses(
        up_lps=prior.up_ct.tolist(),
        tilt_degrees=prior.tilt_degrees,
        either_side=prior.either_side,
    )


def motion_entry(motion: ElasticMotion, fit: RegistrationResult, bent: BentFit) -> MotionReport:
    """``motion``: of ``bent``, perhaps smoothed; ``fit``: of the library."""
    return MotionReport(
        camera_from_ct=motion.camera_from_ct.tolist(),
        coefficients=motion.coefficients.tolist(),
        rarity=fit.motion.rarity,
        steps=bent.steps,
        compliance_std_mm=bent.compliance_std_mm,
        misfit_mm=bent.misfit_mm,
        depth_share=motion.depth_share,
    )


def part_deviations(
    center_mm2: Float[np.ndarray, "3 3"],
    surface_mm2: Float[np.ndarray, "n 3 3"],
    center_mm: Float[np.ndarray, " 3"],
    points_mm: Float[np.ndarray, "m 3"],
) -> dict[str, Any]:
    """Fields of a ``PartReport``, by the covariances of a part's centre and of places on it;
    ``points_mm``: what was seen."""
    squares, axes = np.linalg.eigh(center_mm2)
    return {
        "center_std_mm": float(np.sqrt(squares.mean())),
        "center_axes_std_mm": tuple(np.sqrt(squares[::-1]).tolist()),
        "center_axes": tuple(map(tuple, axes.T[::-1].tolist())),
        "surface_std_mm": float(np.sqrt(np.linalg.eigvalsh(surface_mm2).max())),
        "nearest_mm": float(np.sqrt(((points_mm - center_mm) ** 2).sum(1).min())),
    }
