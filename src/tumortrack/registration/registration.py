"""The method `elastic`, in the order in which it runs: from points of one side to the whole organ.

1. Search (`search`): a rigid organ is fitted to few points from starts all around.
2. Fit (`gauss_newton`): from the best of these the elastic body's surface is fitted to the points,
   with a robust kernel; and again from starts beside the best fit, turned where its turn is least
   certain: one side leaves the turn about the organ's long axis nearly free, and there are local
   minima on the way. Of an organ that is cut (`flap`) also with its flap moved.
3. Correct (`multi_view`): where there are several cameras, their places and the motion in turns.
4. Choose (`select_best`, below): by cost, and by how the organ may lie, which the case says. Other
   minima that explain the points nearly as well, and put a tumor elsewhere, are kept as
   alternatives; one that explains them better in a pose that the case excludes makes the answer
   poor.
5. Verdict (`registration.in_distribution`): what cannot be this organ is refused.
6. Compliance (`compliance`): what the library's states cannot follow, the body's compliance does;
   with it, what points and evidence leave open.

The result is a motion (`motion`): any point of the CT, carried to the camera's frame and back, with
its uncertainty. `estimate` makes surfaces, labels and a report of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np

from tumortrack.core.process import parallel_map
from tumortrack.organ.rest_shape import RestShape
from tumortrack.registration.compliance import RefinedFit, refine_compliance
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.flap import flap_starts, with_flaps_moved, with_points_of_flaps
from tumortrack.registration.gauss_newton import (
    FARTHEST,
    GaussNewton,
    RegistrationResult,
    refine,
)
from tumortrack.registration.in_distribution import (
    RIVAL_COST,
    InDistributionRange,
    check_in_distribution,
    check_likely,
)
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.search import (
    PosePrior,
    Search,
    Start,
    distance_mm,
    far_from,
    turned_starts,
)

Timer = Callable[[str], AbstractContextManager[object]]

# What these limits rest on: docs/decisions/034-limits.md.
_TRIAL_STEPS = 6
_MAX_COST_RATIO = 3.0  # to the least cost: starts above are given up
_TURNED_SHARE = 2 / 3  # of that, for turned starts, which compete with a finished fit
_ROUNDS = 4  # of choosing points and fitting: what lies on the organ is known after two or three
_SAME_POINTS = 0.01  # share of the points: the fit no longer moves by them
_TURNED_RATIO = 2.0  # of an organ that was turned over the upright fit costs so many times as much
_WITHIN = 7.81  # 95 % of chi squared with three degrees of freedom
_SAME_MM = 0.2  # descents that end in one minimum end within some last steps (enough_mm, 0.02)
_CORRECTIONS = 3  # of cameras and motion in turns: more move nothing by a tenth of a millimetre


@dataclass(frozen=True, eq=False)
class Registration:
    """The organ at rest, fitted to points of one side of it."""

    rest: RestShape
    config: GaussNewtonConfig
    prior: PosePrior

    @cached_property
    def search(self) -> Search:
        """Over all poses of the prior, and beyond it."""
        return Search(self.rest, self.prior)

    def register(
        self,
        views: MultiViewCloud,
        known: RegistrationResult | None = None,
        timed: Timer = nullcontext,
        again: bool = False,
    ) -> RegistrationResult:
        """The most likely fit to one or several looks at a still organ, wherever it lies.

        Args:
            known: a fit of these views, which is kept if it is best.
            timed: times the stages ``search`` and ``refine``.
            again: there is no reason to doubt ``known``: see ``Search.starts``.
        """
        with timed("search"):
            starts = self.search.starts(views, again)
        with timed("refine"):
            best = self.best_fit(views, starts, known, again)
            if views.count == 1:
                found = (best, views) if again else self._with_flap(best, views)
                return self.with_all_points(*found)
            fits = [self._correct_cameras(views, fit) for fit in (best, *best.others)]
            return select_best(fits if known is None else [known, *fits], self.prior)

    def with_all_points(
        self, fit: RegistrationResult, views: MultiViewCloud, rounds: int = _ROUNDS
    ) -> RegistrationResult:
        """The fit, and its alternatives', to all points that lie on the organ: those of ``views``
        and the candidates that the fit shows to be the organ's, too; until they stay the same."""
        near = msgspec.structs.replace(self.config, first_mm=self.config.last_mm)
        count = len(fit.views.points_mm)
        for _ in range(rounds):
            more = views.with_points_on(fit.motion, FARTHEST * views.width_mm(self.config))
            if abs(len(more.points_mm) - count) <= _SAME_POINTS * count:
                break
            count = len(more.points_mm)
            fits = [
                GaussNewton(self.rest, more, each.motion, near, each.pose_offset)
                for each in (fit, *fit.others)
            ]
            parallel_map(lambda descent: descent.run(near.steps), fits)
            fit = select_best([descent.result() for descent in fits], self.prior)
        return fit

    def _with_flap(
        self, fit: RegistrationResult, views: MultiViewCloud
    ) -> tuple[RegistrationResult, MultiViewCloud]:
        """Of an organ that was cut: a flap that was lifted is a piece of its own in the image, so
        the points near where it was are fitted, too; the fit, and the views with these."""
        more = with_points_of_flaps(fit.motion, views)
        if more is views:
            return fit, views
        starts = [Start(motion) for motion in flap_starts(more, [fit.motion], self.config)]
        fits = self._fit_promising(more, [Start(fit.motion, fit.pose_offset), *starts], ())
        return select_best(fits, self.prior), more

    def follow(
        self, views: MultiViewCloud, start: ElasticMotion, config: GaussNewtonConfig
    ) -> RegistrationResult:
        """The fit near a motion."""
        return self._correct_cameras(views, refine(self.rest, views, start, config))

    def refine_compliance(self, fit: RegistrationResult) -> RefinedFit:
        """A fit in the body's compliance."""
        return refine_compliance(fit, self.config)

    def check(self, fit: RegistrationResult, usual: InDistributionRange) -> None:
        """Raises NotThisOrgan: points or deformation are none of this organ's."""
        for n in range(fit.views.count):
            mine = fit.views.view == n
            points_mm, distances_mm = fit.views.points_mm[mine], np.abs(fit.distances_mm[mine])
            check_in_distribution(usual, points_mm, distances_mm, registered=True)
        check_likely(fit.motion.normalized_mahalanobis)

    def best_fit(
        self,
        views: MultiViewCloud,
        starts: Sequence[ElasticMotion],
        known: RegistrationResult | None = None,
        again: bool = False,
    ) -> RegistrationResult:
        """The most likely fit with the cameras as stated, from all starts and from some beside the
        best. ``known``: a fit of before; ``again``: there is no reason to doubt it, so that a cut
        organ's flaps are not searched for."""
        fits = [] if known is None else [known]
        new = [Start(motion) for motion in starts if far_from(motion, [fit.motion for fit in fits])]
        if not again:
            new += map(Start, flap_starts(views, starts, self.config))
        fits += self._fit_promising(views, new, fits)
        best = min(fits, key=lambda fit: cost_with_prior(fit, self.prior))
        turned = turned_starts(best.motion, best.pose_offset)
        if not again:
            turned += [Start(motion, best.pose_offset) for motion in with_flaps_moved(best.motion)]
        fits += self._fit_promising(views, turned, fits)
        return select_best(fits, self.prior)

    def _fit_promising(
        self, views: MultiViewCloud, starts: Sequence[Start], against: Sequence[RegistrationResult]
    ) -> list[RegistrationResult]:
        """All starts are refined by a few steps; those that may still win, against each other and
        known fits, to the end. What the prior excludes gives nothing else up."""
        descents = [
            GaussNewton(self.rest, views, start.motion, self.config, start.pose_offset)
            for start in starts
        ]
        trial, steps = min(_TRIAL_STEPS, self.config.steps), self.config.steps
        parallel_map(lambda descent: descent.run(trial), descents)
        allowed = [
            descent.cost
            for start, descent in zip(starts, descents, strict=True)
            if not self.prior.excludes(start.motion.rotation)
        ]
        least = min((_TURNED_SHARE * fit.cost for fit in against), default=math.inf)
        most = _MAX_COST_RATIO * min([least, *allowed])
        promising = [descent for descent in descents if descent.cost <= most]
        parallel_map(lambda descent: descent.run(steps), promising)
        return [descent.result() for descent in promising]

    def _correct_cameras(
        self, views: MultiViewCloud, fit: RegistrationResult
    ) -> RegistrationResult:
        """Further cameras and the motion in turns, from a fit with the cameras as stated."""
        if views.count == 1:
            return fit
        near = msgspec.structs.replace(self.config, first_mm=self.config.last_mm)
        for _ in range(_CORRECTIONS):
            views = views.corrected(fit.motion, self.config)
            fit = refine(self.rest, views, fit.motion, near)
        costs = fit.cost + views.cost, fit.cost_without_strays + views.cost
        return replace(fit, cost=costs[0], cost_without_strays=costs[1])


def cost_with_prior(fit: RegistrationResult, prior: PosePrior) -> float:
    """-2 log of a fit's probability, up to a constant."""
    return fit.cost + float(prior.cost(fit.motion.rotation))


def select_best(fits: Sequence[RegistrationResult], prior: PosePrior) -> RegistrationResult:
    """The most likely of these fits and their others, by cost and prior of the pose.

    Its alternatives are those that are less likely by ``RIVAL_COST`` at most and put the middle of
    a part where neither its covariance nor those of likelier alternatives have it; its motion has
    their shares of the probability, ``exp(-cost / 2)``. ``excluded_pose`` is the best fit in a pose
    that the case excludes, if it costs less; its share is 0. Of an organ that was turned over it is
    the best one that is not: only where that costs far more is it sure that it was.
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
    excluded_pose = _better_on_other_side(first, everything, prior)
    odds = [math.exp((costs[id(first)] - costs[id(fit)]) / 2) for fit in kept]
    shares = [each / sum(odds) for each in odds]
    alternatives = tuple(zip((fit.motion for fit in kept[1:]), shares[1:], strict=True))
    alternatives += () if excluded_pose is None else ((excluded_pose.motion, 0.0),)
    motion = replace(first.motion, alternatives=alternatives)
    return replace(first, motion=motion, alternatives=tuple(kept[1:]), excluded_pose=excluded_pose)


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
    refined = np.abs(other.coefficients - motion.coefficients).max()
    if max(refined, distance_mm(other, motion)) < _SAME_MM:
        return False  # most are the same minimum, which is quickly found
    middles = motion.shape.middles_ct
    covariance = replace(motion, alternatives=()).covariance_mm2(middles)
    assert covariance is not None
    away = other.forward(middles) - motion.forward(middles)
    squares = (np.linalg.solve(covariance, away[..., None])[..., 0] * away).sum(1)
    return bool(squares.max() > _WITHIN)
