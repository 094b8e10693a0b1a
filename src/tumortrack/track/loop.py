"""The live loop: newest frame -> organ's points -> estimate -> every sink.

Each frame gives exactly one update; where nothing can be said, it says so and why, and no older
answer is ever given again.
"""

from __future__ import annotations

import math
import re
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.types import Anatomy, DepthFrame
from tumortrack.sense.camera import d405
from tumortrack.sense.region import Hints, RegionConfig, organ_points
from tumortrack.track.clock import StampCheck
from tumortrack.track.estimate import Estimate
from tumortrack.track.follower import Follower, FollowerConfig
from tumortrack.track.live import Quality, Seen, Setting, SourceLost, Update
from tumortrack.track.meter import Histogram
from tumortrack.track.outlet import Outlet
from tumortrack.track.quality import judge
from tumortrack.track.reader import Reader
from tumortrack.track.tracker import Tracker

_KINDS = 50  # of reasons that are counted apart
_DEFECTS = 5  # tracebacks that are kept


class LoopConfig(Config, frozen=True, kw_only=True):
    """``stale_s``: no frame for so long, or one that old, gives 'no estimate'. ``give_up_s``: the
    loop ends where no frame came for so long. ``seconds``: the loop ends so long after the first
    frame; 0: never.
    """

    region: RegionConfig = RegionConfig()
    follower: FollowerConfig = FollowerConfig()
    stale_s: float = 0.5
    give_up_s: float = 60.0
    seconds: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.stale_s < self.give_up_s:
            raise InputError(
                f"stale_s {self.stale_s:g} and give_up_s {self.give_up_s:g}: both must be more "
                "than 0 s, and the first less than the second."
            )
        if not self.seconds >= 0:
            raise InputError(f"seconds is {self.seconds:g}; it must be 0 (no end) or more.")


class Loop:
    """One run from a source to sinks. ``run`` returns when the source ends, when ``stop`` was
    called from anywhere, or when the time is up."""

    def __init__(self, tracker: Tracker, setting: Setting, config: LoopConfig) -> None:
        self._config, self._setting = config, setting
        self._follower = Follower(tracker, config.follower)
        self._stamps = StampCheck(config.stale_s)
        self._stop = threading.Event()
        self._sequence = 0
        self._picked: np.ndarray | None = None
        self.latency = Histogram()
        self.stages: dict[str, Histogram] = {}
        self.errors: dict[str, Histogram] = {}  # mm, of a source that knows the truth
        self.counts: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.defects: list[str] = []

    @property
    def clock_jumps(self) -> int:
        """How often the source's clock was set back."""
        return self._stamps.jumps

    def warm(self) -> None:
        """Do once what every frame needs, so that the first does not wait for it."""
        bump = np.full((240, 424), 180.0, np.float32)
        rows, columns = np.mgrid[:240, :424]
        middle = np.hypot(rows - 120, columns - 212) < 60
        bump[middle] = 140 + 0.005 * ((rows - 120) ** 2 + (columns - 212) ** 2)[middle]
        with suppress(NoEstimate):
            frame = DepthFrame(bump, d405(424, 240))
            organ_points(frame, self._config.region, Hints(), np.random.default_rng(0))
        self._follower.warm()

    def stop(self) -> None:
        """Ask the loop to end after the frame it is at."""
        self._stop.set()

    def run(self, reader: Reader, outlets: list[Outlet], seen_by: Callable[[Update], None]) -> None:
        """``seen_by`` is called with every update, after the outlets have it.

        Raises:
            SourceLost: no frame came for ``give_up_s``.
            TumortrackError: the source can never work (as its ``open`` said).
        """
        fresh = time.monotonic()
        ends = math.inf
        while not self._stop.is_set():
            got = reader.take(self._config.stale_s)
            now = time.monotonic()
            if isinstance(got, Seen):
                fresh = now
                if self._config.seconds and ends == math.inf:
                    ends = now + self._config.seconds
                update = self._answer(got, reader.born_ns(got))
            elif reader.ended:
                return
            else:
                update = self._silence(got, now - fresh, reader.trouble)
            self._publish(update, outlets)
            seen_by(update)
            if now >= ends:
                return
            if now - fresh > self._config.give_up_s:
                trouble = f": {reader.trouble}" if reader.trouble else ""
                raise SourceLost(
                    f"no frame for {now - fresh:.0f} s{trouble}. Look at the camera or the topic, "
                    "then start again."
                )

    def _answer(self, seen: Seen, born_ns: int) -> Update:
        """The update of one frame, which came to be at ``born_ns``."""
        seconds: dict[str, float] = {}
        organ, estimate, reason = None, None, ""
        quality: Quality = "none"
        warning = ""
        try:
            self._believe(seen.stamp_ns, born_ns)
            with timed(seconds, "organ"):
                rng = np.random.default_rng((self._config.follower.seed, seen.stamp_ns))
                region = organ_points(seen.content, self._config.region, self._hints(seen), rng)
                organ = region.cloud
            with timed(seconds, "locate"):
                estimate = self._follower.locate(organ)
            seconds |= {f"locate.{k}": v for k, v in estimate.report["timings"].items()}
            quality, warning = judge(estimate)
        except TumortrackError as error:
            reason = str(error)
        except Exception as error:  # a defect of ours: said, kept, and the next frame is tried
            self._remember(error)
            reason = f"internal error, {type(error).__name__}: {error}"
        if reason:
            self._follower.forget()
            estimate = None
        return Update(
            self._next(),
            seen.stamp_ns,
            estimate,
            reason,
            quality,
            warning,
            seen,
            organ,
            self._setting.frames,
            seconds,
            latency_ms=(time.time_ns() - born_ns) * 1e-6,
        )

    def _believe(self, stamp_ns: int, born_ns: int) -> None:
        jumps = self._stamps.jumps
        self._stamps.check(stamp_ns, (time.time_ns() - born_ns) * 1e-9)
        if self._stamps.jumps > jumps:
            self._follower.forget()

    def _hints(self, seen: Seen) -> Hints:
        picked = self._setting.controls.picked_mm
        if picked is not self._picked:  # the user chose anew
            self._picked = picked
            self._follower.forget()
        last_box_mm = self._follower.last_box_mm(seen.stamp_ns)
        # Once the organ is found its box is the better guide: the picked point does not move along.
        return Hints(
            mask=seen.mask,
            picked_mm=picked if last_box_mm is None else None,
            last_box_mm=last_box_mm,
        )

    def _silence(self, fault: TumortrackError | None, silent_s: float, trouble: str) -> Update:
        """The update where there is no frame."""
        reason = str(fault) if fault is not None else trouble or f"no frame for {silent_s:.1f} s"
        self._follower.forget()
        return Update(self._next(), time.time_ns(), reason=reason, frames=self._setting.frames)

    def _publish(self, update: Update, outlets: list[Outlet]) -> None:
        for outlet in outlets:
            outlet.put(update)
        self.counts[update.quality] += 1
        if update.reason:
            self._count_reason(update.reason)
        if update.latency_ms is not None:
            self.latency.add(update.latency_ms)
        for name, stage_s in update.seconds.items():
            self.stages.setdefault(name, Histogram()).add(1000 * stage_s)
        if (
            update.seen is not None
            and update.seen.truth is not None
            and update.estimate is not None
        ):
            self._hold_against(update.estimate, update.seen.truth)

    def _hold_against(self, estimate: Estimate, truth: Anatomy) -> None:
        for name, true in zip(truth.names, truth.parts, strict=True):
            if name in estimate.meshes:
                off = estimate.meshes[name].box_mm.mean(0) - true.box_mm.mean(0)
                self.errors.setdefault(name, Histogram()).add(float(np.linalg.norm(off)))

    def _count_reason(self, reason: str) -> None:
        kind = re.sub(r"-?[0-9]+([.,][0-9]+)?", "#", reason)
        if kind not in self.reasons and len(self.reasons) >= _KINDS:
            kind = "other reasons"
        self.reasons[kind] += 1

    def _remember(self, error: Exception) -> None:
        if len(self.defects) < _DEFECTS:
            self.defects.append("".join(traceback.format_exception(error)))

    def _next(self) -> int:
        self._sequence += 1
        return self._sequence - 1


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Notes how long a ``with`` block took, also where it raises."""
    start = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = time.perf_counter() - start


def summary(loop: Loop, reader: Reader, outlets: list[Outlet]) -> dict:
    """What the run was like (JSON types): counts, latencies and stage times in ms."""
    return {
        "updates": sum(loop.counts.values()),
        "estimates": {"good": loop.counts["good"], "poor": loop.counts["poor"]},
        "no_estimate": loop.counts["none"],
        "reasons": dict(loop.reasons.most_common()),
        "dropped": reader.dropped,
        "opened": reader.opened,
        "clock_jumps": loop.clock_jumps,
        "latency_from": reader.latency_from,
        "latency_ms": loop.latency.summary(),
        "stages_ms": {name: times.summary() for name, times in loop.stages.items()},
        "center_error_mm": {name: errors.summary() for name, errors in loop.errors.items()},
        "sinks": {outlet.name: outlet.summary() for outlet in outlets},
        "defects": loop.defects,
    }
