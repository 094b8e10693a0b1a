"""`track`: source -> loop -> sinks, and what the user sees of it."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from tumortrack.cli.console import Device, console, keep_loaded, model_folder, say
from tumortrack.core import store
from tumortrack.core.errors import InputError, StorageError
from tumortrack.tracking.options import RegionOptions

if TYPE_CHECKING:
    from tumortrack.live.cameras import Cameras, CameraSetup
    from tumortrack.live.loop import Loop, LoopConfig
    from tumortrack.live.values import ArmsController, TrackingResult
    from tumortrack.live.workers import SinkWorker
    from tumortrack.models.model import Model

_SAY_S, _SAY_PLAIN_S = 1.0, 5.0  # between two lines of state: on a terminal, in a file
STOPPED = "stopped by the user"  # why arms stand
_ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SETTLED_S = 60.0  # by then all buffers have their size: memory that grows on is a leak
_OPENING_S = 5.0  # the first frame may take so long, however short a run is wanted
_STORE_S = 10.0  # between two writings of the report: kill -9 loses no more


@dataclass(frozen=True, eq=False)
class Arms:
    """Arms that act on what is tracked. ``setup``: what they were checked with; ``about`` them, for
    the report; ``tip_mm``: as of ``SinkContext``; ``ur``: there are sinks of real arms, connected
    or not."""

    operation: ArmsController
    setup: CameraSetup
    about: dict[str, Any]
    tip_mm: Any
    ur: bool


@dataclass(frozen=True, kw_only=True)
class FollowingOptions(RegionOptions):
    """Options of commands that follow an organ.

    Attributes:
        intrinsics: JSON with the camera's width, height, fx, fy, cx, cy in pixels, instead of what
            the source says, and perhaps a correction of depths, as `calibrate camera` writes it.
        device: auto takes CUDA if there is a GPU.
    """

    intrinsics: Path | None = None
    device: Device = "auto"


@dataclass(frozen=True, kw_only=True)
class Track(FollowingOptions):
    """Follow organ and tumors live, from a camera to viewers, recordings and robots.

    Sources and sinks are written kind:target?option=value&option=value. Sources: virtual:CASE,
    recording:PATH, realsense[:SERIAL|FILE], ros2:TOPIC. Sinks: viewer[:PORT],
    recording:FOLDER, ros2[:TOPIC], moveit, openigtlink[:PORT], and for `resect` ur:HOST.
    Installed packages can add sources and sinks. A wrong one is answered with what is allowed.
    docs/live.md has examples.

    Attributes:
        model: a case, or a folder that `train` wrote.
        source: where frames come from.
        sinks: where estimates go; any number.
        frame: JSON file that says where the camera is; results are then in the robot's frame.
        views: further cameras that stand still; what all see at about one moment is laid together.
        poses: JSON that says where all cameras stand, as for `locate`, SOURCE's first; results are
            in its frame, unless --frame gives another.
        moving: SOURCE's camera moves; where it is in each frame comes from file:POSES.csv, tf
            (ros2:FIXED_FRAME) or a robot (ur:HOST). Where that gives poses of a
            tool, --frame has tool_from_camera.
        scan: with --moving: begin with three looks at the organ at rest, from 30 degrees apart,
            within 5 s; what they show together is what the following starts from.
        smoothing: time constant in s of a mean over past estimates; the lag is in the report.
        rescan: every so many s, search for the organ as in a first frame.
        stale: frames older than so many s are refused; a pause is reported after four fifths of it.
        frozen: an image that repeats bit for bit for so many s is refused; 0: it may repeat, as
            of a simulated camera without noise.
        give_up: end after so many s without a frame.
        seconds: end so many s after the first frame, and without one after as many (but 5 at
            least: cameras take time to open); 0: never.
        report: file for latencies, counts and reasons (default: runs/track-TIME.json).
        seed: of the random points.
    """

    model: Positional[Path]
    source: Positional[str]
    sinks: Positional[tuple[str, ...]] = ()
    frame: Path | None = None
    views: tuple[str, ...] = ()
    poses: Path | None = None
    moving: str = ""
    scan: bool = False
    smoothing: float = 0.0
    rescan: float = 1.0
    stale: float = 0.5
    frozen: float = 0.25
    give_up: float = 60.0
    seconds: float = 0.0
    report: Path | None = None
    seed: int = 0

    def run(self, arms: Arms | None = None) -> None:
        """Until the source ends, the time is up, the arms have ended, or Ctrl-C."""
        from tumortrack import api
        from tumortrack.core.config import to_builtins
        from tumortrack.live.cameras import Cameras
        from tumortrack.live.sinks.recording import RecordingSinkConfig
        from tumortrack.live.values import SinkContext
        from tumortrack.live.workers import SourceWorker
        from tumortrack.models.folder import patient_of, read_model_manifest
        from tumortrack.sense.files import DepthCorrection, read_camera

        setup = self._cameras() if arms is None else arms.setup  # what executes was checked
        frames, named = setup.published, api.named_sinks(self.sinks)
        folder = model_folder(self.model)
        patient = patient_of(read_model_manifest(folder), folder)
        patient.check_is(self.stated, str(self.model))
        for text, source_config in setup.sources.items():
            source_config.patient().check_shown(patient, text)
            corrects = read_camera(self.intrinsics)[1] != DepthCorrection()
            if corrects and getattr(source_config, "is_corrected", False):
                raise InputError(
                    f"the depths of {text} were corrected as they were recorded. Leave "
                    "--intrinsics out, or give it without depth_scale and depth_offset_mm."
                )
        report = report_path(self.report, "track")

        from tumortrack.live.loop import Loop
        from tumortrack.tracking.tracker import Tracker

        if arms is None:
            keep_loaded()
        model = api.load_model(folder, self.device)
        tracker = Tracker(model)
        if setup.still and tracker.anatomy_ct is None:
            raise InputError("--views needs a model that knows a motion: give the case itself.")
        config = self._loop_config(model)
        context = SinkContext(
            model.parts,
            frames,
            tracker.anatomy_ct,
            arms=arms is not None,
            patient=model.patient,
            cameras=setup.still,
            tip_mm=None if arms is None else arms.tip_mm,
            corrected=config.correction != DepthCorrection(),
        )
        loop = Loop(tracker, context, config, None if arms is None else arms.operation)

        def stop() -> None:
            if arms is not None:
                arms.operation.abort(STOPPED)
            loop.stop()

        say("warming up ...")
        loop.warm()
        way = frames.published_from_camera
        placed = None if frames.moves else way.tolist()
        about = {
            "patient": to_builtins(model.patient),
            "model": model.provenance,
            "model_sha256": store.sha256_of(folder / store.MANIFEST),
            "source": self.source,
            "sinks": list(self.sinks),
            "config": to_builtins(config),
            "frame": {"frame_id": frames.frame_id, "published_from_camera": placed},
            "views": list(self.views),
            "moving": self.moving,
            "published_from_cameras": [place.tolist() for place in setup.still],
            **({} if arms is None else arms.about),
        }

        def begin() -> Cameras:
            workers = [SourceWorker(source.open) for source in setup.sources.values()]
            return Cameras(workers, setup.poses or setup.still or (way,), config.stale_s)

        with (
            stopping(stop),
            ExitStack() as ending,
            api.open_sinks(named, context) as sinks,
            closing(begin()) as cameras,
        ):
            say_opened(sinks)
            new = [one.path for one in named.values() if isinstance(one, RecordingSinkConfig)]
            screen = _Screen(loop, cameras, sinks, report, about, arms, new)
            ending.push(screen.end)  # once all workers have flushed
            say(f"{model.patient}: tracking {', '.join(setup.sources)} in frame "
                f"{frames.frame_id!r}; Ctrl-C ends it.")  # fmt: skip
            loop.run(cameras, sinks, screen.show)

    def _cameras(self) -> CameraSetup:
        from tumortrack.live.cameras import camera_setup

        wrong = ""
        if self.box and (self.views or self.moving):
            wrong = "--box lies before one camera that stands still"
        elif self.intrinsics and self.views:
            wrong = "--intrinsics is of one camera; with --views each says its own"
        elif self.scan and not self.moving:
            wrong = "--scan is of one camera that moves (--moving); several look all the time"
        if wrong:
            raise InputError(f"{wrong}. Leave it out.")
        return camera_setup((self.source, *self.views), self.poses, self.moving, self.frame)

    def _loop_config(self, model: Model) -> LoopConfig:
        from tumortrack.live.loop import LoopConfig
        from tumortrack.sense.files import read_camera
        from tumortrack.tracking.tracker import FollowerConfig

        follower = FollowerConfig(rescan_s=self.rescan, smoothing_s=self.smoothing, seed=self.seed)
        intrinsics, correction = read_camera(self.intrinsics)
        first_s = max(self.seconds, _OPENING_S, 2 * self.stale)
        return LoopConfig(
            region=self.region(model),
            follower=follower,
            intrinsics=intrinsics,
            correction=correction,
            stale_s=self.stale,
            frozen_s=self.frozen,
            scan=self.scan,
            give_up_s=min(self.give_up, first_s) if self.seconds else self.give_up,
            seconds=self.seconds,
        )


def say_opened(sinks: list[SinkWorker]) -> None:
    """Where each sink is to be found, and who can reach it."""
    for sink in sinks:
        for note in sink.notes:
            say(f"sink {sink.name}: {note}")


def stage_words(state: str, ur: bool) -> str:
    """A stage for the screen. ``ur``: there are sinks of real arms, and nobody knows that those are
    home."""
    return state.replace("home", "the way back", 1) if ur else state


def say_failures(sinks: list[SinkWorker], known: dict[str, str]) -> None:
    """What troubles each sink, unless it is ``known``, where it is then kept."""
    for sink in sinks:
        if (trouble := sink.trouble) and known.get(sink.name) != trouble:
            known[sink.name] = trouble
            say(f"sink {sink.name}: {trouble}")


def check_closed(sinks: list[SinkWorker]) -> None:
    """Raises StorageError where a sink failed at its end."""
    if lost := [sink for sink in sinks if sink.unclosed]:
        raise StorageError(f"sink {lost[0].name} did not end well: {lost[0].error}.")


def report_path(path: Path | None, command: str) -> Path:
    """Where the report goes; its folder is made."""
    if path is None:
        path = Path("runs") / f"{command}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.json"
    else:
        store.check_place(path, "", None)
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


@dataclass(eq=False)
class _Screen:
    """One line of state now and then, every change of quality, and the report."""

    loop: Loop
    source: Cameras
    sinks: list[SinkWorker]
    report: Path
    about: dict[str, Any]
    arms: Arms | None
    recordings: list[Path]  # folders that this run made

    def __post_init__(self) -> None:
        self._started = self._shown = self._stored = time.monotonic()
        self._before, self._state, self._changed, self._unwritten = 0, "", 0.0, ""
        self._errors: dict[str, str] = {}
        self._notes = 0  # of those about the camera's frame, that were said
        self._seen = False  # a frame came
        self._memory_mb = {"start": round(_resident_mb(), 1)}

    def show(self, result: TrackingResult) -> None:
        """Called with every result."""
        self._seen |= result.observation is not None
        state = result.describe()
        kind = re.sub(r"\d", "", state)  # numbers change with every frame
        if (cell := result.workcell) is not None:
            stage = stage_words(cell.state, self.arms is not None and self.arms.ur)
            state += f"; arms: {stage}" + (f" ({cell.halted})" if cell.halted else "")
            state += "" if cell.left_mm is None else f"; {cell.left_mm:.1f} mm of the margin left"
            kind += cell.state + re.sub(r"\d", "", cell.halted)
        now = time.monotonic()
        if kind != self._state and now - self._changed >= _SAY_S:
            self._state, self._changed = kind, now
            say(state)
        for note in self.loop.views.frames.notes[self._notes :]:
            say(f"note: {note}.")
        self._notes = len(self.loop.views.frames.notes)
        say_failures(self.sinks, self._errors)
        if now - self._shown >= (_SAY_S if console.is_terminal else _SAY_PLAIN_S):
            self._line(now)
        if now - self._stored >= _STORE_S:
            self._store()

    def end(self, error: type[BaseException] | None, *_: object) -> None:
        """The last lines. A start that failed leaves nothing: the next one may use its names."""
        if error is not None and not self._seen:
            for path in (*self.recordings, self.report):
                store.remove(path)
            return
        self._store()
        source, statistics = self.source, self.loop.statistics
        counts, latency = statistics.counts, statistics.latency
        say(
            f"{counts['good'] + counts['poor']} estimates ({counts['poor']} poor), "
            f"{counts['none']} times none, {source.dropped} frames dropped."
        )
        if len(latency):
            times = latency.summary()
            say(
                f"latency from {source.latency_from} to published estimate: p50 "
                f"{times['p50']:.1f}, p95 {times['p95']:.1f}, p99.9 {times['p99.9']:.1f} ms."
            )
        for sink in self.sinks:
            if sink.dropped or sink.errors:
                last = f"; the last: {sink.error}" if sink.error else ""
                say(f"sink {sink.name}: {sink.dropped} missed, {sink.errors} errors{last}.")
        for name, errors in statistics.errors.items():
            off = errors.summary()
            say(f"{name}: centre off by {off['p50']:.1f} mm (median; 95 %: {off['p95']:.1f} mm).")
        if not self._unwritten:
            say(f"written to {self.report}.")
        check_closed(self.sinks)

    def _line(self, now: float) -> None:
        statistics = self.loop.statistics
        total = sum(statistics.counts.values())
        rate = (total - self._before) / (now - self._shown)
        self._before, self._shown = total, now
        if len(statistics.latency):
            p50, p95 = (statistics.latency.percentile(percent) for percent in (50, 95))
            say(
                f"{now - self._started:6.0f} s  {rate:5.1f} updates/s  latency p50 {p50:.1f} p95 "
                f"{p95:.1f} ms  dropped {self.source.dropped}  {_resident_mb():.0f} MB"
            )

    def _store(self) -> None:
        from tumortrack.live.loop import summary

        self._stored = time.monotonic()
        self._memory_mb["now"] = now_mb = round(_resident_mb(), 1)
        if self._stored - self._started > _SETTLED_S:
            self._memory_mb.setdefault("settled", now_mb)
        frames, watch = self.loop.views.frames, self.loop.views.frames.watch
        content = {
            **self.about,
            "seconds": round(self._stored - self._started, 2),
            "memory_mb": self._memory_mb,
            "table_in_camera": watch and watch.table_in_camera,
            "frame_notes": frames.notes,
            **summary(self.loop, self.source, self.sinks),
            **({} if self.arms is None else {"resection": self.arms.operation.summary()}),
        }
        try:
            store.write_json(self.report, content)
            self._unwritten = ""
        except StorageError as error:  # a full disk must not end what is seen live
            if not self._unwritten:
                say(f"report: {error}")
            self._unwritten = str(error)


def _resident_mb() -> float:
    """Memory of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
