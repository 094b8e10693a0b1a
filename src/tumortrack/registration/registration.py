"""The method `clinic`, read top to bottom: from a cloud of one side to the whole organ.

1. A rigid organ is fitted to few points from starts all around (`search`).
2. Gauss-Newton fits the elastic body's surface to the points from the best of these
   (`gauss_newton`), with a robust kernel.
3. The fit is repeated from starts beside the best, turned where its turn is least certain: one side
   leaves the turn about the organ's long axis nearly free, and there are local minima on the way.
4. The likeliest fit is kept, by its cost and by how the organ may lie, which the case says. Other
   minima that explain the points nearly as well, and put a tumor elsewhere, are kept as rivals; one
   that explains them better in a pose that the case excludes makes the answer poor.

The result is a motion (`motion`): any point of the CT, carried to the camera's frame and back,
with its uncertainty. `locator` reads surfaces, labels and numbers off it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import Points, turned_by
from tumortrack.core.process import parallel_map
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.models.in_distribution import RIVAL_COST
from tumortrack.registration.gauss_newton import GaussNewton, RegistrationResult, refine
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape
from tumortrack.registration.search import APART_MM, PosePrior, Search, apart_mm

Timer = Callable[[str], AbstractContextManager[object]]
CorrectedFit = tuple[RegistrationResult, Looks]  # a fit, with the further cameras where it has them

# Standard deviations to both sides. Of 1,200 first looks at a moving phantom, by the training's own
# physics, some 4 in 100 were 3 to 7 mm off without such starts, 6 with starts at 3 deviations, and
# none at 4.5 or 6.
_TURNED_STDS = 4.5

# On 840 clouds of four organs (drags, elastic states, the digital twin's) the eventual winner's
# cost after six steps was at most 2.5 times the least (turned starts: twice). Two thirds of the
# wrong ways round were above three times.
_TRIAL_STEPS = 6
_MAX_COST_RATIO = 3.0  # to the least cost: hypotheses above are given up
_TURNED_SHARE = 2 / 3  # of that, for turned starts, which a whole fit races

# Our choice: of an organ that was turned over the upright fit has to cost twice as much. Of a
# prostate in ultrasound, which fits better upside down, it costs 1.5 times as much (82, 55).
_TURNED_RATIO = 2.0

_CORRECTIONS = 3  # of cameras and motion in turns: more move nothing by a tenth of a millimetre

_WITHIN = 7.81  # 95 % of chi squared with three degrees of freedom
_SAME_MM = 0.2  # descents that end in one minimum end within some last steps (enough_mm, 0.02)


@dataclass(frozen=True, eq=False)
class Registration:
    """The organ at rest, fitted to clouds (camera frame, mm) that show one side of it."""

    rest: RestShape
    config: GaussNewtonConfig
    prior: PosePrior

    @cached_property
    def search(self) -> Search:
        """Over all poses of the prior, and beyond it."""
        return Search(self.rest, self.prior)

    def register(
        self,
        looks: Looks,
        known: CorrectedFit | None = None,
        timed: Timer = nullcontext,
        again: bool = False,
    ) -> CorrectedFit:
        """The whole method for one or several looks at a still organ; and the looks as the further
        cameras are corrected then. ``known``: a fit of these looks, which is kept if it is best;
        ``again``: which there is no reason to doubt, see ``Search.starts``.
        ``timed("search")`` and ``timed("refine")`` time its halves."""
        with timed("search"):
            starts = self.search.starts(looks, again)
        with timed("refine"):
            whole = replace(self, config=looks.weighed(self.config))
            fit = whole.best_fit(looks.points_mm, starts, None if known is None else known[0])
            if looks.count == 1:
                return fit, looks
            # Each with its own places of the cameras.
            every = [self._correct_cameras(looks, one) for one in (fit, *fit.others)]
            return self.likeliest_corrected(every if known is None else [known, *every])

    def follow(self, looks: Looks, start: ElasticMotion, config: GaussNewtonConfig) -> CorrectedFit:
        """The fit near a motion, and the looks as the further cameras are corrected then."""
        fit = refine(self.rest, looks.points_mm, start, looks.weighed(config))
        return self._correct_cameras(looks, fit)

    def best_fit(
        self,
        points_mm: Points,
        starts: list[ElasticMotion],
        known: RegistrationResult | None = None,
    ) -> RegistrationResult:
        """The fit that is most likely, with others that explain the points as well; ``known`` is
        one that was found before."""
        fits = [] if known is None else [known]
        new = [one for one in starts if all(apart_mm(one, fit.motion) > APART_MM for fit in fits)]
        fits += self._refine_promising(points_mm, [(one, None) for one in new], fits)
        turned = _turned_starts(min(fits, key=self._cost_with_prior))
        return self.likeliest(fits + self._refine_promising(points_mm, turned, fits))

    def likeliest_corrected(self, found: list[CorrectedFit]) -> CorrectedFit:
        """``likeliest`` the fits, and its looks."""
        looks = min(found, key=lambda one: self._cost_with_prior(one[0]))[1]
        return self.likeliest([fit for fit, _ in found]), looks

    def likeliest(self, fits: list[RegistrationResult]) -> RegistrationResult:
        """The likeliest of these fits and their others, by cost and prior of the pose.

        Its rivals are those that are less likely by ``RIVAL_COST`` at most and put the middle of a
        part where neither its covariance nor those of likelier rivals have it; its motion has their
        shares of the probability, ``exp(-cost / 2)``. ``beyond`` is the best fit in a pose that the
        case excludes, if it costs less; its share is 0. Of an organ that was turned over it is the
        best one that is not: only where that costs far more is it sure that it was.
        """
        every = [one for fit in fits for one in (fit, *fit.others)]
        first, *others = sorted(every, key=self._cost_with_prior)
        least, kept = self._cost_with_prior(first), [first]
        for other in others:
            if self._cost_with_prior(other) - least > RIVAL_COST:
                break
            if all(_is_distinct(other.motion, one.motion) for one in kept):
                kept.append(other)
        better = self._better_on_other_side(first, every)
        odds = [math.exp((least - self._cost_with_prior(one)) / 2) for one in kept]
        shares = [one / sum(odds) for one in odds]
        rivals = tuple(zip((one.motion for one in kept[1:]), shares[1:], strict=True))
        rivals += () if better is None else ((better.motion, 0.0),)
        motion = replace(first.motion, rivals=rivals)
        return replace(first, motion=motion, rivals=tuple(kept[1:]), beyond=better)

    def _better_on_other_side(
        self, first: RegistrationResult, every: list[RegistrationResult]
    ) -> RegistrationResult | None:
        """What speaks against the side on which a fit lies."""
        stated = self.prior.as_stated
        turned = bool(stated.excludes(first.motion.rotation))
        others = [one for one in every if stated.excludes(one.motion.rotation) != turned]
        best = min(others, key=lambda one: one.cost, default=None)
        most = first.cost * (_TURNED_RATIO if turned else 1.0)
        return best if best is not None and best.cost < most else None

    def _cost_with_prior(self, fit: RegistrationResult) -> float:
        """-2 log of a fit's probability, up to a constant."""
        return fit.cost + float(self.prior.cost(fit.motion.rotation))

    def _correct_cameras(self, looks: Looks, fit: RegistrationResult) -> CorrectedFit:
        """Further cameras and the motion in turns, from a fit with the cameras as stated."""
        if looks.count == 1:
            return fit, looks
        near = msgspec.structs.replace(looks.weighed(self.config), first_mm=self.config.last_mm)
        for _ in range(_CORRECTIONS):
            looks = looks.corrected(fit.motion, self.config)
            fit = refine(self.rest, looks.points_mm, fit.motion, near)
        costs = fit.cost + looks.cost, fit.cost_without_strays + looks.cost
        return replace(fit, cost=costs[0], cost_without_strays=costs[1]), looks

    def _refine_promising(
        self,
        points_mm: Points,
        starts: Sequence[tuple[ElasticMotion, Float64[np.ndarray, " 6"] | None]],
        against: Sequence[RegistrationResult],
    ) -> list[RegistrationResult]:
        """All starts are refined by a few steps; those that may still win, against each other and
        fits that are known, to the end. What the prior excludes gives nothing else up."""
        descents = [
            GaussNewton(self.rest, points_mm, start, self.config, moved) for start, moved in starts
        ]
        trial, steps = min(_TRIAL_STEPS, self.config.steps), self.config.steps
        parallel_map(lambda one: one.run(trial), descents)
        allowed = [
            descent.cost
            for (start, _), descent in zip(starts, descents, strict=True)
            if not self.prior.excludes(start.rotation)
        ]
        least = min((_TURNED_SHARE * fit.cost for fit in against), default=math.inf)
        most = _MAX_COST_RATIO * min([least, *allowed])
        left = [descent for descent in descents if descent.cost <= most]
        parallel_map(lambda one: one.run(steps), left)
        return [descent.result() for descent in left]


def _is_distinct(other: ElasticMotion, motion: ElasticMotion) -> bool:
    """Whether it puts the middle of a part outside the ellipsoid that holds 95 % of the other's
    covariance."""
    bent = np.abs(other.coefficients - motion.coefficients).max()
    if max(bent, apart_mm(other, motion)) < _SAME_MM:
        return False  # most are the same minimum, which is quickly said
    middles = motion.shape.middles_ct
    known = replace(motion, rivals=()).covariance_mm2(middles)
    assert known is not None
    away = other.carry(middles) - motion.carry(middles)
    return bool((np.linalg.solve(known, away[..., None])[..., 0] * away).sum(1).max() > _WITHIN)


def _turned_starts(
    fit: RegistrationResult,
) -> list[tuple[ElasticMotion, Float64[np.ndarray, " 6"]]]:
    """Turned both ways about each principal axis of the turn's covariance; shift and coefficients
    follow as they are correlated with the turn. With how far each has moved in all."""
    fitted, covariance = fit.motion, fit.motion.covariance
    assert covariance is not None
    variances, axes = np.linalg.eigh(covariance[3:6, 3:6])
    starts = []
    for variance, axis in zip(variances, axes.T, strict=True):
        for far in (_TURNED_STDS, -_TURNED_STDS):
            # The conditional mean, given a turn by so many deviations about this axis.
            off = covariance[:, 3:6] @ axis * far / math.sqrt(variance)
            start = replace(
                fitted,
                rotation=fitted.rotation @ turned_by(off[3:6]),
                centre_mm=fitted.centre_mm + fitted.rotation @ off[:3],
                coefficients=fitted.coefficients + off[6:],
            )
            starts.append((start, fit.moved + off[:6]))
    return starts
