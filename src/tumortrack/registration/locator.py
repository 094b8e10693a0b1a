"""Clouds -> estimates: which fit is made of a cloud or of a frame, and from where it starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat

import msgspec
import numpy as np

from tumortrack.core.cloud import FEWEST_POINTS
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import FEWEST_TOUCHES, Evidence
from tumortrack.core.report import SmoothingReport
from tumortrack.core.types import Anatomy, DepthError, Look, SensorCloud
from tumortrack.registration.bend import BentFit
from tumortrack.registration.estimate import EstimateMaker, Found
from tumortrack.registration.evidence import EvidenceTerms, Known, still_known
from tumortrack.registration.frame import Frame
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion, blend
from tumortrack.registration.registration import likeliest
from tumortrack.registration.search import PosePrior, apart_mm

_MOVED_MM = 2.5  # between live frames: what moves farther is found again from the start
_JUMP_MM = 10.0  # from one frame to the next: then it may have come to lie any way
_BEHIND_MM = 2.0  # a smoothed motion that lags by more starts again


class RegistrationLocator:
    """Locates by ``Registration``; its estimates have a motion."""

    def __init__(self, model: RegistrationModel) -> None:
        self._model, self._calibration = model, model.calibration
        self._registration = known = model.registration
        self._anyhow = replace(known, prior=replace(known.prior, tilt_degrees=180.0))
        self._turned_over = replace(known, prior=replace(known.prior, either_side=True))
        self._near = msgspec.structs.replace(model.config.refine, first_mm=_MOVED_MM)
        self.anatomy_ct: Anatomy | None = model.shape.anatomy_ct
        self._touchable = tuple(model.shape.anatomy_ct.closed)
        self._maker = EstimateMaker(model)

    def locate(
        self,
        looks: Sequence[Look],
        grid: int,
        seed: int,
        evidence: Sequence[Evidence] = (),
        any_pose: bool = False,
    ) -> Estimate:
        """See ``tracking.tracker.Tracker.locate``."""
        alone = isinstance(looks[0].seen, SensorCloud) and not len(looks[0].seen.points_mm)
        fewest = FEWEST_TOUCHES if alone else FEWEST_POINTS
        frame = Frame(self._model, looks[0].cloud, seed, np.random.default_rng(seed), fewest)
        points = self._points(frame, looks, evidence=EvidenceTerms.of(evidence, self._touchable))
        method = self._anyhow if any_pose else self._registration
        fit = method.register(points, None, frame.stage)
        found = self._found(fit, method.prior, tuple(evidence))
        return self._maker.estimate(frame, looks, found, self._bent(fit, frame), grid=grid)

    def follow(self, looks: Sequence[Look], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``tracking.tracker.Tracker.follow``."""
        stamp_ns = looks[0].cloud.stamp_ns
        rng = np.random.default_rng((how.seed, stamp_ns))
        frame = Frame(self._model, looks[0].cloud, how.seed, rng)
        # As many points in all as of one look: faster by half, and tumors within 0.05 mm as good.
        points = self._points(frame, looks, every=len(looks))
        found = self._fit_after(last, points, how, frame)
        bent = self._bent(found.fit, frame)
        bent, lag_s = self._smoothed(bent, last, stamp_ns, how.smoothing_s)
        smoothing = SmoothingReport(time_s=how.smoothing_s, lag_ms=1000 * lag_s)
        return self._maker.estimate(frame, looks, found, bent, smoothing)

    def warm(self) -> None:
        """See ``tracking.tracker.Tracker.warm``."""
        shape, method = self._model.shape, self._registration
        rest = ElasticMotion(shape, np.eye(3), np.array([0.0, 0.0, 150.0]), shape.body.mean)
        cloud = SensorCloud(rest.carry(shape.anatomy_ct.organ.vertices_mm))
        points = Frame(self._model, cloud, 0, np.random.default_rng(0)).points_mm
        looks = Looks.of([points])
        fit = method.best_fit(looks, [*method.search.starts(looks), rest])
        self._maker.warm(fit, method.bend(fit))
        for surface in range(len(self._touchable)):
            shape.field(surface)

    def _points(
        self,
        frame: Frame,
        looks: Sequence[Look],
        every: int = 1,
        evidence: EvidenceTerms | None = None,
    ) -> Looks:
        """What the fit takes of all looks; ``frame`` is the first one's."""
        more = [Frame(self._model, look.cloud, frame.seed, frame.rng) for look in looks[1:]]
        points_mm = [each.points_mm[::every] for each in (frame, *more)]
        poses = [look.camera_from_look for look in looks[1:]]
        candidates_mm = looks[0].cloud.candidates_mm
        noises = [look.cloud.noise for look in looks if look.cloud.noise is not None]
        errors = [look.cloud.depth_error for look in looks]
        stated = [error for error in errors if error is not None]
        worst = DepthError(*np.max(stated, axis=0)) if len(stated) == len(errors) else None
        return Looks.of(points_mm, poses, evidence, noises, candidates_mm, worst)

    def _fit_after(
        self, last: Estimate | None, looks: Looks, how: FollowOptions, frame: Frame
    ) -> Found:
        """The fit near the last motion and its rivals; of a search, where there is no last motion,
        or that fit is doubtful."""
        method = self._turned_over if how.either_side else self._registration
        start = None if last is None else last.unsmoothed
        if last is None or not isinstance(start, ElasticMotion):
            new = () if how.earlier else how.evidence
            looks = replace(looks, evidence=EvidenceTerms.of(new, self._touchable))
            found = self._found(method.register(looks, None, frame.stage), method.prior, new)
            if not how.earlier:
                return found
            before, pieces = still_known(how.earlier, found.shown)
            pieces += how.evidence
            fit = found.fit.beside(EvidenceTerms.of(pieces, self._touchable))
            return found._replace(fit=fit, pieces=pieces, before=before)
        with frame.stage("follow"):
            starts = [start, *(rival for rival, _ in start.rivals)]
            fits = [self._registration.follow(looks, near, self._near) for near in starts]
            shown = fits[0].motion
            before, pieces = still_known(last.evidence, shown)
            pieces += how.evidence
            looks = replace(looks, evidence=EvidenceTerms.of(pieces, self._touchable))
            fits = [fit.beside(looks.evidence) for fit in fits]
        fit, usual = likeliest(fits, method.prior), self._calibration.usual_cost * looks.count
        if looks.count == 1:
            fit = method.with_all_points(fit, looks, rounds=1)
        usual += looks.noise_cost(method.config)
        doubtful = fit.points_cost > usual or apart_mm(fit.motion, start) > _JUMP_MM
        # From one frame to the next nobody turns an organ over.
        if not doubtful and not self._registration.prior.excludes(fit.motion.rotation):
            method = self._registration
            fit = likeliest(fits, method.prior)
        if not doubtful and not how.thorough:
            return Found(fit, method.prior, fit.motion, pieces, before)
        if pieces:
            fit = self._registration.follow(looks, fit.motion, self._near)
        fit = method.register(looks, fit, frame.stage, again=not doubtful)
        if apart_mm(fit.motion, shown) > _JUMP_MM:  # the tissue hardly went there
            before = tuple(map(Known, pieces[: len(before)], repeat(fit.motion)))
        return self._found(fit, method.prior, pieces, before)

    def _found(
        self,
        fit: RegistrationResult,
        prior: PosePrior,
        pieces: tuple[Evidence, ...],
        before: tuple[Known, ...] = (),
    ) -> Found:
        """Of a search, in which evidence counted."""
        if not pieces:
            return Found(fit, prior, fit.motion)
        points = replace(fit.looks, evidence=None)
        shown = self._registration.follow(points, fit.motion, self._near).motion
        return Found(fit, prior, replace(shown, rivals=fit.motion.rivals), pieces, before)

    def _bent(self, fit: RegistrationResult, frame: Frame) -> BentFit:
        """In the body's compliance. Raises NotThisOrgan."""
        self._registration.check(fit, self._model.in_distribution)
        with frame.stage("bend"):
            return self._registration.bend(fit)

    def _smoothed(
        self, bent: BentFit, last: Estimate | None, stamp_ns: int, smoothing_s: float
    ) -> tuple[BentFit, float]:
        """With the mean over past motions, and by how many seconds that lags behind what moves
        steadily; a mean that lies too far behind is left out."""
        if last is None or not isinstance(last.motion, ElasticMotion) or smoothing_s <= 0:
            return bent, 0.0
        past_s = (stamp_ns - last.cloud.stamp_ns) * 1e-9
        share = -math.expm1(-past_s / smoothing_s)
        mean = blend(last.motion, bent.motion, share)
        samples_ct = self._maker.samples_ct
        behind_mm = mean.carry(samples_ct) - bent.motion.carry(samples_ct)
        if np.linalg.norm(behind_mm, axis=1).max() >= _BEHIND_MM:
            return bent, 0.0
        return replace(bent, motion=mean), past_s * (1 - share) / share
