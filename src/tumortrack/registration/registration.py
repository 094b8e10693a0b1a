"""The method `clinic`, read top to bottom: from a cloud of one side to the whole organ.

1. A network makes two hypotheses of where the organ lies and how it is deformed (`network`).
2. Gauss-Newton lays the organ's surface on the points from each of them (`gauss_newton`), with a
   robust kernel; the one that fits best is kept.
3. The fit is repeated from starts beside it, turned where its turn is least certain: one side
   leaves the turn about the organ's long axis nearly free, and there are local minima on the way.
4. Other minima that explain the points nearly as well, and put a tumor elsewhere, are kept.
5. In a first look, and where even that fits badly, the organ is looked for all around: what hides a
   part of it moves the middle and the longest direction of what is seen, and misleads the network.
   An organ that was seen a moment ago may have been turned over, which no organ in training was.
6. An organ that looks much the same after half a turn is tried that way round, too.

The result is a motion (`motion`): any point of the CT, carried to the camera's frame and back,
with its uncertainty. `locator` reads surfaces, labels and numbers off it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import Points, transform_points
from tumortrack.core.process import parallel_map
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.models.in_distribution import RIVAL_COST
from tumortrack.registration.gauss_newton import GaussNewton, RegistrationResult, refine
from tumortrack.registration.looks import Looks, seen_from_first
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.rest_shape import RestShape

Timer = Callable[[str], AbstractContextManager[object]]
Laid = tuple[RegistrationResult, Looks]  # a fit, with the further cameras where it has them

_FLIP_MARGIN = 6.0  # logits: beyond this lead the other way round is not tried
_FARTHEST_MM = 1e5  # of the organ's middle
# Looking around. Of 14 organs partly hidden (the wider world's) that were lost in another minimum,
# though their true place fits better, this finds 9; five tilts of 25 degrees more find 10 or 11.
_TURNS = 12  # about the camera's axis
_ALONG = -0.25, 0.0, 0.25  # of the organ's length, along it
_FEW_POINTS, _STIFF_STEPS, _FIRST_MM = 250, 8, 10.0  # of these descents, which need not be exact
_KEPT, _APART_MM = 6, 5.0  # of the best, so far apart; refined as the hypotheses are
# Standard deviations to both sides. Of 1,200 first looks at a moving phantom, by the training's own
# physics, some 4 in 100 were 3 to 7 mm off without such starts, 6 with starts at 3 deviations, and
# none at 4.5 or 6.
_BESIDE = 4.5

# On 840 clouds of four organs (drags, elastic states, the digital twin's) the eventual winner's
# cost after six steps was at most 2.5 times the least (turned starts: twice). Two thirds of the
# wrong ways round were above three times.
_TRIAL_STEPS = 6
_MAX_COST_RATIO = 3.0  # to the least cost: hypotheses above are given up
_TURNED_SHARE = 2 / 3  # of that, for turned starts, which a whole fit races

_CORRECTIONS = 3  # of cameras and motion in turns: more move nothing by a tenth of a millimetre

_WITHIN = 7.81  # 95 % of chi squared with three degrees of freedom
_SAME_MM = 0.2  # descents that end in one minimum end within some last steps (enough_mm, 0.02)


@dataclass(frozen=True, eq=False)
class Registration:
    """The organ at rest, laid on clouds (camera frame, mm) that show one side of it.
    ``either_side``: looking around, it is also turned over."""

    network: RegistrationNetwork
    rest: RestShape
    config: GaussNewtonConfig
    either_side: bool = False

    def register(
        self, looks: Looks, usual_cost: float = math.inf, timed: Timer = nullcontext
    ) -> Laid:
        """The whole method for one or several looks at a still organ, each of which proposes; and
        the looks as the further cameras are corrected then. ``timed("encode")`` and
        ``timed("refine")`` time its halves."""
        with timed("encode"):
            hypotheses = []
            for n, pose in enumerate(looks.camera_from_look):
                seen = transform_points(np.linalg.inv(pose), looks.points_mm[looks.look == n])
                hypotheses += [seen_from_first(one, pose) for one in self.propose(seen)]
        whole = replace(self, config=looks.weighed(self.config))
        with timed("refine"):
            fit = whole.best_fit(looks.points_mm, hypotheses, usual_cost)
            if looks.count == 1:
                return fit, looks
            # Each with its own places of the cameras.
            return best_laid([self._laid(looks, one) for one in (fit, *fit.rivals)])

    def follow(self, looks: Looks, start: ElasticMotion, config: GaussNewtonConfig) -> Laid:
        """The fit near a motion, and the looks as the further cameras are corrected then."""
        fit = refine(self.rest, looks.points_mm, start, looks.weighed(config))
        return self._laid(looks, fit)

    def _laid(self, looks: Looks, fit: RegistrationResult) -> Laid:
        """Further cameras and the motion in turns, from a fit with the cameras as stated."""
        if looks.count == 1:
            return fit, looks
        near = msgspec.structs.replace(looks.weighed(self.config), first_mm=self.config.last_mm)
        for _ in range(_CORRECTIONS):
            looks = looks.corrected(fit.motion, self.config)
            fit = refine(self.rest, looks.points_mm, fit.motion, near)
        costs = fit.cost + looks.cost, fit.cost_without_strays + looks.cost
        return replace(fit, cost=costs[0], cost_without_strays=costs[1]), looks

    @torch.no_grad()
    def propose(self, points_mm: Points) -> list[ElasticMotion]:
        """The network's hypotheses, the likelier first; the second only where it may be right."""
        device = next(self.network.parameters()).device
        cloud = torch.tensor(np.asarray(points_mm, np.float32), device=device)[None]
        # One thread for a network so small that a second saves nothing: that would wait busily for
        # more work, milliseconds long, on the core where the refinement is to run. The number is
        # the whole process's: nothing else should start to use torch meanwhile.
        threads = torch.get_num_threads()
        torch.set_num_threads(1 if device.type == "cpu" else threads)
        try:
            found = self.network.flip_hypotheses(cloud)
        finally:
            torch.set_num_threads(threads)
        if not (
            all(bool(part.isfinite().all()) for part in found)
            and float(found.centre_mm.abs().max()) < _FARTHEST_MM
        ):
            raise NoEstimate(
                "the network places the organ nowhere (a number that is not finite, or far away). "
                "Train the model again: tumortrack train CASE MODEL."
            )
        likelier = int(found.right_way[1] > found.right_way[0])
        lead = float(found.right_way[likelier] - found.right_way[1 - likelier])
        parts = (found.rotation, found.centre_mm, found.coefficients)
        rotations, centres, coefficients = (part.double().cpu().numpy() for part in parts)
        return [
            ElasticMotion(self.rest, rotations[n], centres[n], coefficients[n])
            for n in ([likelier] if lead > _FLIP_MARGIN else [likelier, 1 - likelier])
        ]

    def best_fit(
        self, points_mm: Points, hypotheses: list[ElasticMotion], usual_cost: float = math.inf
    ) -> RegistrationResult:
        """The hypothesis that fits best, refined; give the likeliest one first. Above
        ``usual_cost`` the organ is looked for all around."""
        fit = self._settle(points_mm, self._race(points_mm, [(one, None) for one in hypotheses]))
        if fit.cost > usual_cost:
            fit = self.look_around(points_mm, hypotheses[0], fit)
        turned = [(self._half_turned(fit.motion, turn), None) for turn in self.rest.half_turns]
        if not turned:
            return fit
        return best_of([fit, self._settle(points_mm, self._race(points_mm, turned))])

    def look_around(
        self, points_mm: Points, likeliest: ElasticMotion, fit: RegistrationResult
    ) -> RegistrationResult:
        """The best of a fit and those from many more places: the likeliest hypothesis turned all
        around the camera's axis and moved along the organ, first as a nearly stiff body that
        follows few points."""
        angles, stiff = np.arange(_TURNS) * 360 / _TURNS, self.rest.stiff
        turns = Rotation.from_euler("z", angles[:, None], degrees=True).as_matrix()
        across = self.rest.long_axis * np.ptp(
            self.rest.anatomy_ct.organ.vertices_mm @ self.rest.long_axis
        )
        config = msgspec.structs.replace(self.config, first_mm=_FIRST_MM)
        over = Rotation.from_rotvec(np.pi * self.rest.long_axis).as_matrix()
        sides = [np.eye(3), over] if self.either_side else [np.eye(3)]
        descents = []
        for rotation in np.concatenate([turns @ likeliest.rotation @ side for side in sides]):
            for share in _ALONG:
                place = likeliest.centre_mm + share * (rotation @ across) * [1, 1, 0]
                start = ElasticMotion(stiff, rotation, place, stiff.body.mean)
                descents.append(GaussNewton(stiff, points_mm[:_FEW_POINTS], start, config))
        parallel_map(lambda one: one.run(_STIFF_STEPS), descents)
        found: list[ElasticMotion] = []
        for descent in sorted(descents, key=_cost):
            motion = descent.result().motion
            if len(found) < _KEPT and all(_apart_mm(motion, one) > _APART_MM for one in found):
                found.append(motion)
        mean = self.rest.body.mean
        starts = [ElasticMotion(self.rest, m.rotation, m.centre_mm, mean) for m in found]
        others = self._race(points_mm, [(one, None) for one in starts], fit.cost * _TURNED_SHARE)
        best = best_of([fit, *others])
        elsewhere = _elsewhere(best.motion, fit.motion)
        return self._settle(points_mm, [fit, *others]) if elsewhere else best

    def _half_turned(
        self, motion: ElasticMotion, turn: Float64[np.ndarray, "4 4"]
    ) -> ElasticMotion:
        """The undeformed organ in the same place, turned by this motion of the CT."""
        middle_ct = self.rest.body.center_ct
        off = motion.rotation @ (turn[:3, :3] @ middle_ct + turn[:3, 3] - middle_ct)
        rotation, place = motion.rotation @ turn[:3, :3], motion.centre_mm + off
        return ElasticMotion(self.rest, rotation, place, self.rest.body.mean)

    def _settle(self, points_mm: Points, fits: list[RegistrationResult]) -> RegistrationResult:
        """The best of some fits and of those from starts beside the best."""
        beside = _beside(min(fits, key=_cost))
        return best_of(fits + self._race(points_mm, beside))

    def _race(
        self,
        points_mm: Points,
        starts: Sequence[tuple[ElasticMotion, Float64[np.ndarray, " 6"] | None]],
        least: float = math.inf,
    ) -> list[RegistrationResult]:
        """All starts are refined by a few steps; those that may still win, against each other and
        what costs ``least``, to the end."""
        descents = [
            GaussNewton(self.rest, points_mm, start, self.config, moved) for start, moved in starts
        ]
        trial, steps = min(_TRIAL_STEPS, self.config.steps), self.config.steps
        parallel_map(lambda one: one.run(trial), descents)
        most = _MAX_COST_RATIO * min(least, *(descent.cost for descent in descents))
        left = [descent for descent in descents if descent.cost <= most]
        parallel_map(lambda one: one.run(steps), left)
        return [descent.result() for descent in left]


def best_laid(found: list[Laid]) -> Laid:
    """``best_of`` the fits, and its looks."""
    return best_of([fit for fit, _ in found]), min(found, key=lambda laid: laid[0].cost)[1]


def best_of(fits: list[RegistrationResult]) -> RegistrationResult:
    """The fit that costs least of these and their rivals. Its rivals are those that cost at most
    ``RIVAL_COST`` more and put the middle of a part where neither its covariance nor those of
    cheaper rivals have it; its motion has their shares of the probability, ``exp(-cost / 2)``."""
    first, *others = sorted((one for fit in fits for one in (fit, *fit.rivals)), key=_cost)
    kept = [first]
    for other in others:
        if other.cost - first.cost > RIVAL_COST:
            break
        if all(_elsewhere(other.motion, one.motion) for one in kept):
            kept.append(other)
    odds = [math.exp((first.cost - one.cost) / 2) for one in kept]
    shares = [one / sum(odds) for one in odds]
    rivals = tuple(zip((one.motion for one in kept[1:]), shares[1:], strict=True))
    return replace(first, motion=replace(first.motion, rivals=rivals), rivals=tuple(kept[1:]))


def _elsewhere(other: ElasticMotion, motion: ElasticMotion) -> bool:
    """Whether it puts the middle of a part outside the ellipsoid that holds 95 % of the other's
    covariance."""
    bent = np.abs(other.coefficients - motion.coefficients).max()
    if max(bent, _apart_mm(other, motion)) < _SAME_MM:
        return False  # most are the same minimum, which is quickly said
    middles = motion.shape.middles_ct
    known = replace(motion, rivals=()).covariance_mm2(middles)
    assert known is not None
    away = other.carry(middles) - motion.carry(middles)
    return bool((np.linalg.solve(known, away[..., None])[..., 0] * away).sum(1).max() > _WITHIN)


def _apart_mm(other: ElasticMotion, motion: ElasticMotion) -> float:
    """How far the poses have the centre, or a point 50 mm from it, apart, about."""
    turned = 50 * np.abs(other.rotation - motion.rotation).max()
    return float(max(turned, np.abs(other.centre_mm - motion.centre_mm).max()))


def _cost(fit: RegistrationResult | GaussNewton) -> float:
    return fit.cost


def _beside(fit: RegistrationResult) -> list[tuple[ElasticMotion, Float64[np.ndarray, " 6"]]]:
    """Turned both ways about each principal axis of the turn's covariance; shift and coefficients
    follow as they are correlated with the turn. With how far each has moved in all."""
    fitted, covariance = fit.motion, fit.motion.covariance
    assert covariance is not None
    variances, axes = np.linalg.eigh(covariance[3:6, 3:6])
    starts = []
    for variance, axis in zip(variances, axes.T, strict=True):
        for far in (_BESIDE, -_BESIDE):
            # The conditional mean, given a turn by so many deviations about this axis.
            off = covariance[:, 3:6] @ axis * far / math.sqrt(variance)
            start = replace(
                fitted,
                rotation=fitted.rotation @ Rotation.from_rotvec(off[3:6]).as_matrix(),
                centre_mm=fitted.centre_mm + fitted.rotation @ off[:3],
                coefficients=fitted.coefficients + off[6:],
            )
            starts.append((start, fit.moved + off[:6]))
    return starts
