"""Sensor cloud -> estimate, with any kind of model; ``follower`` does frame after frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float, Float64

from tumortrack.assessment.advice import part_number
from tumortrack.assessment.causes import causes_of, words
from tumortrack.assessment.verdict import Advise, assessed, judged
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.config import check_seed
from tumortrack.core.errors import InputError, NotThisOrgan
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import CAMERA, FEWEST_TOUCHES, Cut, Evidence, touched
from tumortrack.core.geometry import IDENTITY, Affine, rigid, transform_points
from tumortrack.core.process import tune_malloc
from tumortrack.core.report import Cause, Likely, ProbeReport
from tumortrack.core.types import Anatomy, DepthFrame, SensorCloud, View
from tumortrack.core.ultrasound import ProbeRecording
from tumortrack.io.case import Case
from tumortrack.registration.base_model import Model
from tumortrack.registration.evidence import MOST_PLACES, EvidenceTerms
from tumortrack.registration.flap import carried_to_ct
from tumortrack.registration.locator import RegistrationLocator
from tumortrack.registration.method import Locator, method_of_config
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion, seen_from_first
from tumortrack.registration.probe import UNKNOWN, believed
from tumortrack.segmentation import RegionConfig
from tumortrack.segmentation.smoothing import clean_cloud
from tumortrack.tracking.model_files import case_model
from tumortrack.tracking.pieces import select_piece, with_flap_joined

_DEFAULTS = FollowOptions()
_GRID = 16  # of an answer of which the motion alone counts
_BEFORE_MM = np.array([0.0, 0.0, 300.0])  # of a camera that there is not
_FARTHEST_MM = 700.0  # of an organ before a camera on a stand


class Tracker:
    """Locates the organ and tumors of a case, or of a model, in sensor clouds (camera frame, mm).
    A case without a model gets one first, which takes some seconds.

    Its process keeps the memory that a frame frees for the next one. ``advise``: the part that its
    reports' ``next_evidence`` is for; empty: the tumor that is least sure.

    Raises:
        InputError: no model; the organ has no such part, or the model knows no motion.
    """

    def __init__(self, model: Model | Case, advise: str = "") -> None:
        if isinstance(model, Case):
            model = case_model(model)
        if not isinstance(model, Model):
            raise InputError(
                f"Tracker takes a case or a model, not {type(model).__name__}: "
                "Tracker(load_case(FOLDER))."
            )
        tune_malloc()
        self.model, self._locator = model, _locator(model)
        if advise and not isinstance(model, RegistrationModel):
            raise InputError("advice needs a model that knows a motion: give the case itself.")
        self._advise, self._advised = advise, part_number(advise, model.parts) if advise else None

    @property
    def anatomy_ct(self) -> Anatomy | None:
        """The organ in the CT (LPS, mm); None for models without correspondences."""
        return self._locator.anatomy_ct

    def with_cut(self, cuts: Sequence[Cut]) -> Tracker:
        """Of the organ with all that was cut of it: places of the CT (a second). Raises InputError:
        they are none, or off the organ, or the model knows no motion."""
        if not isinstance(self.model, RegistrationModel):
            raise InputError("cuts need a model that knows a motion: give the case itself.")
        return Tracker(self.model.with_cut(cuts), self._advise)

    def locate(
        self,
        points: SensorCloud | Float[np.ndarray, "n 3"],
        *,
        views: Sequence[View] = (),
        evidence: Sequence[Evidence | ProbeRecording] = (),
        full_view: DepthFrame | SensorCloud | None = None,
        grid: int = 160,
        seed: int = 0,
        frame: str = CAMERA,
    ) -> Estimate:
        """The full estimate from one cloud; the same cloud and seed give the same result.

        Args:
            points: of the organ, as the camera sees them: n x 3, camera frame, mm.
            views: of further cameras, or from other places, while the organ rests.
            evidence: what else is known of where it lies then: ``Touch``, ``Landmark``, ``Grasp``,
                ``Outline``, ``FreeSpace``, in the frame of ``points``; and what a tracked
                ultrasound probe recorded (``read_ultrasound``). There may be no points: then it
                has twelve places or more, touched or outlined.
            full_view: all that the camera saw, by which the estimate is judged; default: what is
                in ``points``.
            grid: voxels along the longest side of the labelled volume.
            seed: of the random points.
            frame: without points: of the evidence, and of the answer; in another one than a
                camera's the organ may lie any way.

        Raises:
            NoEstimate: too few points, no organ found in them, not the organ of this model, or the
                camera sees through the place where it would be.
            InputError: points that are not n x 3, not finite, or in metres; a seed that is not
                allowed; evidence of a part that the organ lacks; a view among the evidence; views
                or evidence with a model that knows no motion.
        """
        check_seed(seed)
        cloud = cloud_of(points)
        all_views: Sequence[View]
        all_views = _views_of(cloud, full_view, views)
        pieces, recordings = _evidence_of(evidence)
        if cuts := tuple(each for each in pieces if isinstance(each, Cut)):
            rest = (*(each for each in pieces if not isinstance(each, Cut)), *recordings)
            known: dict[str, Any] = {
                "views": views, "evidence": rest, "full_view": full_view, "seed": seed,
                "grid": grid, "frame": frame,
            }  # fmt: skip
            if not all(cut.points_ct for cut in cuts):  # made just now, with the organ as it lies
                motion = self.locate(cloud, **known | {"grid": _GRID}).motion
                assert isinstance(motion, ElasticMotion)
                cuts = carried_to_ct(cuts, motion)
            return self.with_cut(cuts).locate(cloud, **known)
        if frame == CAMERA:
            return self._located(cloud, all_views, pieces, grid, seed, recordings)
        if len(cloud.points_mm) or not (pieces or recordings):
            raise InputError("clouds are in a camera's frame; only evidence without one is not.")
        # By evidence alone in any frame: as if a camera, which could lie any way, saw it.
        places = [np.array(each.places) for each in pieces]
        places += [each.known_mm for each in recordings]
        away_mm = _BEFORE_MM - np.concatenate(places).mean(0)
        pieces = tuple(each.at(np.array(each.places) + away_mm, each.std_mm) for each in pieces)
        recordings = tuple(each.moved(away_mm) for each in recordings)
        alone = (View(cloud, cloud, IDENTITY),)
        found = self._located(cloud, alone, pieces, grid, seed, recordings, any_pose=True)
        return replace(_shifted(found, -away_mm), frame=frame)

    def _located(
        self,
        cloud: SensorCloud,
        all_views: Sequence[View],
        pieces: tuple[Evidence, ...],
        grid: int,
        seed: int,
        recordings: tuple[ProbeRecording, ...],
        any_pose: bool = False,
    ) -> Estimate:
        """``any_pose``: it may lie any way."""
        pieces, probes = self._with_recordings(all_views, pieces, seed, recordings, any_pose)
        shown, given = tuple[Evidence, ...](), pieces
        if not len(cloud.points_mm) and pieces:
            all_views, shown, pieces = _alone(cloud, pieces, self.model.parts[0])
        all_views = self._with_flap_joined(all_views)

        def located(all_views: Sequence[View]) -> Estimate:
            found = self._locator.locate(all_views, grid, seed, pieces, any_pose)
            found = _with_pieces(found, shown, given).reporting(probes=probes)
            return judged(found, all_views, factor=self.model.bound_factor)

        with self._explaining_errors(all_views, _DEFAULTS, bool(pieces)):
            estimate, all_views = select_piece(all_views, located)
        return assessed(estimate, all_views, self.model, advise="all", part=self._advised)

    def _with_recordings(
        self,
        all_views: Sequence[View],
        pieces: tuple[Evidence, ...],
        seed: int,
        recordings: tuple[ProbeRecording, ...],
        any_pose: bool,
    ) -> tuple[tuple[Evidence, ...], tuple[ProbeReport, ...]]:
        """With what recordings outline, once their images' errors are found."""
        locator, reports, known = self._locator, list[ProbeReport](), pieces
        if recordings and not isinstance(locator, RegistrationLocator):
            raise InputError("recordings need a model that knows a motion: give the case itself.")
        for recording in recordings:
            assert isinstance(locator, RegistrationLocator)
            if not len(recording.known_mm):
                raise InputError(f"{recording.tool}: no place in its images has a pose in time.")
            most = (MOST_PLACES - sum(len(each.places) for each in known)) // len(recordings)
            thinned = recording.thinned(max(most, FEWEST_TOUCHES))
            views, others, alone = all_views, known, all_views[0].of_no_camera
            if alone:
                outlines = believed(thinned, UNKNOWN).outlines()
                cloud = all_views[0].cloud
                views, _, others = _alone(cloud, (*known, *outlines), self.model.parts[0])
            with self._explaining_errors(views, _DEFAULTS, touched=True):
                found = locator.errors_of(thinned, views, seed, others, any_pose)
            pieces += believed(thinned, found).outlines(found.errors)
            reports.append(found.report(thinned, alone))
        return pieces, tuple(reports)

    def follow(
        self,
        cloud: SensorCloud,
        last: Estimate | None = None,
        how: FollowOptions = _DEFAULTS,
        full_view: DepthFrame | SensorCloud | None = None,
        *,
        views: Sequence[View] = (),
        evidence: Sequence[Evidence] = (),
    ) -> Estimate:
        """A fast estimate for one frame of many: without a volume, from a search that starts at the
        ``last`` estimate, if there is a recent one. ``views``: of further cameras; ``evidence``:
        what is new with this frame. Models that know no motion cannot smooth. Raises as ``locate``.
        """
        # A fit that is suddenly worse may be to another object.
        strictly = how.allow_flip if last is None else last.quality != "good" or not _unusual(last)
        all_views: Sequence[View]
        all_views, (pieces, _) = _views_of(cloud, full_view, views), _evidence_of(evidence, False)
        all_views = self._with_flap_joined(all_views)
        if pieces:
            how = msgspec.structs.replace(how, evidence=(*how.evidence, *pieces))

        def located(all_views: Sequence[View]) -> Estimate:
            found = self._locator.follow(all_views, last, how)
            return judged(found, all_views, strictly, self.model.bound_factor, last)

        with self._explaining_errors(all_views, how, bool(pieces or (last and last.evidence))):
            estimate, all_views = select_piece(all_views, located, most=1)  # a frame may not wait
        advise: Advise = "touches" if how.global_search else "nothing"
        return assessed(estimate, all_views, self.model, how.known, advise, self._advised)

    def _with_flap_joined(self, all_views: Sequence[View]) -> Sequence[View]:
        model = self.model
        if not isinstance(model, RegistrationModel) or model.shape.cut is None:
            return all_views
        return [with_flap_joined(all_views[0]), *all_views[1:]]

    @contextmanager
    def _explaining_errors(
        self, all_views: Sequence[View], how: FollowOptions, touched: bool
    ) -> Iterator[None]:
        """Adds the likely causes to NotThisOrgan. ``touched``: evidence may be one of them."""
        try:
            yield
        except NotThisOrgan as error:
            causes = causes_of(self.model, all_views, None, how.known)
            advice = f"{words(causes, '')}."
            if touched:
                advice += " Or its evidence is of another place: try without it."
                causes = (*causes, Likely(Cause.EVIDENCE))
            raise NotThisOrgan(error.finding or str(error), causes, advice) from error

    def warm(self) -> None:
        """Load what the first call of ``follow`` would otherwise wait for."""
        self._locator.warm()


def _shifted(estimate: Estimate, by_mm: Float64[np.ndarray, " 3"]) -> Estimate:
    """All of it moved, without a turn."""
    pose = rigid(np.eye(3), by_mm)
    made, report = seen_from(estimate, pose), estimate.report

    def moved(places: Any) -> Any:
        return (np.array(places) + by_mm).tolist()

    parts = {
        name: msgspec.structs.replace(
            part, center_mm=moved(part.center_mm), box_mm=moved(part.box_mm)
        )
        for name, part in report.parts.items()
    }
    evidence = tuple(
        msgspec.structs.replace(each, places_mm=moved(each.places_mm)) for each in report.evidence
    )
    motion, cost, volume = report.motion, report.fit_cost, estimate.volume
    if motion is not None:
        motion = msgspec.structs.replace(
            motion,
            camera_from_ct=(pose @ np.array(motion.camera_from_ct)).tolist(),
            camera_from_deformed_ct=(pose @ np.array(motion.camera_from_deformed_ct)).tolist(),
        )
    if cost is not None:
        others = tuple(
            msgspec.structs.replace(
                other, center_mm={name: moved(place) for name, place in other.center_mm.items()}
            )
            for other in cost.others
        )
        cost = msgspec.structs.replace(cost, others=others)
    if volume is not None:
        volume = replace(volume, camera_from_index=pose @ volume.camera_from_index)
    advice = tuple(
        msgspec.structs.replace(each, place_mm=moved(each.place_mm))
        for each in estimate.assessment.next_evidence
    )
    structures = {
        name: mesh.with_vertices(mesh.vertices_mm + by_mm)
        for name, mesh in estimate.structures.items()
    }
    made = replace(made, volume=volume, structures=structures).assessed(next_evidence=advice)
    return made.reporting(parts=parts, evidence=evidence, motion=motion, fit_cost=cost)


def _with_pieces(
    estimate: Estimate, shown: Sequence[Evidence], given: Sequence[Evidence]
) -> Estimate:
    """The estimate with what it says of evidence that was its cloud, in the order of all that was
    ``given``."""
    motion = estimate.motion
    if not shown or not isinstance(motion, ElasticMotion):
        return estimate
    terms = EvidenceTerms.from_evidence(shown, motion.shape.anatomy_ct.names, math.inf)
    assert terms is not None
    told = terms.described(shown, motion, 0, terms.at(motion))
    rest, mine = iter(estimate.report.evidence), iter(told)
    order = [any(each is piece for piece in shown) for each in given]
    return estimate.reporting(evidence=tuple(next(mine if was else rest) for was in order))


def cloud_of(points: SensorCloud | Float[np.ndarray, "n 3"]) -> SensorCloud:
    """Raises InputError: they are no cloud, not n x 3, or not finite."""
    if isinstance(points, SensorCloud):
        return points
    if not isinstance(points, np.ndarray):
        raise InputError(
            "points are n x 3 in mm in the camera frame, or a SensorCloud, not "
            f"{type(points).__name__}: numpy.asarray(POINTS), read_cloud(FILE), or locate_files."
        )
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise InputError(
            f"points are numbers, n x 3, in mm in the camera frame, not {points.dtype} of shape "
            f"{points.shape}."
        )
    return SensorCloud(points)


def _views_of(
    cloud: SensorCloud, full_view: DepthFrame | SensorCloud | None, views: Sequence[View]
) -> tuple[View, ...]:
    """The cloud's view, then the others."""
    hint = (
        "views=[View(cloud, full_view, camera_from_view)]; touches and the like are evidence=[...]"
    )
    others = _all_of(View, views, "views are of View", hint)
    return tuple(map(_cleaned, (View(cloud, full_view or cloud, IDENTITY), *others)))


def _evidence_of(
    evidence: Sequence[Evidence | ProbeRecording], recorded: bool = True
) -> tuple[tuple[Evidence, ...], tuple[ProbeRecording, ...]]:
    """``recorded``: recordings are allowed among it."""
    kinds = "evidence is of Touch, Landmark, Grasp, Outline, FreeSpace and Cut"
    hint = "evidence=[Touch(place_mm=(x, y, z))]; further cameras' views are views=[...]"
    allowed = Evidence | ProbeRecording if recorded else Evidence
    every = _all_of(allowed, evidence, kinds, hint)
    recordings = tuple(each for each in every if isinstance(each, ProbeRecording))
    return tuple(each for each in every if not isinstance(each, ProbeRecording)), recordings


def _alone(
    cloud: SensorCloud, pieces: tuple[Evidence, ...], organ: str
) -> tuple[tuple[View], tuple[Evidence, ...], tuple[Evidence, ...]]:
    """Without a camera: a view of what was touched or outlined of the organ; of what it is made;
    and the rest."""
    places, shown, others = touched(pieces, organ)
    return (View(replace(places, stamp_ns=cloud.stamp_ns), cloud, IDENTITY),), shown, others


def _all_of(kind: Any, given: Any, what: str, hint: str) -> tuple[Any, ...]:
    """Raises InputError: something else is among what was given."""
    several = isinstance(given, Iterable) and not isinstance(given, Mapping | str)
    values = tuple(given) if several else (given,)
    if wrong := [each for each in values if not isinstance(each, kind)]:
        raise InputError(f"{what}, not {type(wrong[0]).__name__}: {hint}.")
    return values


def _cleaned(view: View) -> View:
    """What was seen is cleaned with the organ's points where it is no more than these."""
    others = tuple(map(clean_cloud, view.cloud.others))
    cloud = replace(clean_cloud(view.cloud), others=others)
    return replace(
        view, cloud=cloud, full_view=cloud if view.full_view is view.cloud else view.full_view
    )


def _locator(model: Model) -> Locator:
    if isinstance(model, RegistrationModel):
        return RegistrationLocator(model)
    return method_of_config(model.config).locator(model)


def _unusual(estimate: Estimate) -> bool:
    cost = estimate.report.fit_cost
    return cost is not None and cost.now > cost.usual


def seen_from(estimate: Estimate, camera_from_last: Affine) -> Estimate:
    """The parts that the next search needs, in the frame of a camera that has moved."""
    points_mm = transform_points(camera_from_last, estimate.cloud.points_mm)
    motion, unsmoothed = (
        seen_from_first(motion, camera_from_last) if isinstance(motion, ElasticMotion) else motion
        for motion in (estimate.motion, estimate.unsmoothed)
    )
    cloud, meshes = replace(estimate.cloud, points_mm=points_mm), estimate.meshes.items()
    moved = {
        n: m.with_vertices(transform_points(camera_from_last, m.vertices_mm)) for n, m in meshes
    }
    evidence = tuple(each.seen_from(camera_from_last) for each in estimate.evidence)
    made = replace(estimate, cloud=cloud, meshes=moved, motion=motion, unsmoothed=unsmoothed)
    return replace(made, evidence=evidence)


def region_for(
    model: Model | None = None,
    *,
    range_mm: tuple[float, float] | None = None,
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    whole: bool = False,
) -> RegionConfig:
    """Where to search for the organ, and for pieces of which size (if the model knows it).

    The range of depths defaults to that of training, extended so that training's farthest organ is
    wholly in it. ``box_mm``: opposite corners, camera frame. ``whole``: everything in range is the
    organ.
    """
    if model is None:
        near, far = range_mm or (CloudConfig().near_mm, CloudConfig().far_mm)
        return RegionConfig(crop=CloudConfig(near_mm=near, far_mm=far), box_mm=box_mm)
    scene = model.config.scene
    near, far = scene.cloud.near_mm, scene.cloud.far_mm
    if scene.free_range > 0:
        nearest, farthest = scene.free_nearest_mm
        near, far = min(near, nearest - 5), max(far, farthest + far - near)
    if isinstance(model, RegistrationModel):  # what it fits does not depend on the distance
        far = max(far, _FARTHEST_MM)
    near, far = range_mm or (near, far)
    crop = CloudConfig(near_mm=near, far_mm=far, n_points=scene.cloud.n_points)
    if whole:
        return RegionConfig(crop=crop, box_mm=box_mm, plane=False, flying=False, pieces=False)
    if not isinstance(model, RegistrationModel):
        return RegionConfig(crop=crop, box_mm=box_mm)
    vertices = model.shape.anatomy_ct.organ.vertices_mm
    axes = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2]
    extents_mm = np.ptp(vertices @ axes.T, axis=0)
    size_mm = (0.7 * float(extents_mm.min()), 1.25 * float(extents_mm.max()))
    # A noisy sensor's uneven surface must not fall into many pieces.
    noise_mm = max(RegionConfig().noise_mm, scene.noise.axial_mm)
    return RegionConfig(crop=crop, box_mm=box_mm, organ_mm=size_mm, noise_mm=noise_mm)
