"""Sensor cloud -> estimate by any kind of model, and from frame to frame."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from tumortrack.core.causes import Cause, Likely
from tumortrack.core.config import Config, check_seed
from tumortrack.core.errors import InputError, NoEstimate, NotThisOrgan
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.geometry import HERE, Affine, transform_points
from tumortrack.core.process import keep_small_blocks
from tumortrack.core.report import Finding
from tumortrack.core.types import Anatomy, DepthFrame, Look, SensorCloud
from tumortrack.imaging.case import Case
from tumortrack.models.folder import weakness_of
from tumortrack.models.method import Locator, method_of_config
from tumortrack.models.model import Model
from tumortrack.registration.locator import RegistrationLocator
from tumortrack.registration.looks import seen_from_first
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.region import RegionConfig
from tumortrack.tracking.advice import where_to_look
from tumortrack.tracking.causes import likely_causes, words
from tumortrack.tracking.model_files import case_model
from tumortrack.tracking.quality import doubt_if_hidden, judged, with_margin

_ALONE = FollowOptions()
# So long after it was found good the organ is also looked for with its other side up. In first
# looks of strangers that called 18 of 46 kidneys of others, or mirrored, good; none without it.
_TURNED_OVER_S = 30.0
# Causes are sought so often at most, for each check that fails: that takes the time of some frames.
_SOUGHT_S = 1.0
_OF_POSES = "none", "poses", "fit", "strays", "seen_through"  # checks, where views are several


class Tracker:
    """Locates the organ and tumors of one case, or of a model, in sensor clouds (camera frame, mm).
    A case that has no model yet gets one first, which takes some seconds.

    A process that has one keeps what memory a frame frees for the next one.
    """

    def __init__(self, model: Model | Case) -> None:
        if isinstance(model, Case):
            model = case_model(model)
        if not isinstance(model, Model):
            raise InputError(
                f"Tracker takes a case or a model, not {type(model).__name__}: "
                "Tracker(load_case(FOLDER))."
            )
        keep_small_blocks()
        self.model, self._patient, self._organ = model, model.patient, model.organ
        self._weakness = weakness_of(model.provenance)
        self._locator = _locator(model)

    @property
    def anatomy_ct(self) -> Anatomy | None:
        """The organ in the CT (LPS, mm); None for models that know no correspondences."""
        return self._locator.anatomy_ct

    def locate(
        self,
        cloud: SensorCloud,
        grid: int = 160,
        seed: int = 0,
        seen: DepthFrame | SensorCloud | None = None,
        others: Sequence[Look] = (),
    ) -> Estimate:
        """Everything about one cloud; the same cloud and seed give the same answer.

        Args:
            grid: voxels along the longest side of the dense volume.
            seen: all that the camera saw, by which the estimate is judged; None: the cloud.
            others: more looks at the same organ, still in between, from other places.

        Raises:
            NoEstimate: too few points, no organ found in them, they do not show this model's, or
                the camera sees through where it would lie.
            InputError: the cloud is in metres; the seed is not allowed; more than one look, where
                the model knows no motion.
        """
        check_seed(seed)
        if not isinstance(cloud, SensorCloud):
            raise InputError(
                f"locate takes a SensorCloud, not {type(cloud).__name__}: read_cloud(FILE), or "
                "SensorCloud(points_mm) of an n x 3 array in the camera frame."
            )
        looks = Look(cloud, seen or cloud, HERE), *others
        with self._explaining(looks, _ALONE):
            estimate = self._locator.locate(looks, grid, seed)
            estimate = self._judged(estimate, looks, False)
        return self._explained(estimate, looks, _ALONE)

    def follow(
        self,
        cloud: SensorCloud,
        last: Estimate | None = None,
        how: FollowOptions = _ALONE,
        seen: DepthFrame | SensorCloud | None = None,
        others: Sequence[Look] = (),
    ) -> Estimate:
        """The same, fast, for one frame of many: no volume, and a search that starts at the
        ``last`` estimate, if there is one a moment old. Models that know no motion smooth nothing.
        Raises NoEstimate: as ``locate``; InputError: the cloud is in metres; more than one look, as
        ``locate``."""
        # What fits worse all of a sudden may be something else that was put there.
        strictly = how.either_side if last is None else last.quality != "good" or not _unusual(last)
        looks = Look(cloud, seen or cloud, HERE), *others
        with self._explaining(looks, how):
            estimate = self._locator.follow(looks, last, how)
            estimate = self._judged(estimate, looks, strictly, last)
        return self._explained(estimate, looks, how)

    def _judged(
        self,
        estimate: Estimate,
        looks: Sequence[Look],
        strictly: bool,
        last: Estimate | None = None,
    ) -> Estimate:
        start = time.perf_counter()
        estimate = judged(estimate, looks, strictly)
        if last is not None:
            estimate = doubt_if_hidden(estimate, last)
        if self._weakness:
            estimate = replace(estimate, finding=Finding("model", {"words": self._weakness}))
        # Margins are calibrated on single looks.
        margins = self.model.margins if len(looks) == 1 else None
        estimate = with_margin(estimate, looks[0].cloud, margins)
        estimate = replace(estimate, patient=self._patient, organ=self._organ)
        return _timed(estimate, "judge", start)

    def _explained(self, estimate: Estimate, looks: Sequence[Look], how: FollowOptions) -> Estimate:
        """With the likely causes of a poor one, and what to do."""
        start = time.perf_counter()
        if estimate.finding is not None and not self._weakness:
            causes = self._causes(looks, how, estimate)
            advice = words(causes, where_to_look(estimate, looks))
            estimate = replace(estimate, causes=causes, advice=advice)
        return _timed(estimate, "explain", start)

    def _causes(
        self, looks: Sequence[Look], how: FollowOptions, estimate: Estimate | None
    ) -> tuple[Likely, ...]:
        check = _check_of(estimate)
        if len(looks) > 1 and check in _OF_POSES:
            return (Likely(Cause.POSES),)
        return how.known.get(check) or likely_causes(self.model, looks[0].cloud, estimate)

    @contextmanager
    def _explaining(self, looks: Sequence[Look], how: FollowOptions) -> Iterator[None]:
        """Adds its likely causes to what is not this organ."""
        try:
            yield
        except NotThisOrgan as error:
            causes = self._causes(looks, how, None)
            advice = f"{words(causes, '')}."
            raise NotThisOrgan(error.finding or str(error), causes, advice) from error

    def warm(self) -> None:
        """Load and compile what ``follow`` needs, which its first call would otherwise wait for."""
        self._locator.warm()


def _locator(model: Model) -> Locator:
    if isinstance(model, RegistrationModel):
        return RegistrationLocator(model)
    return method_of_config(model.config).locator(model)


def _unusual(estimate: Estimate) -> bool:
    """Whether it fits worse than usual."""
    cost = estimate.report.fit_cost
    return cost is not None and cost.now > cost.usual


def _timed(estimate: Estimate, stage: str, start_s: float) -> Estimate:
    """With the seconds that a stage took."""
    took_s, seconds = time.perf_counter() - start_s, estimate.report.timings
    total_s = seconds["total"] + took_s
    return estimate.reporting(timings={**seconds, stage: took_s, "total": total_s})


def _check_of(estimate: Estimate | None) -> str:
    """The check that it failed; ``none``: there is no estimate."""
    if estimate is None:
        return "none"
    return "" if estimate.finding is None else estimate.finding.check


class FollowerConfig(Config, frozen=True, kw_only=True):
    """``rescan_s``: so often the organ is also looked for as in a first frame. ``forget_s``: an
    estimate older than that says nothing about the next frame. ``smoothing_s``: time constant of
    the mean over past estimates; 0: none; the lag it adds stands in every report."""

    rescan_s: float = 1.0
    forget_s: float = 1.0
    smoothing_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rescan_s", "forget_s"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name):g}; it must be more than 0 s.")
        FollowOptions(smoothing_s=self.smoothing_s, seed=self.seed)  # the same checks


class Follower:
    """Locates in one frame after the other, each helped by the one before. Raises InputError:
    smoothing, where the model knows no motion."""

    def __init__(self, tracker: Tracker, config: FollowerConfig) -> None:
        if config.smoothing_s > 0 and tracker.anatomy_ct is None:
            raise InputError(
                "smoothing needs a motion, which models of the presets quick and paper do not "
                "know. Give the case itself, or leave smoothing out."
            )
        self._tracker, self._config = tracker, config
        self._last: Estimate | None = None
        self._scanned_ns, self._rests = 0, False
        self._good_ns: int | None = None
        self._known_ns, self._known = 0, dict[str, tuple[Likely, ...]]()

    def warm(self) -> None:
        """See ``Tracker.warm``."""
        self._tracker.warm()

    def forget(self) -> None:
        """Nothing is known of where the organ is: a new clock, a new pick."""
        self._last = None

    def begin(self, estimate: Estimate) -> None:
        """The organ rests there: the next search starts at it, however long it took."""
        self._last, self._rests, self._scanned_ns = estimate, True, estimate.cloud.stamp_ns

    def last_box_mm(
        self, stamp_ns: int, camera_from_last: Affine = HERE
    ) -> Float64[np.ndarray, "2 3"] | None:
        """The organ's box in the last estimate, if that is recent enough; camera frame.
        ``camera_from_last``: from the frame of the camera that it was made by."""
        last = self._recent(stamp_ns)
        if last is None:
            return None
        organ = last.organ_mesh
        if camera_from_last is not HERE:
            organ = organ.moved(transform_points(camera_from_last, organ.vertices_mm))
        return organ.box_mm

    def locate(
        self,
        cloud: SensorCloud,
        seen: DepthFrame | SensorCloud | None = None,
        others: Sequence[Look] = (),
        camera_from_last: Affine = HERE,
    ) -> Estimate:
        """The estimate of this frame. ``others``: further looks at the same moment;
        ``camera_from_last``: as in ``last_box_mm``. Raises NoEstimate: see ``Tracker.follow``; the
        last estimate is forgotten then."""
        last, self._last, self._rests = self._recent(cloud.stamp_ns), None, False
        if last is not None and camera_from_last is not HERE:
            last = _seen_from(last, camera_from_last)
        thorough = (cloud.stamp_ns - self._scanned_ns) * 1e-9 >= self._config.rescan_s
        if last is None or thorough:
            self._scanned_ns = cloud.stamp_ns
        since_ns = np.inf if self._good_ns is None else cloud.stamp_ns - self._good_ns
        turned = bool(0 <= since_ns <= _TURNED_OVER_S * 1e9)
        if not 0 <= (cloud.stamp_ns - self._known_ns) * 1e-9 < _SOUGHT_S:
            self._known_ns, self._known = cloud.stamp_ns, {}
        how = FollowOptions(
            thorough=thorough,
            either_side=turned,
            smoothing_s=self._config.smoothing_s,
            seed=self._config.seed,
            known=self._known,
        )
        try:
            self._last = self._tracker.follow(cloud, last, how, seen, others)
        except NoEstimate as error:
            self._known = {**self._known, "none": error.causes} if error.causes else self._known
            raise
        if causes := self._last.causes:
            self._known = {**self._known, _check_of(self._last): causes}
        if self._last.quality == "good":
            self._good_ns = cloud.stamp_ns
        return self._last

    def _recent(self, stamp_ns: int) -> Estimate | None:
        if self._last is None:
            return None
        age_s = (stamp_ns - self._last.cloud.stamp_ns) * 1e-9
        recent = 0 <= age_s <= self._config.forget_s or self._rests
        return self._last if recent else None


def _seen_from(estimate: Estimate, camera_from_last: Affine) -> Estimate:
    """What the next search needs of it, before a camera that stands elsewhere."""
    points_mm = transform_points(camera_from_last, estimate.cloud.points_mm)
    motion, unsmoothed = (
        seen_from_first(one, camera_from_last) if isinstance(one, ElasticMotion) else one
        for one in (estimate.motion, estimate.unsmoothed)
    )
    cloud, meshes = replace(estimate.cloud, points_mm=points_mm), estimate.meshes.items()
    moved = {n: m.moved(transform_points(camera_from_last, m.vertices_mm)) for n, m in meshes}
    return replace(estimate, cloud=cloud, meshes=moved, motion=motion, unsmoothed=unsmoothed)


def region_for(
    model: Model | None = None,
    *,
    range_mm: tuple[float, float] | None = None,
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    whole: bool = False,
) -> RegionConfig:
    """Depths that training showed, unless others are given; where it showed any distance, its
    farthest organ still lies in them whole. Pieces of about the organ's size, if that is known.

    ``box_mm``: opposite corners, camera frame. ``whole``: everything in range is the organ.
    """
    if model is None:
        near, far = range_mm or (CloudConfig().near_mm, CloudConfig().far_mm)
        return RegionConfig(crop=CloudConfig(near_mm=near, far_mm=far), box_mm=box_mm)
    scene = model.config.scene
    near, far = scene.cloud.near_mm, scene.cloud.far_mm
    if scene.free_range > 0:
        nearest, farthest = scene.free_nearest_mm
        near, far = min(near, nearest - 5), max(far, farthest + far - near)
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
    # A surface as uneven as a noisy sensor shows it is not many pieces.
    noise_mm = max(RegionConfig().noise_mm, scene.noise.axial_mm)
    return RegionConfig(crop=crop, box_mm=box_mm, organ_mm=size_mm, noise_mm=noise_mm)
