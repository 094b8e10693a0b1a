"""Clouds -> estimates: surfaces, labels and a report, all made of the fitted motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import FEWEST_TOUCHES, Evidence
from tumortrack.core.geometry import largest_std_of
from tumortrack.core.report import EvidenceReport, FitReport, NextEvidence, SizeFit, SmoothingReport
from tumortrack.core.types import (
    Anatomy,
    CameraLabels,
    DepthError,
    Look,
    Mesh,
    OccupancyCloud,
    SensorCloud,
)
from tumortrack.imaging.raster import label_grid
from tumortrack.models.report import Frame, describe_parts, grid_over
from tumortrack.registration import kernels
from tumortrack.registration import report as entries
from tumortrack.registration.advice import Advisor, part_number
from tumortrack.registration.bend import BentFit
from tumortrack.registration.choose import likeliest
from tumortrack.registration.depth_scale import depth_share
from tumortrack.registration.evidence import EvidenceTerms, Known, still_known
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion, blend
from tumortrack.registration.search import PosePrior, apart_mm
from tumortrack.registration.uncertainty import apparent_size, held_by_prior_mm
from tumortrack.sense.cloud import FEWEST_POINTS

QUERIES = 40_000  # as many as the paper asks
CARRIED = 20_000  # points of the undeformed organ that live estimates carry along
_SAMPLES = 256  # places where the uncertainty is computed; other points take the nearest's
_FIELD_MM = 0.3  # error of the distance fields and surfaces themselves
_MOVED_MM = 2.5  # between live frames: what moves farther is found again from the start
_JUMP_MM = 10.0  # from one frame to the next: then it may have come to lie any way
_BEHIND_MM = 2.0  # a smoothed motion that lags by more starts again


def nearest_lookup(
    places_mm: Float[np.ndarray, "p 3"],
) -> tuple[Float32[np.ndarray, " 3"], Int32[np.ndarray, "i j k"]]:
    """For ``kernels.look_up``: a lattice's origin, over the places' box and a node beyond, and the
    number of the place nearest to each node."""
    step = kernels.NODES_MM
    lower, upper = places_mm.min(0) - step, places_mm.max(0) + step
    shape = tuple(np.ceil((upper - lower) / step).astype(int) + 1)
    nodes = lower + step * np.indices(shape).reshape(3, -1).T
    # Half the squared distance, up to what it is for all places; by thousands, for the cache.
    half = (places_mm**2).sum(1) / 2
    parts = np.array_split(nodes, len(nodes) // 1000 + 1)
    which = np.concatenate([(half - some @ places_mm.T).argmin(1) for some in parts])
    return lower.astype(np.float32), which.astype(np.int32).reshape(shape)


@dataclass(frozen=True, eq=False)
class _OrganPoints:
    """Points of the undeformed organ: place (CT, mm), label, distance to the nearest surface that
    bounds it, and the number of the nearest sample of uncertainty."""

    points_ct: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]
    margin_mm: Float32[np.ndarray, " n"]
    sample: Int32[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Placed:
    """The organ before the camera: the library's fit and the bent one, its motion with covariance,
    the moved surfaces (camera frame), the covariance (mm^2) at the samples and at the middle of
    each part's box, and the largest deviations there without the camera's common error."""

    fit: RegistrationResult
    bent: BentFit
    motion: ElasticMotion
    meshes: dict[str, Mesh]
    sample_mm2: Float[np.ndarray, "k 3 3"]
    middle_mm2: Float[np.ndarray, "parts 3 3"]
    sample_fit_std_mm: Float[np.ndarray, " k"]
    middle_fit_std_mm: Float[np.ndarray, " parts"]
    structures: dict[str, Mesh]

    @property
    def least_sure(self) -> int:
        """The number of the tumor whose place is least sure."""
        return 1 + int(np.trace(self.middle_mm2[1:], axis1=1, axis2=2).argmax())

    def probability(self, mine: _OrganPoints) -> Float32[np.ndarray, " n"]:
        """The chance that each point lies on the side of the nearest surface where it was found,
        if errors are normal."""
        variances = np.trace(self.sample_mm2, axis1=1, axis2=2) / 3
        per_std = 1 / np.sqrt(variances + _FIELD_MM**2)
        return kernels.probabilities(mine.margin_mm, per_std, mine.sample)


class _Found(NamedTuple):
    """A frame's fit; the prior by which it is the likeliest; its motion as the points alone show
    it; evidence by now, and that part of it, as it came, which is of earlier frames."""

    fit: RegistrationResult
    prior: PosePrior
    shown: ElasticMotion
    pieces: tuple[Evidence, ...] = ()
    before: tuple[Known, ...] = ()


class RegistrationLocator:
    """Locates by ``Registration``; its estimates have a motion. ``advise``: the part that advice is
    for; empty: the tumor that is least sure. Raises InputError: there is no such part."""

    def __init__(self, model: RegistrationModel, advise: str = "") -> None:
        self._model, self._shape, self._calibration = model, model.shape, model.calibration
        self._advised = part_number(advise, model.parts) if advise else None
        self._registration = known = model.registration
        self._anyhow = replace(known, prior=replace(known.prior, tilt_degrees=180.0))
        self._turned_over = replace(known, prior=replace(known.prior, either_side=True))
        self._near = msgspec.structs.replace(model.config.refine, first_mm=_MOVED_MM)
        anatomy = model.shape.anatomy_ct
        self.anatomy_ct: Anatomy | None = anatomy
        vertices = [part.vertices_mm for part in anatomy.parts]
        self._touchable = tuple(anatomy.closed)
        self._surfaces = (*anatomy.parts, *anatomy.structures.values())
        together = np.concatenate([mesh.vertices_mm for mesh in self._surfaces])
        self._vertices_ct = together.astype(np.float32)
        counts = [_SAMPLES // 2, *[64] * len(anatomy.tumors)]
        samples = [v[:: max(1, len(v) // count)] for v, count in zip(vertices, counts, strict=True)]
        self._samples_ct = np.concatenate(samples)
        self._sample_ends = np.cumsum([len(places) for places in samples])[:-1]  # of each part's
        self._nearest_sample = nearest_lookup(self._samples_ct)
        self._carried: _OrganPoints | None = None

    def locate(
        self,
        looks: Sequence[Look],
        grid: int,
        seed: int,
        evidence: Sequence[Evidence] = (),
        any_pose: bool = False,
    ) -> Estimate:
        """See ``tracking.tracker.Tracker.locate``."""
        cloud = looks[0].cloud
        alone = isinstance(looks[0].seen, SensorCloud) and not len(looks[0].seen.points_mm)
        fewest = FEWEST_TOUCHES if alone else FEWEST_POINTS
        frame = Frame(self._model, cloud, seed, np.random.default_rng(seed), fewest)
        points = self._points(frame, looks, evidence=EvidenceTerms.of(evidence, self._touchable))
        method = self._anyhow if any_pose else self._registration
        fit = method.register(points, None, frame.stage)
        bent = self._bent(fit, frame)
        size = apparent_size(fit.motion, fit.looks, self._registration.config)
        placed = self._checked(fit, bent, size, frame)
        organ = placed.meshes[self._model.parts[0]]
        with frame.stage("fine"):
            inside = self._drawn(placed, organ, cloud.stamp_ns, frame.rng)
        with frame.stage("volume"):
            camera_from_index, shape = grid_over(organ.vertices_mm, grid)
            labels = label_grid(Anatomy(tuple(placed.meshes.values())), camera_from_index, shape)
        voxel_mm = float(camera_from_index[0, 0])
        prior, more = method.prior, {"size": size, "voxel_mm": voxel_mm}
        found = self._found(fit, prior, tuple(evidence))
        said, known = self._evidence_report(placed, found)
        advice: tuple[NextEvidence, ...] = ()
        if len(self._model.parts) > 1:
            advisor = self._advisor(placed)
            advice = *advisor.touches(), *advisor.others()
        report = self._report(frame, looks, placed, inside, prior, evidence=said, **more)
        volume = CameraLabels(labels, camera_from_index)
        made = Estimate(inside, volume, placed.meshes, report, placed.motion, found.shown)
        made = made.assessed(next_evidence=advice)
        return replace(made, structures=placed.structures, evidence=known)

    def follow(self, looks: Sequence[Look], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``tracking.tracker.Tracker.follow``."""
        cloud = looks[0].cloud
        rng = np.random.default_rng((how.seed, cloud.stamp_ns))
        frame = Frame(self._model, cloud, how.seed, rng)
        # As many points in all as of one look: faster by half, and tumors within 0.05 mm as good.
        points = self._points(frame, looks, every=len(looks))
        found = self._fit_after(last, points, how, frame)
        fit, bent = found.fit, self._bent(found.fit, frame)
        bent, lag_s = self._smoothed(bent, last, cloud.stamp_ns, how.smoothing_s)
        size = apparent_size(fit.motion, fit.looks, self._registration.config)
        placed = self._checked(fit, bent, size, frame)
        with frame.stage("carry"):
            inside = self._carry(placed, cloud.stamp_ns)
        smoothing = SmoothingReport(time_s=how.smoothing_s, lag_ms=1000 * lag_s)
        said, known = self._evidence_report(placed, found)
        more = {"size": size, "smoothing": smoothing, "evidence": said}
        advice: tuple[NextEvidence, ...] = ()
        if how.thorough and len(self._model.parts) > 1:
            with frame.stage("advise"):
                advice = self._advisor(placed).touches()
        report = self._report(frame, looks, placed, inside, found.prior, **more)
        made = Estimate(inside, None, placed.meshes, report, placed.motion, found.shown)
        made = made.assessed(next_evidence=advice)
        return replace(made, structures=placed.structures, evidence=known)

    def _advisor(self, placed: _Placed) -> Advisor:
        part = placed.least_sure if self._advised is None else self._advised
        return Advisor(placed.motion, part, self._registration.config)

    def _evidence_report(
        self, placed: _Placed, found: _Found
    ) -> tuple[tuple[EvidenceReport, ...], tuple[Known, ...]]:
        """What a report says of the evidence, and what the next frame needs of it."""
        if not found.pieces:
            return (), ()
        evidence, terms = placed.bent.looks.evidence, placed.bent.terms
        before = found.before
        assert evidence is not None
        assert terms is not None
        reports = evidence.described(found.pieces, placed.motion, len(before), terms)
        new = [Known(piece, found.shown) for piece in found.pieces[len(before) :]]
        pairs = zip((*before, *new), reports, strict=True)
        return reports, tuple(known for known, entry in pairs if not entry.left_out)

    def _found(
        self,
        fit: RegistrationResult,
        prior: PosePrior,
        pieces: tuple[Evidence, ...],
        before: tuple[Known, ...] = (),
    ) -> _Found:
        """Of a search, in which evidence counted."""
        if not pieces:
            return _Found(fit, prior, fit.motion)
        points = replace(fit.looks, evidence=None)
        shown = self._registration.follow(points, fit.motion, self._near).motion
        return _Found(fit, prior, replace(shown, rivals=fit.motion.rivals), pieces, before)

    def _fit_after(
        self, last: Estimate | None, looks: Looks, how: FollowOptions, frame: Frame
    ) -> _Found:
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
            return _Found(fit, method.prior, fit.motion, pieces, before)
        if pieces:
            fit = self._registration.follow(looks, fit.motion, self._near)
        fit = method.register(looks, fit, frame.stage, again=not doubtful)
        if apart_mm(fit.motion, shown) > _JUMP_MM:  # the tissue hardly went there
            before = tuple(map(Known, pieces[: len(before)], repeat(fit.motion)))
        return self._found(fit, method.prior, pieces, before)

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
        behind_mm = mean.carry(self._samples_ct) - bent.motion.carry(self._samples_ct)
        if np.linalg.norm(behind_mm, axis=1).max() >= _BEHIND_MM:
            return bent, 0.0
        return replace(bent, motion=mean), past_s * (1 - share) / share

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

    def warm(self) -> None:
        """See ``tracking.tracker.Tracker.warm``."""
        body, organ = self._shape.body, self._shape.anatomy_ct.organ
        rest = ElasticMotion(self._shape, np.eye(3), np.array([0.0, 0.0, 150.0]), body.mean)
        cloud = SensorCloud(rest.carry(organ.vertices_mm))
        points = Frame(self._model, cloud, 0, np.random.default_rng(0)).points_mm
        looks = Looks.of([points])
        fit = self._registration.best_fit(looks, [*self._registration.search.starts(looks), rest])
        size = apparent_size(fit.motion, fit.looks, self._registration.config)
        self._carry(self._moved(fit, self._registration.bend(fit), size), 0)
        for surface in range(len(self._touchable)):
            self._shape.field(surface)

    def _bent(self, fit: RegistrationResult, frame: Frame) -> BentFit:
        with frame.stage("bend"):
            return self._registration.bend(fit)

    def _checked(
        self, fit: RegistrationResult, bent: BentFit, size: SizeFit, frame: Frame
    ) -> _Placed:
        """The organ as ``bent`` has it, if it can be this organ by the library's fit."""
        self._registration.check(fit, self._model.in_distribution)
        with frame.stage("surfaces"):
            return self._moved(fit, bent, size)

    def _moved(self, fit: RegistrationResult, bent: BentFit, size: SizeFit) -> _Placed:
        share, looks = 0.0, fit.looks
        if len(looks.points_mm):
            share = depth_share(size, bent.motion.centre_mm[2], looks.depth_error)
        std_scale = self._calibration.std_scale
        motion = replace(bent.motion, depth_share=share, std_scale=std_scale)
        anatomy = self._shape.anatomy_ct
        moved = motion.carry(self._vertices_ct)
        ends = np.cumsum([len(mesh.vertices_mm) for mesh in self._surfaces])[:-1]
        names = (*anatomy.names, *anatomy.structures)
        there = zip(names, self._surfaces, np.split(moved, ends), strict=True)
        surfaces = {name: mesh.moved(places) for name, mesh, places in there}
        structures = {name: surfaces.pop(name) for name in anatomy.structures}
        places_ct = np.concatenate([self._samples_ct, self._shape.middles_ct])
        known_mm2 = motion.covariance_mm2(places_ct)
        assert known_mm2 is not None
        along = share * motion.carry(places_ct)
        fit_mm2 = known_mm2 - along[:, :, None] * along[:, None, :]
        std_mm, count = largest_std_of(fit_mm2), len(self._samples_ct)
        spread = known_mm2[:count], known_mm2[count:], std_mm[:count], std_mm[count:]
        return _Placed(fit, bent, motion, surfaces, *spread, structures)

    def _report(
        self,
        frame: Frame,
        looks: Sequence[Look],
        placed: _Placed,
        inside: OccupancyCloud,
        prior: PosePrior,
        **more: Any,
    ) -> FitReport:
        fit, bent = placed.fit, placed.bent
        surfaces_mm2 = np.split(placed.sample_mm2, self._sample_ends)
        on_surface_mm = np.split(placed.sample_fit_std_mm, self._sample_ends)
        fit_mm = zip(placed.middle_fit_std_mm, map(np.max, on_surface_mm), strict=True)
        held_mm = held_by_prior_mm(placed.motion, bent.prior_slope)
        known_mm, evidence = fit.looks.points_mm, fit.looks.evidence
        if evidence is not None:
            known_mm = np.concatenate([known_mm, evidence.places_of_tissue_mm])
        deviations = {
            name: {
                "held_by_prior_mm": held,
                "fit_std_mm": (float(middle_mm), float(surface_mm)),
                **entries.part_deviations(
                    center_mm2,
                    surface_mm2,
                    placed.meshes[name].box_mm.mean(0),
                    known_mm,
                ),
            }
            for name, held, (middle_mm, surface_mm), center_mm2, surface_mm2 in zip(
                self._model.parts, held_mm, fit_mm, placed.middle_mm2, surfaces_mm2, strict=True
            )
        }
        usual_cost, config = self._calibration.usual_cost, self._registration.config
        report = frame.report(
            np.abs(bent.distances_mm),
            describe_parts(self._model.parts, placed.meshes, inside, deviations),
            structures=tuple(placed.structures),
            fit_cost=entries.cost_entry(fit, prior, usual_cost, config),
            poses=entries.poses_entry(prior),
            motion=entries.motion_entry(placed.motion, fit, bent),
            looks=fit.looks.described() if len(looks) > 1 else None,
            **more,
        )
        points = sum(len(look.cloud.points_mm) for look in looks)
        return msgspec.structs.replace(report, points=points)

    def _drawn(
        self, placed: _Placed, organ: Mesh, stamp_ns: int, rng: np.random.Generator
    ) -> OccupancyCloud:
        """Random points of the organ's box that lie inside, with label and probability."""
        lower, upper = organ.box_mm
        points = rng.random((QUERIES, 3), np.float32)
        points *= (upper - lower).astype(np.float32)
        points += lower.astype(np.float32)
        inside, mine = self._inside(placed.motion.back(points).astype(np.float32))
        probability = placed.probability(mine)
        return OccupancyCloud(points.take(inside, 0), mine.labels, probability, stamp_ns)

    def _carry(self, placed: _Placed, stamp_ns: int) -> OccupancyCloud:
        """The same points of the organ in every frame: labels stay, places and probabilities are
        new."""
        if self._carried is None:
            lower, upper = self._shape.anatomy_ct.organ.box_mm
            rng, found = np.random.default_rng(0), np.zeros((0, 3), np.float32)
            while len(found) < CARRIED:
                points = rng.uniform(lower, upper, (CARRIED, 3)).astype(np.float32)
                found = np.concatenate([found, points[self._shape.labels_at(points)[0] > 0]])
            self._carried = self._inside(found[:CARRIED])[1]
        mine = self._carried
        places = placed.motion.carry(mine.points_ct).astype(np.float32)
        return OccupancyCloud(places, mine.labels, placed.probability(mine), stamp_ns)

    def _inside(
        self, points_ct: Float32[np.ndarray, "n 3"]
    ) -> tuple[Int64[np.ndarray, " m"], _OrganPoints]:
        """The numbers of the points that lie inside, and what is known of these points."""
        labels, margin_mm = self._shape.labels_at(points_ct)
        inside = np.flatnonzero(labels)
        mine = points_ct.take(inside, 0)  # much faster than by a mask
        sample = kernels.look_up(*self._nearest_sample, mine)
        return inside, _OrganPoints(mine, labels[inside], margin_mm[inside], sample)
