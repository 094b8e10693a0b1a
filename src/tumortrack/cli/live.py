"""`tumortrack track`: source -> loop -> sinks, and what the user sees of it."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tumortrack.cli.console import console, say
from tumortrack.cli.loading import keep_loaded
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, StorageError

if TYPE_CHECKING:
    from tumortrack.core.types import Anatomy
    from tumortrack.live.loop import Loop, LoopConfig
    from tumortrack.live.sink_worker import SinkWorker
    from tumortrack.live.source_worker import SourceWorker
    from tumortrack.live.values import PublishedFrame, SinkConfig, SinkContext, TrackingResult
    from tumortrack.models.config import TrainConfig
    from tumortrack.plan.operation import Operation
    from tumortrack.sense.region import RegionConfig

_SAY_S, _SAY_PLAIN_S = 1.0, 5.0  # between two lines of state: on a terminal, in a file
STOPPED = "stopped by the user"  # why arms stand
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SETTLED_S = 60.0  # by then all buffers have their size: memory that grows on is a leak
_STORE_S = 10.0  # between two writings of the report: kill -9 loses no more


@dataclass(frozen=True)
class TrackOptions:
    range_mm: tuple[float, float] | None = None
    box_mm: tuple[float, float, float, float, float, float] | None = None
    whole: bool = False
    frame: Path | None = None
    intrinsics: Path | None = None
    smoothing_s: float = 0.0
    rescan_s: float = 1.0
    stale_s: float = 0.5
    give_up_s: float = 60.0
    seconds: float = 0.0
    report: Path | None = None
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True, eq=False)
class Arms:
    """Arms that act on what is tracked, and the frame in which everything is then published."""

    companion: Operation
    frames: PublishedFrame
    about: dict


def track(
    model_folder: Path,
    source: str,
    sinks: tuple[str, ...],
    options: TrackOptions,
    arms: Arms | None = None,
) -> None:
    """Runs until the source ends, the time is up, the arms have ended, or Ctrl-C."""
    from tumortrack.live.calibration_file import read_frames
    from tumortrack.live.spec import SOURCES
    from tumortrack.live.values import Controls, PublishedFrame, SinkContext
    from tumortrack.models.folder import read_model_manifest

    source_config = SOURCES.parse(source)
    sink_configs = parse_sinks(sinks)
    frames = read_frames(options.frame) if options.frame else PublishedFrame()
    if arms is not None:
        frames = arms.frames
    read_model_manifest(model_folder)  # what is wrong is said before PyTorch's seconds
    report = place_of_report(options.report, "track")

    from tumortrack.live.loop import Loop
    from tumortrack.live.source_worker import SourceWorker
    from tumortrack.tracking.tracker import Tracker
    from tumortrack.training.model import load_model

    if arms is None:
        keep_loaded()
    model = load_model(model_folder, options.device)
    for note in model.notes:
        say(f"note: {note}")
    tracker = Tracker(model)
    config = _loop_config(model.config, tracker.anatomy_ct, options)
    context = SinkContext(model.parts, frames, tracker.anatomy_ct, Controls(), arms is not None)
    loop = Loop(tracker, context, config, None if arms is None else arms.companion)
    about = {
        "model": model.provenance,
        "notes": list(model.notes),
        "model_sha256": store.sha256_of(model_folder / store.MANIFEST),
        "source": source,
        "sinks": list(sinks),
        "config": to_builtins(config),
        "frame": {
            "frame_id": frames.frame_id,
            "published_from_camera": frames.published_from_camera.tolist(),
        },
        **({} if arms is None else arms.about),
    }

    def stop() -> None:
        if arms is not None:
            arms.companion.abort(STOPPED)
        loop.stop()

    say("warming up ...")
    loop.warm()
    with ExitStack() as stack:
        stack.enter_context(stopping(stop))  # first in, last out: also while sinks flush
        screen = _Screen(loop, report, about, None if arms is None else arms.companion)
        stack.callback(screen.end)
        sink_workers = open_sinks(sinks, sink_configs, context, stack)
        source_worker = SourceWorker(source_config.open)
        stack.callback(source_worker.close)
        screen.watch(source_worker, sink_workers)
        say(f"tracking {source} in frame {frames.frame_id!r}; Ctrl-C ends it.")
        loop.run(source_worker, sink_workers, screen.show)


def parse_sinks(sinks: tuple[str, ...]) -> list[SinkConfig]:
    """Configurations of what was written on the command line."""
    from tumortrack.live.spec import SINKS

    configs = [SINKS.parse(sink) for sink in sinks]
    if doubled := sorted({sink for sink in sinks if sinks.count(sink) > 1}):
        raise InputError(f"sink {doubled[0]!r} is given twice.")
    return configs


def open_sinks(
    sinks: tuple[str, ...], configs: list[SinkConfig], context: SinkContext, stack: ExitStack
) -> list[SinkWorker]:
    """Each at work in a thread of its own, until the stack ends."""
    from tumortrack.live.sink_worker import SinkWorker

    sink_workers = []
    # Those that make a folder last: if another cannot open, none is left behind.
    pairs = zip(sinks, configs, strict=True)
    for spec, config in sorted(pairs, key=lambda pair: pair[1].queue_size):
        worker = SinkWorker(spec, config.open(context), config.queue_size)
        stack.callback(worker.close)
        sink_workers.append(worker)
    return sink_workers


def _loop_config(
    trained: TrainConfig, anatomy_ct: Anatomy | None, options: TrackOptions
) -> LoopConfig:
    from tumortrack.live.loop import LoopConfig
    from tumortrack.sense.files import read_intrinsics
    from tumortrack.tracking.tracker import FollowerConfig

    return LoopConfig(
        region=_region(trained, anatomy_ct, options),
        follower=FollowerConfig(
            rescan_s=options.rescan_s, smoothing_s=options.smoothing_s, seed=options.seed
        ),
        intrinsics=None if options.intrinsics is None else read_intrinsics(options.intrinsics),
        stale_s=options.stale_s,
        give_up_s=options.give_up_s,
        seconds=options.seconds,
    )


def _region(
    trained: TrainConfig, anatomy_ct: Anatomy | None, options: TrackOptions
) -> RegionConfig:
    """Depths that training showed, unless the user says others; where it showed any distance, its
    farthest organ still lies in them whole. Pieces of about the organ's size, if that is known."""
    from tumortrack.sense.cloud import CloudConfig
    from tumortrack.sense.region import RegionConfig

    scene = trained.scene
    near, far = scene.cloud.near_mm, scene.cloud.far_mm
    if scene.free_range > 0:
        nearest, farthest = scene.free_nearest_mm
        near, far = min(near, nearest - 5), max(far, farthest + far - near)
    if options.range_mm is not None:
        near, far = options.range_mm
    crop = CloudConfig(near_mm=near, far_mm=far, n_points=scene.cloud.n_points)
    box = None
    if options.box_mm is not None:
        ax, ay, az, bx, by, bz = options.box_mm
        box = ((ax, ay, az), (bx, by, bz))
    if options.whole:
        return RegionConfig(crop=crop, box_mm=box, plane=False, flying=False, pieces=False)
    if anatomy_ct is None:
        return RegionConfig(crop=crop, box_mm=box)
    vertices = anatomy_ct.organ.vertices_mm
    axes = np.linalg.svd(vertices - vertices.mean(0), full_matrices=False)[2]
    extents_mm = np.ptp(vertices @ axes.T, axis=0)
    size_mm = (0.7 * float(extents_mm.min()), 1.25 * float(extents_mm.max()))
    return RegionConfig(crop=crop, box_mm=box, organ_mm=size_mm)


def place_of_report(path: Path | None, command: str) -> Path:
    """Where the report goes; its folder is made."""
    if path is None:
        path = Path("runs") / f"{command}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.json"
    elif path.exists():
        raise InputError(f"{path} exists already. Choose another file for --report.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--report {path}: {error.strerror}.") from error
    return path


@contextmanager
def stopping(end: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a terminal that goes call ``end``, which lets the loop end after the
    frame it is at, and sinks flush; a second Ctrl-C interrupts."""

    def stop(number: int, _: object) -> None:
        end()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in _ENDS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Screen:
    """One line of state now and then, every change of quality, and the report."""

    def __init__(
        self, loop: Loop, report: Path, about: dict, arms: Operation | None = None
    ) -> None:
        self._loop, self._report, self._about, self._arms = loop, report, about, arms
        self._source_worker: SourceWorker | None = None
        self._sink_workers: list[SinkWorker] = []
        self._started = self._said = self._stored = time.monotonic()
        self._before = 0
        self._state, self._changed = "", 0.0
        self._unwritten = ""
        self._errors: dict[str, str] = {}
        self._memory_mb = {"start": round(_resident_mb(), 1)}

    def watch(self, source_worker: SourceWorker, sink_workers: list[SinkWorker]) -> None:
        """From here on there is something to show."""
        self._source_worker, self._sink_workers = source_worker, sink_workers

    def show(self, update: TrackingResult) -> None:
        """Called with every update."""
        state = update.reason or update.warning or "good"
        kind = "".join(c for c in state if not c.isdigit())
        if (cell := update.workcell) is not None:
            state += f"; arms: {cell.state}" + (f" ({cell.halted})" if cell.halted else "")
            kind += cell.state + "".join(c for c in cell.halted if not c.isdigit())
        now = time.monotonic()
        if kind != self._state and now - self._changed >= _SAY_S:
            self._state, self._changed = kind, now
            say(f"{update.quality}: {state}")
        for worker in self._sink_workers:
            if worker.failing and self._errors.get(worker.name) != worker.error:
                self._errors[worker.name] = worker.error
                say(f"sink {worker.name}: {worker.error}")
        source_worker = self._source_worker
        assert source_worker is not None
        every_s = _SAY_S if console.is_terminal else _SAY_PLAIN_S
        if now - self._said >= every_s:
            self._line(now, source_worker)
        if now - self._stored >= _STORE_S:
            self._store(source_worker)

    def end(self) -> None:
        """The last lines."""
        source_worker, loop = self._source_worker, self._loop
        if source_worker is None:
            return  # nothing was tracked: a sink could not be opened
        self._store(source_worker)
        counts, latency = loop.statistics.counts, loop.statistics.latency
        say(
            f"{counts['good'] + counts['poor']} estimates ({counts['poor']} poor), "
            f"{counts['none']} times none, {source_worker.dropped} frames dropped."
        )
        if len(latency):
            times = latency.summary()
            say(
                f"latency from {source_worker.latency_from} to published estimate: p50 "
                f"{times['p50']:.1f}, p95 {times['p95']:.1f}, p99.9 {times['p99.9']:.1f} ms."
            )
        for worker in self._sink_workers:
            if worker.dropped or worker.errors:
                last = f"; the last: {worker.error}" if worker.error else ""
                say(f"sink {worker.name}: {worker.dropped} missed, {worker.errors} errors{last}.")
        for name, errors in loop.statistics.errors.items():
            off = errors.summary()
            say(f"{name}: centre off by {off['p50']:.1f} mm (median; 95 %: {off['p95']:.1f} mm).")
        if not self._unwritten:
            say(f"written to {self._report}.")
        if lost := [worker for worker in self._sink_workers if worker.unclosed]:
            raise StorageError(f"sink {lost[0].name} did not end well: {lost[0].error}.")

    def _line(self, now: float, source_worker: SourceWorker) -> None:
        total = sum(self._loop.statistics.counts.values())
        rate = (total - self._before) / (now - self._said)
        self._before, self._said = total, now
        latency = self._loop.statistics.latency
        if not len(latency):
            return
        say(
            f"{now - self._started:6.0f} s  {rate:5.1f} updates/s  latency p50 "
            f"{latency.percentile(50):.1f} p95 {latency.percentile(95):.1f} ms  "
            f"dropped {source_worker.dropped}  {_resident_mb():.0f} MB"
        )

    def _store(self, source_worker: SourceWorker) -> None:
        from tumortrack.live.loop import summary

        self._stored = time.monotonic()
        now_mb = round(_resident_mb(), 1)
        self._memory_mb["now"] = now_mb
        if self._stored - self._started > _SETTLED_S:
            self._memory_mb.setdefault("settled", now_mb)
        content = {
            **self._about,
            "seconds": round(self._stored - self._started, 2),
            "memory_mb": self._memory_mb,
            **summary(self._loop, source_worker, self._sink_workers),
            **({} if self._arms is None else {"resection": self._arms.summary()}),
        }
        try:
            store.write_json(self._report, content)
            self._unwritten = ""
        except StorageError as error:  # a full disk must not end what is seen live
            if not self._unwritten:
                say(f"report: {error}")
            self._unwritten = str(error)


def _resident_mb() -> float:
    """Memory of this process now, or where the system does not say: its greatest so far."""
    import resource

    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 2**20
