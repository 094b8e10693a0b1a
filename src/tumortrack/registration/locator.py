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
from tumortrack.core.types import Anatomy, DepthError, SensorCloud, View
from tumortrack.core.ultrasound import ProbeRecording
from tumortrack.registration.compliance import RefinedFit
from tumortrack.registration.estimate import EstimateMaker, Found
from tumortrack.registration.evidence import EvidenceTerms, TrackedEvidence, propagate
from tumortrack.registration.flap import carried_over
from tumortrack.registration.frame import Frame
from tumortrack.registration.gauss_newton import RegistrationResult, prior_precision
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import POSE, ElasticMotion, blend
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.probe import FoundErrors, find_errors
from tumortrack.registration.registration import Registration, select_best
from tumortrack.registration.search import PosePrior, distance_mm

_MOVED_MM = 2.5  # between live frames: what moves farther is found again from the start
_JUMP_MM = 10.0  # from one frame to the next: then it may have come to lie any way
_BEHIND_MM = 2.0  # a smoothed motion that lags by more starts again


class RegistrationLocator:
    """Locates by ``Registration``; its estimates have a motion."""

    def __init__(self, model: RegistrationModel) -> None:
        self._model, self._calibration = model, model.calibration
        self._registration = known = model.registration
        self._anyhow = replace(known, prior=replace(known.prior, tilt_degrees=180.0))
        self._turned_over = replace(known, prior=replace(known.prior, allow_flip=True))
        self._near = msgspec.structs.replace(model.config.refine, first_mm=_MOVED_MM)
        self.anatomy_ct: Anatomy | None = model.shape.anatomy_ct
        self._touchable = tuple(model.shape.anatomy_ct.closed)
        self._maker = EstimateMaker(model)

    def locate(
        self,
        views: Sequence[View],
        grid: int,
        seed: int,
        evidence: Sequence[Evidence] = (),
        any_pose: bool = False,
    ) -> Estimate:
        """See ``tracking.tracker.Tracker.locate``."""
        frame, fit, method = self._registered(views, seed, evidence, any_pose)
        found = self._found(fit, method.prior, tuple(evidence))
        return self._maker.estimate(frame, views, found, self._refined(fit, frame), grid=grid)

    def errors_of(
        self,
        recording: ProbeRecording,
        views: Sequence[View],
        seed: int,
        evidence: Sequence[Evidence],
        any_pose: bool,
    ) -> FoundErrors:
        """What is wrong in all images of a recording, beside what else is known of a still organ:
        ``views`` and ``evidence``, or, where these are the recording's own places, its elasticity
        alone."""
        frame, fit, _ = self._registered(views, seed, evidence, any_pose)
        if views[0].of_no_camera:
            shape = fit.motion.shape
            precision = prior_precision(shape, self._model.config.refine)
            precision[:POSE] = precision[:, :POSE] = 0.0  # it may lie anywhere
            off = np.append(np.zeros(POSE), fit.motion.coefficients - shape.body.mean)
            return find_errors(recording, fit.motion, precision, off)
        motion = self._refined(fit, frame).motion
        assert motion.covariance is not None
        precision = np.linalg.inv(motion.covariance)
        return find_errors(recording, motion, precision, np.zeros(len(precision)))

    def follow(self, views: Sequence[View], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``tracking.tracker.Tracker.follow``."""
        stamp_ns = views[0].cloud.stamp_ns
        rng = np.random.default_rng((how.seed, stamp_ns))
        frame = Frame(self._model, views[0].cloud, how.seed, rng)
        # As many points in all as of one view: faster by half, and tumors within 0.05 mm as good.
        points = self._points(frame, views, every=len(views))
        found = self._fit_after(last, points, how, frame)
        refined = self._refined(found.fit, frame)
        refined, lag_s = self._smoothed(refined, last, stamp_ns, how.smoothing_s)
        smoothing = SmoothingReport(time_s=how.smoothing_s, lag_ms=1000 * lag_s)
        return self._maker.estimate(frame, views, found, refined, smoothing)

    def warm(self) -> None:
        """See ``tracking.tracker.Tracker.warm``."""
        shape, method = self._model.shape, self._registration
        rest = ElasticMotion(shape, np.eye(3), np.array([0.0, 0.0, 150.0]), shape.body.mean)
        cloud = SensorCloud(rest.forward(shape.anatomy_ct.organ.vertices_mm))
        points = Frame(self._model, cloud, 0, np.random.default_rng(0)).points_mm
        views = MultiViewCloud.from_points([points])
        fit = method.best_fit(views, [*method.search.starts(views), rest])
        self._maker.warm(fit, method.refine_compliance(fit))
        for surface in range(len(self._touchable)):
            shape.field(surface)

    def _registered(
        self, views: Sequence[View], seed: int, evidence: Sequence[Evidence], any_pose: bool
    ) -> tuple[Frame, RegistrationResult, Registration]:
        fewest = FEWEST_TOUCHES if views[0].of_no_camera else FEWEST_POINTS
        frame = Frame(self._model, views[0].cloud, seed, np.random.default_rng(seed), fewest)
        points = self._points(
            frame, views, evidence=EvidenceTerms.from_evidence(evidence, self._touchable)
        )
        method = self._anyhow if any_pose else self._registration
        return frame, method.register(points, None, frame.stage), method

    def _points(
        self,
        frame: Frame,
        views: Sequence[View],
        every: int = 1,
        evidence: EvidenceTerms | None = None,
    ) -> MultiViewCloud:
        """What the fit takes of all views; ``frame`` is the first one's."""
        more = [Frame(self._model, view.cloud, frame.seed, frame.rng) for view in views[1:]]
        points_mm = [each.points_mm[::every] for each in (frame, *more)]
        poses = [view.camera_from_view for view in views[1:]]
        candidates_mm = views[0].cloud.candidates_mm
        noises = [view.cloud.noise for view in views if view.cloud.noise is not None]
        errors = [view.cloud.depth_error for view in views]
        stated = [error for error in errors if error is not None]
        worst = DepthError(*np.max(stated, axis=0)) if len(stated) == len(errors) else None
        return MultiViewCloud.from_points(points_mm, poses, evidence, noises, candidates_mm, worst)

    def _fit_after(
        self, last: Estimate | None, views: MultiViewCloud, how: FollowOptions, frame: Frame
    ) -> Found:
        """The fit near the last motion and its alternatives; of a search, where there is no last
        motion, or that fit is doubtful."""
        method = self._turned_over if how.allow_flip else self._registration
        start = None if last is None else last.unsmoothed
        if last is None or not isinstance(start, ElasticMotion):
            new = () if how.earlier else how.evidence
            views = replace(views, evidence=EvidenceTerms.from_evidence(new, self._touchable))
            found = self._found(method.register(views, None, frame.stage), method.prior, new)
            if not how.earlier:
                return found
            before, pieces = propagate(how.earlier, found.shown)
            pieces += how.evidence
            fit = found.fit.with_evidence(EvidenceTerms.from_evidence(pieces, self._touchable))
            return found._replace(fit=fit, pieces=pieces, before=before)
        if start.shape is not self._model.shape:  # more was cut since
            start = carried_over(start, self._model.shape)
        with frame.stage("follow"):
            starts = [start, *(alternative for alternative, _ in start.alternatives)]
            fits = [self._registration.follow(views, near, self._near) for near in starts]
            shown = fits[0].motion
            before, pieces = propagate(last.evidence, shown)
            pieces += how.evidence
            views = replace(views, evidence=EvidenceTerms.from_evidence(pieces, self._touchable))
            fits = [fit.with_evidence(views.evidence) for fit in fits]
        fit, usual = select_best(fits, method.prior), self._calibration.usual_cost * views.count
        if views.count == 1:
            fit = method.with_all_points(fit, views, rounds=1)
        usual += views.noise_cost(method.config)
        doubtful = fit.points_cost > usual or distance_mm(fit.motion, start) > _JUMP_MM
        # From one frame to the next nobody turns an organ over.
        if not doubtful and not self._registration.prior.excludes(fit.motion.rotation):
            method = self._registration
            fit = select_best(fits, method.prior)
        if not doubtful and not how.global_search:
            return Found(fit, method.prior, fit.motion, pieces, before)
        if pieces:
            fit = self._registration.follow(views, fit.motion, self._near)
        fit = method.register(views, fit, frame.stage, again=not doubtful)
        if distance_mm(fit.motion, shown) > _JUMP_MM:  # the tissue hardly went there
            before = tuple(map(TrackedEvidence, pieces[: len(before)], repeat(fit.motion)))
        return self._found(fit, method.prior, pieces, before)

    def _found(
        self,
        fit: RegistrationResult,
        prior: PosePrior,
        pieces: tuple[Evidence, ...],
        before: tuple[TrackedEvidence, ...] = (),
    ) -> Found:
        """Of a search, in which evidence counted."""
        if not pieces:
            return Found(fit, prior, fit.motion)
        points = replace(fit.views, evidence=None)
        shown = self._registration.follow(points, fit.motion, self._near).motion
        return Found(
            fit, prior, replace(shown, alternatives=fit.motion.alternatives), pieces, before
        )

    def _refined(self, fit: RegistrationResult, frame: Frame) -> RefinedFit:
        """In the body's compliance. Raises NotThisOrgan."""
        self._registration.check(fit, self._model.in_distribution)
        with frame.stage("compliance"):
            return self._registration.refine_compliance(fit)

    def _smoothed(
        self, refined: RefinedFit, last: Estimate | None, stamp_ns: int, smoothing_s: float
    ) -> tuple[RefinedFit, float]:
        """With the mean over past motions, and by how many seconds that lags behind what moves
        steadily; a mean that lies too far behind is left out."""
        if last is None or not isinstance(last.motion, ElasticMotion) or smoothing_s <= 0:
            return refined, 0.0
        if last.motion.shape is not refined.motion.shape:  # more was cut since
            return refined, 0.0
        past_s = (stamp_ns - last.cloud.stamp_ns) * 1e-9
        share = -math.expm1(-past_s / smoothing_s)
        mean = blend(last.motion, refined.motion, share)
        samples_ct = self._maker.samples_ct
        behind_mm = mean.forward(samples_ct) - refined.motion.forward(samples_ct)
        if np.linalg.norm(behind_mm, axis=1).max() >= _BEHIND_MM:
            return refined, 0.0
        return replace(refined, motion=mean), past_s * (1 - share) / share
