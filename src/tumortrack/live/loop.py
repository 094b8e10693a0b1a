"""The live loop: newest frame -> organ's points -> estimate -> every sink.

Each frame gives exactly one result: an estimate, or the reason why there is none. An older
estimate is never repeated.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from tumortrack.core.assessment import Quality
from tumortrack.core.camera import d405, with_depth_error
from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Evidence
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthError, DepthFrame, Intrinsics
from tumortrack.io.depth_files import DepthCorrection
from tumortrack.live.cameras import Cameras
from tumortrack.live.meter import RunStatistics
from tumortrack.live.values import (
    CameraView,
    Controller,
    Observation,
    SinkContext,
    SourceLost,
    TrackingResult,
)
from tumortrack.live.views import OrganInView, Scan, ViewsLocator, camera_words, timed
from tumortrack.live.workers import OPENING_S, SinkWorker, SourceWorker
from tumortrack.segmentation import Hints, RegionConfig, organ_points
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.tracker import Tracker

_QUIET = 0.8  # of stale_s: silence is reported while the last result is still valid
_AHEAD_S = 0.1  # allowed difference of two clocks
SURE_AFTER = 3  # good estimates in a row after doubt: single frames of something else may pass


class LoopConfig(Config, frozen=True, kw_only=True):
    """``stale_s``: after this time without a frame, or with one that old, there is 'no estimate'.
    ``give_up_s``: after this time without a frame the loop ends. Neither counts a source's opening,
    nor holds for one whose frames are made ``on_demand``. ``intrinsics``: replace the
    source's, ``correction`` of depths included; ``depth_error``: of depths. ``frozen_s``: an image
    that repeats bit for bit for this time is old; 0: it may repeat. ``seconds``: the loop ends this
    time after the first frame; 0: never. ``scan``: the first estimate is from several views."""

    region: RegionConfig = RegionConfig()
    follower: FollowerConfig = FollowerConfig()
    intrinsics: Intrinsics | None = None
    correction: DepthCorrection = DepthCorrection()
    depth_error: DepthError | None = None
    stale_s: float = 0.5
    give_up_s: float = 60.0
    seconds: float = 0.0
    frozen_s: float = 0.25
    scan: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.stale_s < self.give_up_s:
            raise InputError(
                f"stale_s {self.stale_s:g} and give_up_s {self.give_up_s:g}: both must be more "
                "than 0 s, and the first less than the second."
            )
        if not self.seconds >= 0:
            raise InputError(f"seconds is {self.seconds:g}; it must be 0 (no end) or more.")
        if not self.frozen_s >= 0:
            raise InputError(f"frozen_s is {self.frozen_s:g}; it must be 0 (any) or more.")


def check_age(age_s: float, stale_s: float, other_clock: bool = True) -> None:
    """Raises NoEstimate for a frame that is stale, or from the future. ``other_clock``: the age is
    by a camera's clock against this computer's."""
    clocks = "the clocks of camera and computer"
    if age_s > stale_s:
        doubt = f", if {clocks} agree" if other_clock else ""
        raise NoEstimate(Finding("stale", {"seconds": age_s, "doubt": doubt}))
    if age_s < -_AHEAD_S:
        raise NoEstimate(Finding("future", {"seconds": -age_s, "clocks": clocks}))


class Loop:
    """One run from a source to sinks: until the source ends, ``stop`` is called, or time is up."""

    def __init__(
        self,
        tracker: Tracker,
        context: SinkContext,
        config: LoopConfig,
    ) -> None:
        self._config, self._context, self._controller = config, context, context.controller
        self._follower = Follower(tracker, config.follower)
        seed = config.follower.seed
        self.views = ViewsLocator(self._follower, context, config.region, config.frozen_s, seed)
        if config.scan:
            self.views.scan = Scan(tracker)
        self._stop = threading.Event()
        self._sequence = itertools.count()
        self._cameras: Cameras
        self._published = context.published_frame  # by its source's name, if it has no other
        self._in_a_row = SURE_AFTER  # good estimates since the last doubt
        self._source_intrinsics: Intrinsics | None = None  # of the first frame, if others are given
        self._stamp: tuple[int, int] | None = None  # of the last frame, and when it was handled
        self.statistics = RunStatistics()

    def warm(self) -> None:
        """Run each step once: the first frame need not wait for imports."""
        bump = np.full((240, 424), 180.0, np.float32)
        rows, columns = np.mgrid[:240, :424]
        middle = np.hypot(rows - 120, columns - 212) < 60
        bump[middle] = 140 + 0.005 * ((rows - 120) ** 2 + (columns - 212) ** 2)[middle]
        with suppress(NoEstimate):
            frame = DepthFrame(bump, d405(424, 240))
            organ_points(frame, self._config.region, Hints(), np.random.default_rng(0))
        self._follower.warm()

    def stop(self) -> None:
        """End the loop after the present frame."""
        self._stop.set()

    def run(
        self,
        source: SourceWorker | Cameras,
        sink_workers: list[SinkWorker],
        on_result: Callable[[TrackingResult], None],
    ) -> None:
        """``on_result`` is called with every result, after the sinks have got it. Raises
        SourceLost: no frame came for ``give_up_s``, or it did not open; and whatever keeps a source
        from working."""
        if not isinstance(source, Cameras):
            source = Cameras([source], [self._context.published_frame.published_from_camera])
        self._cameras = source
        import scipy.spatial  # noqa: F401 - slow: while sources open, before a poor frame needs it

        try:
            for result in self._results(source):
                on_result(self._publish(result, sink_workers))
                if self._controller is not None and self._controller.ended:
                    return
        finally:
            if self._controller is not None and not self._controller.ended:
                self._controller.stop("ended")
                self._publish(self._without_frame("tracking has ended"), sink_workers)

    def _results(self, source_worker: Cameras) -> Iterator[TrackingResult]:
        fresh_s = time.monotonic()
        quiet_s = _QUIET * self._config.stale_s
        ends_s, shown_s = math.inf, fresh_s  # the time of what is shown
        while not self._stop.is_set():
            opening = not source_worker.ready_s
            got = source_worker.take(max(shown_s + quiet_s - time.monotonic(), 0.0))
            now_s = shown_s = time.monotonic()
            # In this order: the reader writes them in the other one.
            on_demand, trouble = source_worker.on_demand, source_worker.trouble
            ready_s = source_worker.ready_s
            fresh_s = now_s if on_demand and got is None else max(fresh_s, ready_s)
            if isinstance(got, Observation):
                got = self._calibrated(got)
            if isinstance(got, Observation):
                fresh_s = now_s
                if self._config.seconds and ends_s == math.inf:
                    ends_s = now_s + self._config.seconds
                result, shown_s = self._shown(got, source_worker)
                yield result
            elif got is not None:
                yield self._without_frame(got)
            elif source_worker.ended:
                return
            elif opening and ready_s:
                shown_s = fresh_s  # it has just opened, so it may be silent from now on
            elif not on_demand:
                silence = Finding("no_frame", {"seconds": now_s - fresh_s})
                yield self._without_frame(trouble or silence)
            if now_s >= ends_s:
                return
            most_s = self._config.give_up_s if ready_s else OPENING_S
            _check_heard(now_s - fresh_s, most_s, trouble)

    def _shown(self, seen: Observation, source: Cameras) -> tuple[TrackingResult, float]:
        """The result of a frame, and of what time it is, by ``time.monotonic``."""
        live_clock = source.latency_from != "taking"
        self._follower.cuts.beside = live_clock
        # A frame that is made on demand waits for this computer alone, however slow that is.
        stale_s = math.inf if source.on_demand else self._config.stale_s
        result = self._answer(seen, source.capture_ns(seen), live_clock, stale_s)
        late_ms = result.latency_ms if live_clock and result.estimate is not None else None
        return result, time.monotonic() - (late_ms or 0.0) / 1000

    def _answer(
        self, seen: Observation, capture_ns: int, live_clock: bool, stale_s: float
    ) -> TrackingResult:
        """The result of one frame of the time ``capture_ns``. ``live_clock``: time goes on while we
        work, so an answer can come too late: more than ``stale_s`` after its frame."""
        organ, estimate, reason, warning, timely = None, None, "", "", False
        quality: Quality = "none"
        finding: Finding | None = None
        views: list[CameraView] = []
        absent: dict[int, str] = {}  # cameras without the organ, and why
        found: list[OrganInView] = []
        seconds: dict[str, float] = {}
        several = len(self._cameras.workers) > 1
        try:
            # Simulations have this computer's clock, and so has the arrival.
            other_clock = capture_ns == seen.stamp_ns and seen.truth is None
            check_age(_age_s(capture_ns), stale_s, other_clock)
            timely = True
            if self._stamp is not None and seen.stamp_ns <= self._stamp[0]:  # set back: see workers
                self.statistics.clock_jumps += 1
                self._follower.forget()
            with timed(seconds, "frame"):
                views, absent = self._cameras.views(seen)
                views = [self._stated(view) for view in views]
            found, doubt = self.views.find(views, absent, seconds)
            organ = found[0][1]
            with timed(seconds, "locate"):
                known: tuple[Evidence, ...] = ()
                if self._controller is not None:
                    place, stamp_ns = found[0][0].published_from_camera, found[0][0].seen.stamp_ns
                    known = self._controller.evidence(np.linalg.inv(place), stamp_ns)
                estimate = self.views.locate(found, known)
            seconds |= {f"locate.{k}": v for k, v in estimate.report.timings.items()}
            if several:
                estimate = estimate.reporting(cameras=tuple(view.number for view, _ in found))
            finding, warning = self._confirmed(estimate, doubt)
            quality = "good" if finding is None else "poor"
            if finding is not estimate.finding:  # what holds in this frame holds for its estimate
                estimate = estimate.assessed(finding=finding)
            if live_clock and _age_s(capture_ns) > stale_s:
                raise NoEstimate(Finding("too_late", {"seconds": _age_s(capture_ns)}))
        except Exception as error:
            finding = _finding_of(error)
            estimate, reason, quality, warning = None, str(error), "none", ""
            # If only the time was wrong, the last estimate is the best start of the next search.
            if timely and finding.kind != "too_late":
                self._follower.lose()
                self._in_a_row = 0
            if not isinstance(error, TumortrackError):  # a defect of ours: the next frame is tried
                self.statistics.add_defect(error)
                finding = Finding("defect", {"message": type(error).__name__, "error": str(error)})
                reason = finding.message
        self._stamp = (seen.stamp_ns, time.monotonic_ns())
        unnamed = self._published.frame_id == "camera" and not self._published.calibrated
        if unnamed and seen.frame_id:
            self._published = replace(self._published, frame_id=seen.frame_id)
        published, numbers = self._published, [view.number for view, _ in found]
        lead = found[0][0] if found else next(iter(views), None)
        return TrackingResult(
            next(self._sequence),
            seen.stamp_ns,
            estimate,
            reason,
            quality,
            warning,
            lead.seen if lead is not None else None if published.moves else seen,
            organ,
            published if lead is None else published.of_camera(lead.published_from_camera),
            seconds,
            latency_ms=1000 * _age_s(capture_ns),
            dropped=self._cameras.dropped,
            views=tuple(views) if several else (),
            cameras=camera_words(numbers, absent) if several else self.views.scanned,
            finding=finding,
            evidence=self.views.evidence,
        )

    def _confirmed(self, estimate: Estimate, doubt: str) -> tuple[Finding | None, str]:
        """The finding against it and its words, with a doubt about the frame; after doubt an
        estimate counts as good again when several in a row were."""
        finding, warning = estimate.finding, estimate.reason
        if doubt and finding is None:
            finding, warning = Finding("frame_in_doubt", {"message": doubt}), doubt
        self._in_a_row = self._in_a_row + 1 if finding is None else 0
        if 0 < self._in_a_row < SURE_AFTER:
            finding = Finding("good_again", {"frames": self._in_a_row, "of": SURE_AFTER})
            return finding, finding.message
        return finding, warning

    def _without_frame(self, reason: str | Finding | Exception) -> TrackingResult:
        """Its stamp is now, by the source's clock if that is known."""
        stamp_ns = time.time_ns()
        if self._stamp is not None:
            last_ns, then_ns = self._stamp
            stamp_ns = last_ns + time.monotonic_ns() - then_ns
        finding = _finding_of(reason)
        return TrackingResult(
            next(self._sequence),
            stamp_ns,
            reason=finding.message,
            published_frame=self._published,
            finding=finding,
        )

    def _calibrated(self, seen: Observation) -> Observation | InputError:
        """The frame with the intrinsics and depths that the user calibrated."""
        given, content = self._config.intrinsics, seen.content
        if given is None or not isinstance(content, DepthFrame):
            return seen
        has = content.intrinsics
        self._source_intrinsics = self._source_intrinsics or has
        if has != self._source_intrinsics:
            return InputError(
                "the camera's own intrinsics changed, and those of --intrinsics were for the ones "
                "before. If that is meant, calibrate it again and restart."
            )
        if (has.width, has.height) != (given.width, given.height):
            return InputError(
                f"the depth images are {has.width} x {has.height}, and --intrinsics is for "
                f"{given.width} x {given.height}; calibrate for the size that is streamed."
            )
        depth_mm = self._config.correction.corrected(content.depth_mm)
        return replace(seen, content=DepthFrame(depth_mm, given, content.stamp_ns))

    def _stated(self, view: CameraView) -> CameraView:
        """With the depth error that the user states of all cameras."""
        if (error := self._config.depth_error) is None:
            return view
        content = with_depth_error(view.seen.content, error)
        return replace(view, seen=replace(view.seen, content=content))

    def _publish(self, result: TrackingResult, sink_workers: list[SinkWorker]) -> TrackingResult:
        if self._controller is not None:
            result = self._act(self._controller, result)
        for sink_worker in sink_workers:
            sink_worker.put(result)
        self.statistics.add(result)
        return result

    def _act(self, controller: Controller, result: TrackingResult) -> TrackingResult:
        try:
            if self._context.controls.aborted.is_set():
                controller.stop("aborted")
            return controller.act(result)
        except Exception as error:  # a defect there stops the controller, but not tracking
            self.statistics.add_defect(error)
            controller.stop("defect", f"{type(error).__name__}: {error}")
            return result


def _check_heard(silent_s: float, most_s: float, trouble: str) -> None:
    if silent_s > most_s:
        why = trouble and f": {trouble.rstrip('.')}"
        raise SourceLost(
            f"no frame for {silent_s:.0f} s{why}. Look at the camera or the topic, then start "
            "again."
        )


def _finding_of(reason: str | Finding | Exception) -> Finding:
    known = reason.finding if isinstance(reason, NoEstimate) else reason
    return known if isinstance(known, Finding) else Finding("source", {"message": str(reason)})


def _age_s(capture_ns: int) -> float:
    return (time.time_ns() - capture_ns) * 1e-9


def summary(
    loop: Loop, source: SourceWorker | Cameras, sink_workers: list[SinkWorker]
) -> dict[str, Any]:
    """The report of a run (JSON types): counts, latencies and stage times in ms."""
    readers = source.workers if isinstance(source, Cameras) else (source,)
    return loop.statistics.summary() | {
        "dropped": source.dropped,
        "opened": sum(reader.opened for reader in readers),
        "latency_from": source.latency_from,
        "sinks": {worker.name: worker.summary() for worker in sink_workers},
        "defects": loop.statistics.defects + [each for one in readers for each in one.defects],
    }
