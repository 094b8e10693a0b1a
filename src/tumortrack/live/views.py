"""From what cameras saw together, or one camera in turn, to an estimate: frames are checked, the
organ's points found in each view, and all views fitted as one."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from tumortrack.core.assessment import deciding
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import IDENTITY, Affine, transform_points, unit
from tumortrack.core.report import Finding, ScanReport
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud, View
from tumortrack.live.tools import Tools
from tumortrack.live.values import CameraView, Observation, PublishedFrame, SinkContext
from tumortrack.segmentation import Hints, RegionConfig, organ_points
from tumortrack.segmentation.measured_noise import DepthNoise
from tumortrack.segmentation.tissue import TissueClassifier
from tumortrack.segmentation.watch import TableWatch
from tumortrack.tracking.cuts import Cuts
from tumortrack.tracking.follower import Follower
from tumortrack.tracking.tracker import Tracker

_NOISE_S = 1.0  # a camera's noise is measured so often: as long as a frame's other work takes
_PICK_S = 3.0  # without the organ: a pick is forgotten

SCAN_VIEWS, SCAN_WITHIN_S = 3, 5.0
# A view sees the organ's shift along its own line of sight, within a millimetre or so. What the
# others leave open sideways is half along the line of a view from 30 degrees aside.
SCAN_APART_DEG = 30.0

OrganInView = tuple[CameraView, SensorCloud]  # the organ's points in it

_UNNAMED = "the calibration names no camera_frame_id: whose frames these are is not checked"
_NAMELESS = "the source does not say whose frames it sends: that is not checked"
_BLIND = "no table is seen: camera motion cannot be detected"
_SLIDING = (
    "the table's plane is watched; a camera that slides along it, or turns about its normal, is "
    "not noticed"
)


class FrameCheck:
    """Checks of one camera's frames: they are new, and from the calibrated camera at its calibrated
    pose. The table is watched only if results depend on that. ``notes``: what cannot be checked.

    A sensor's noise never repeats bit for bit: an image that does is old, whatever its stamp. A
    camera that was replaced, zoomed or set to another mode may also have another pose, so its
    frames are refused until a restart.
    """

    def __init__(self, published: PublishedFrame, config: RegionConfig, frozen_s: float) -> None:
        self._published, self._frozen_s = published, frozen_s
        self._values: np.ndarray | None = None
        self._since_ns = self._last_ns = 0  # the earliest arrival of this image; the last frame
        self._camera: Intrinsics | None = None
        self._first: Observation | None = None
        watched = published.calibrated and not published.moves
        self.watch = TableWatch(config, published.table_in_camera) if watched else None
        self.notes: list[str] = []
        if published.calibrated and not published.camera_frame_id:
            self.notes.append(_UNNAMED)

    def check(self, seen: Observation) -> str:
        """A doubt about this frame, or an empty text. Raises NoEstimate if its camera is not that
        of the calibration and of the first frame, and once camera or table have moved."""
        name, wanted = seen.frame_id, self._published.camera_frame_id
        self._first = self._first or seen
        first = self._first.frame_id
        self._note(_NAMELESS, bool(wanted) and first is None)
        if wanted and name not in (None, wanted):
            raise NoEstimate(Finding("other_frame_id", {"name": name, "wanted": wanted}))
        if name != first:
            raise NoEstimate(Finding("frame_id_changed", {"first": first, "name": name}))
        if isinstance(seen.content, DepthFrame):
            camera = seen.content.intrinsics
            self._camera = self._camera or camera
            if camera != self._camera:
                values = {"before": _text(self._camera), "now": _text(camera)}
                raise NoEstimate(Finding("intrinsics_changed", values))
        if self.watch is None:
            return ""
        doubt = self.watch.check(seen.content)
        self._note(_SLIDING, self.watch.table_in_camera is not None)
        self._note(_BLIND, self.watch.blind)
        return doubt

    def check_new(self, content: DepthFrame | SensorCloud) -> None:
        """Raises NoEstimate if the same image has been repeated for too long."""
        values = content.depth_mm if isinstance(content, DepthFrame) else content.points_mm
        before_ns, self._last_ns = self._last_ns, content.stamp_ns
        if self._values is None or not _same(values, self._values):
            # It may have come right after the frame taken last: others were dropped.
            self._since_ns = content.stamp_ns if self._values is None else before_ns
            self._values = values
            return
        same_s = (content.stamp_ns - self._since_ns) * 1e-9
        if 0 < self._frozen_s <= same_s:
            raise NoEstimate(Finding("frozen", {"seconds": same_s}))

    def _note(self, note: str, now: bool) -> None:
        if now and note not in self.notes:
            self.notes.append(note)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Bit for bit: NaN (no return) equals itself."""
    return a is b or (a.shape == b.shape and bool(np.array_equal(a.view("u4"), b.view("u4"))))


def _text(camera: Intrinsics) -> str:
    size, center = f"{camera.width} x {camera.height}", f"({camera.cx:g}, {camera.cy:g})"
    return f"{size} (f {camera.fx:g}, {camera.fy:g}, centre {center})"


class ViewsLocator:
    """Locates in the views of one run; ``seed``: of the random points. An estimate is in the frame
    of its first view's camera, which may be another, or stand differently, in the next frame."""

    def __init__(
        self,
        follower: Follower,
        context: SinkContext,
        region: RegionConfig,
        frozen_s: float,
        seed: int,
    ) -> None:
        self._follower, self._context = follower, context
        self._region, self._frozen_s, self._seed = region, frozen_s, seed
        self.scan: Scan | None = None  # makes the first estimate, and is gone then
        self.scanned = ""  # what each of its views added
        self._published_from_last = context.published_frame.published_from_camera
        self._picked: Float64[np.ndarray, " 3"] | None = None  # by the user, published frame
        self._place_mm: Float64[np.ndarray, " 3"] | None = None  # where that is by now
        self._tissue_classifier: TissueClassifier | None = None  # likewise
        self._found_s = time.monotonic()
        # Of the first camera by its calibration, of others as they come.
        self.frames = FrameCheck(context.published_frame, region, frozen_s)
        self._frames = {1: self.frames}
        self._noises: dict[int, tuple[int, DepthNoise]] = {}  # of each camera, and when
        self.tools = Tools({}, context, self.frames.notes)
        self.evidence: tuple[Evidence, ...] = ()  # that the present frame brought

    @property
    def cuts(self) -> Cuts:
        """What was cut of the organ."""
        return self._follower.cuts

    def find(
        self, views: list[CameraView], absent: dict[int, str], seconds: dict[str, float]
    ) -> tuple[list[OrganInView], str]:
        """The organ in each view, and a doubt about the frames. Where several cameras are, those
        that do not see it become ``absent``, with the reason. Raises NoEstimate: none sees it."""
        self._update_selection()
        self.evidence = ()
        found, doubts, several = [], [], len(views) + len(absent) > 1
        for view in views:
            try:
                organ, doubt = self._organ(view, seconds)
            except NoEstimate as error:
                if not several:
                    raise
                absent[view.number] = str(error)
                continue
            found.append((view, organ))
            if doubt:
                doubts.append(f"camera {view.number}: {doubt}" if several else doubt)
        if not found:
            raise NoEstimate(Finding("cameras", {"troubles": camera_words([], absent)}))
        return found, "; ".join(doubts)

    def locate(self, found: list[OrganInView], evidence: Sequence[Evidence] = ()) -> Estimate:
        """In the frame of the first view's camera, as is the evidence. Raises NoEstimate as
        ``Follower.locate``."""
        (lead, organ), *more = found
        if self.scan is not None:
            estimate = self.scan.take(lead, organ)
            self._follower.begin(estimate)
            self.scanned = self.scan.summary
            self.frames.notes.append(self.scanned)
            self.scan, self._published_from_last = None, lead.published_from_camera
            return estimate
        way = self._camera_from_last(lead)
        self.evidence = (*evidence, *self.tools.evidence(lead))
        if self._context.controls.cut.is_set():  # also by tools
            self._context.controls.cut.clear()
            self.cuts.tell()
        estimate = self._follower.locate(
            organ,
            lead.seen.content,
            views=_further_views(lead, more),
            evidence=self.evidence,
            camera_from_last=way,
        )
        self.tools.located(lead, estimate)
        self._published_from_last = lead.published_from_camera
        self._follow_pick(lead, organ)
        return estimate

    def _organ(self, view: CameraView, seconds: dict[str, float]) -> tuple[SensorCloud, str]:
        """The organ's points, and a doubt about the frame."""
        seen = view.seen
        if (frames := self._frames.get(view.number)) is None:  # where it stands is calibrated too
            place = PublishedFrame(self._context.published_frame.frame_id, calibrated=True)
            frames = FrameCheck(place, self._region, self._frozen_s)
            frames.notes, self._frames[view.number] = self.frames.notes, frames
        with timed(seconds, "frame"):
            doubt = frames.check(seen)
        with timed(seconds, "organ"):
            rng = np.random.default_rng((self._seed, seen.stamp_ns))
            measured_ns, noise = self._noises.get(view.number, (0, None))
            if not 0 <= seen.stamp_ns - measured_ns < _NOISE_S * 1e9:  # a replay does the same
                noise = None
            hints = replace(self._hints(view), noise=noise)
            organ = organ_points(seen.content, self._region, hints, rng)
            if noise is None and organ.noise is not None:
                self._noises[view.number] = seen.stamp_ns, organ.noise
        frames.check_new(seen.content)  # that it shows nothing would be said before
        return organ.cloud, "; ".join(filter(None, (doubt, organ.doubt)))

    def _camera_from_last(self, view: CameraView) -> Affine:
        """From the frame of the last estimate."""
        if np.array_equal(view.published_from_camera, self._published_from_last):
            return IDENTITY
        return np.linalg.inv(view.published_from_camera) @ self._published_from_last

    def _update_selection(self) -> None:
        controls = self._context.controls
        if controls.acknowledged.is_set():
            controls.acknowledged.clear()
            self._follower.disputes.acknowledge()
            self.cuts.deny()
        if controls.forgotten.is_set():
            controls.forgotten.clear()
            self._follower.forget()
            self._follower.disputes.acknowledge()  # it is gone with the rest of the evidence
        if (
            controls.tissue_classifier is not self._tissue_classifier
        ):  # what was taken for the organ may be wrong
            self._tissue_classifier = controls.tissue_classifier
            self._follower.forget()
        if controls.picked_mm is not self._picked:  # the user chose again
            self._picked = self._place_mm = controls.picked_mm
            self._found_s = time.monotonic()
            self._follower.forget()
        elif self._picked is not None and time.monotonic() - self._found_s > _PICK_S:
            controls.picked_mm = None  # it is not there any more, nor where it was seen last
            self._picked = self._place_mm = None

    def _hints(self, view: CameraView) -> Hints:
        way, place_mm = self._camera_from_last(view), None
        last_box_mm = self._follower.last_box_mm(view.seen.stamp_ns, way)
        # Once the organ is found its box is the better guide: pieces may cover the place.
        if last_box_mm is None and self._place_mm is not None:
            camera_from_published = np.linalg.inv(view.published_from_camera)
            place_mm = transform_points(camera_from_published, self._place_mm[None])[0]
        seen = view.seen
        return Hints(seen.mask, place_mm, last_box_mm, seen.picture, self._tissue_classifier)

    def _follow_pick(self, view: CameraView, organ: SensorCloud) -> None:
        """The organ was found: what the user picked moves along with it."""
        self._found_s = time.monotonic()
        if self._picked is not None:
            points_mm = transform_points(view.published_from_camera, organ.points_mm.astype(float))
            off_mm = np.linalg.norm(points_mm - np.median(points_mm, axis=0), axis=1)
            self._place_mm = points_mm[int(off_mm.argmin())]


class Scan:
    """A first estimate from several views of a camera that is led round an organ at rest.
    ``summary``: what each view added, once it is done."""

    def __init__(self, tracker: Tracker) -> None:
        if tracker.anatomy_ct is None:
            raise InputError("a scan needs a model that knows a motion: give the case itself.")
        self._tracker, self.summary = tracker, ""
        self._views: list[OrganInView] = []

    def take(self, view: CameraView, organ: SensorCloud) -> Estimate:
        """The estimate from all views, in the frame of the last. Raises NoEstimate: they are too
        few yet, too much alike, or do not show one organ at rest; then it starts over."""
        oldest_ns = view.seen.stamp_ns - SCAN_WITHIN_S * 1e9
        self._views = [known for known in self._views if known[0].seen.stamp_ns >= oldest_ns]
        cosines = [_towards(view, organ) @ _towards(*known) for known in self._views]
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        if angles.min(initial=180.0) >= SCAN_APART_DEG:
            self._views.append((view, organ))
        if len(self._views) < SCAN_VIEWS:
            values: dict[str, float | str] = {"views": len(self._views), "of": SCAN_VIEWS}
            values |= {"degrees": SCAN_APART_DEG, "seconds": SCAN_WITHIN_S}
            raise NoEstimate(Finding("scan_waits", values))
        *others, (last, cloud) = self._views
        self._views = []
        views = _further_views(last, others)
        try:
            estimates = [
                self._tracker.follow(cloud, full_view=last.seen.content, views=views[:n])
                for n in range(SCAN_VIEWS)
            ]
        except NoEstimate as error:
            raise NoEstimate(Finding("scan_failed", {"reason": str(error)})) from error
        whole = estimates[-1]
        if whole.quality != "good":
            raise NoEstimate(Finding("scan_poor", {"reason": whole.reason}))
        bounds_mm = tuple(_least_sure_mm(estimate) for estimate in estimates)
        whole = whole.reporting(scan=ScanReport(error_bound95_mm=bounds_mm))
        steps = ", then ".join(f"{mm:.1f} mm" for mm in bounds_mm)
        self.summary = (
            f"scan: the least sure tumor was off by at most {steps} (95 %), with one to "
            f"{SCAN_VIEWS} views"
        )
        return whole


def _further_views(lead: CameraView, views: Sequence[OrganInView]) -> list[View]:
    """Views beside that of the camera that leads."""
    lead_from_published = np.linalg.inv(lead.published_from_camera)
    return [
        View(organ, view.seen.content, lead_from_published @ view.published_from_camera)
        for view, organ in views
    ]


def _towards(view: CameraView, organ: SensorCloud) -> Float64[np.ndarray, " 3"]:
    """The direction from the organ to the camera, published frame."""
    places_mm = transform_points(view.published_from_camera, organ.points_mm.astype(float))
    return unit(view.published_from_camera[:3, 3] - np.median(places_mm, axis=0))


def _least_sure_mm(estimate: Estimate) -> float:
    """How far off the tumor, or else the organ, that is least sure is at most."""
    bounds = deciding(estimate.assessment.bounds).values()
    return max((bound.error_bound95_mm for bound in bounds), default=0.0)


def camera_words(numbers: list[int], absent: dict[int, str]) -> str:
    """Which cameras an estimate is from, and why the others say nothing."""
    by = [f"camera{'s' * (len(numbers) > 1)} {', '.join(map(str, sorted(numbers)))}"]
    return "; ".join(by * bool(numbers) + [f"camera {n}: {absent[n]}" for n in sorted(absent)])


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds how long a ``with`` block took, also where it raises."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start
