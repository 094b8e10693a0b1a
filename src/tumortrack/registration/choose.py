"""Which of several fits is the answer, and which others have to be named beside it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tumortrack.models.in_distribution import RIVAL_COST
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.search import PosePrior, apart_mm

# Our choice: of an organ that was turned over the upright fit has to cost twice as much. Of a
# prostate in ultrasound, which fits better upside down, it costs 1.5 times as much (82, 55).
_TURNED_RATIO = 2.0

_WITHIN = 7.81  # 95 % of chi squared with three degrees of freedom
_SAME_MM = 0.2  # descents that end in one minimum end within some last steps (enough_mm, 0.02)


def cost_with_prior(fit: RegistrationResult, prior: PosePrior) -> float:
    """-2 log of a fit's probability, up to a constant."""
    return fit.cost + float(prior.cost(fit.motion.rotation))


def likeliest(fits: Sequence[RegistrationResult], prior: PosePrior) -> RegistrationResult:
    """The likeliest of these fits and their others, by cost and prior of the pose.

    Its rivals are those that are less likely by ``RIVAL_COST`` at most and put the middle of a part
    where neither its covariance nor those of likelier rivals have it; its motion has their shares
    of the probability, ``exp(-cost / 2)``. ``beyond`` is the best fit in a pose that the case
    excludes, if it costs less; its share is 0. Of an organ that was turned over it is the best one
    that is not: only where that costs far more is it sure that it was.
    """
    everything = [each for fit in fits for each in (fit, *fit.others)]
    costs = {id(fit): cost_with_prior(fit, prior) for fit in everything}
    first, *others = sorted(everything, key=lambda fit: costs[id(fit)])
    kept = [first]
    for other in others:
        if costs[id(other)] - costs[id(first)] > RIVAL_COST:
            break
        if all(_is_distinct(other.motion, fit.motion) for fit in kept):
            kept.append(other)
    beyond = _better_on_other_side(first, everything, prior)
    odds = [math.exp((costs[id(first)] - costs[id(fit)]) / 2) for fit in kept]
    shares = [each / sum(odds) for each in odds]
    rivals = tuple(zip((fit.motion for fit in kept[1:]), shares[1:], strict=True))
    rivals += () if beyond is None else ((beyond.motion, 0.0),)
    motion = replace(first.motion, rivals=rivals)
    return replace(first, motion=motion, rivals=tuple(kept[1:]), beyond=beyond)


def _better_on_other_side(
    first: RegistrationResult, fits: Sequence[RegistrationResult], prior: PosePrior
) -> RegistrationResult | None:
    """The best fit with the other side up, if it speaks against the side that ``first`` has up."""
    stated = prior.as_stated
    turned = bool(stated.excludes(first.motion.rotation))
    others = [fit for fit in fits if stated.excludes(fit.motion.rotation) != turned]
    best = min(others, key=lambda fit: fit.cost, default=None)
    most = first.cost * (_TURNED_RATIO if turned else 1.0)
    return best if best is not None and best.cost < most else None


def _is_distinct(other: ElasticMotion, motion: ElasticMotion) -> bool:
    """Whether a part's middle lies outside the ellipsoid of 95 % of the other's covariance."""
    bent = np.abs(other.coefficients - motion.coefficients).max()
    if max(bent, apart_mm(other, motion)) < _SAME_MM:
        return False  # most are the same minimum, which is quickly found
    middles = motion.shape.middles_ct
    covariance = replace(motion, rivals=()).covariance_mm2(middles)
    assert covariance is not None
    away = other.carry(middles) - motion.carry(middles)
    squares = (np.linalg.solve(covariance, away[..., None])[..., 0] * away).sum(1)
    return bool(squares.max() > _WITHIN)
