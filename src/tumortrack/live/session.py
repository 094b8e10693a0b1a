"""A run of `track`: what it is given is checked and loaded, then source and sinks are opened, and a
report is kept while it lasts."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.patient import Patient
from tumortrack.io.depth_files import DepthCorrection, read_camera
from tumortrack.io.model_folder import patient_of, read_model_manifest
from tumortrack.live.cameras import Cameras, CameraSetup, camera_setup
from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.spec import SINKS, TOOLS
from tumortrack.live.tools import ToolConfig, Tools
from tumortrack.live.values import (
    Controller,
    SinkConfig,
    SinkContext,
    SourceConfig,
    TrackingResult,
)
from tumortrack.live.workers import SinkWorker, SourceWorker
from tumortrack.registration.base_model import Model
from tumortrack.tracking.follower import FollowerConfig
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.options import TrackOptions, model_folder
from tumortrack.tracking.tracker import Tracker

_SETTLED_S = 60.0  # by then all buffers have their size: memory that grows on is a leak
_FIRST_S = 5.0  # an open camera's first frame may take so long, however short a run is wanted
_STORE_S = 10.0  # between two writings of the report: kill -9 loses no more


class Session:
    """A run of `track`, before anything is opened. What is wrong is reported before a model is
    loaded.

    Args:
        model: a tracker, or the folder of a case or model.
        sinks: as written on the command line, their configurations, or sinks.
        controller: acts on what is tracked.
        setup: that the controller was checked with; None: as ``source`` and ``options`` say.

    Attributes:
        about: what the report says of the run beforehand; more may be added until it is opened.
        unwritten: why the report could not be written last; empty: it could.
        started: a frame came.

    Raises:
        InputError, ArtifactError: an option, a file or a combination of them cannot be used.
    """

    cameras: Cameras
    sinks: list[SinkWorker]

    def __init__(
        self,
        model: Tracker | Path,
        source: str | SourceConfig,
        sinks: Sequence[Any],
        options: TrackOptions,
        controller: Controller | None = None,
        setup: CameraSetup | None = None,
    ) -> None:
        self.setup = setup = _cameras(source, options) if setup is None else setup
        self._named, self._tools = named_sinks(sinks), named_tools(options.tool)
        digest = {}
        if isinstance(model, Tracker):
            if options.advise:
                raise InputError(
                    "--advise is of a case or model; a Tracker has its own (advise=...)."
                )
            self.tracker = model
            _check(setup, model.model.patient, "the model", options)
        else:
            folder = model_folder(model)
            _check(setup, patient_of(read_model_manifest(folder), folder), str(model), options)
            digest = {"model_sha256": store.sha256_of(folder / store.MANIFEST)}
            self.tracker = Tracker(load_model(folder, options.device), options.advise)
        tracker, loaded = self.tracker, self.tracker.model
        if setup.still and tracker.anatomy_ct is None:
            raise InputError("--views needs a model that knows a motion: give the case itself.")
        self._config = config = _loop_config(options, loaded)
        self.controller = controller
        self._context = SinkContext(
            loaded.parts,
            setup.published,
            tracker.anatomy_ct,
            controller=controller,
            patient=loaded.patient,
            cameras=setup.still,
            corrected=config.correction != DepthCorrection(),
            tools=tuple(self._tools),
        )
        self.loop = Loop(tracker, self._context, config)
        self.report, self.unwritten, self.started = options.report, "", False
        frames = setup.published
        placed = None if frames.moves else frames.published_from_camera.tolist()
        self.about = {
            "patient": to_builtins(loaded.patient),
            "model": loaded.provenance,
            "notes": [weakness.message for weakness in loaded.warnings],
            **digest,
            "source": next(iter(setup.sources)),
            "sinks": list(self._named),
            "config": to_builtins(config),
            "frame": {"frame_id": frames.frame_id, "published_from_camera": placed},
            "views": list(options.views),
            "moving": options.moving,
            "tool": list(options.tool),
            "published_from_cameras": [place.tolist() for place in setup.still],
        }

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Sinks and source at work; the report is written when all have flushed. A start that
        failed leaves nothing: the next one may use its names. Raises as ``open_sinks``."""
        self._began = self._stored = time.monotonic()
        self._memory_mb = {"start": round(resident_mb(), 1)}
        views = self.loop.views
        with (
            ExitStack() as ending,
            closing(Tools(self._tools, self._context, views.frames.notes)) as views.tools,
            open_sinks(self._named, self._context) as self.sinks,
            closing(self._open_cameras()) as self.cameras,
        ):
            ending.push(self._end)  # once all workers have flushed
            yield

    def _open_cameras(self) -> Cameras:
        workers = [SourceWorker(source.open) for source in self.setup.sources.values()]
        places = self.setup.still or (self.setup.published.published_from_camera,)
        return Cameras(workers, self.setup.poses or places, self._config.stale_s)

    def _end(self, error: type[BaseException] | None, *_: object) -> None:
        if error is None or self.started:
            self._store()
            return
        for sink in self._named.values():
            if isinstance(sink, SinkConfig) and (path := sink.made_path()) is not None:
                store.remove(path)
        if self.report is not None:
            store.remove(self.report)

    def run(self, on_result: Callable[[TrackingResult], None]) -> None:
        """Until the source ends, the time is up, the controller ends, or ``loop.stop``. Raises as
        ``Loop.run``."""

        def show(result: TrackingResult) -> None:
            self.started |= result.observation is not None
            on_result(result)
            if time.monotonic() - self._stored >= _STORE_S:
                self._store()

        self.loop.run(self.cameras, self.sinks, show)

    def summary(self) -> dict[str, Any]:
        return summary(self.loop, self.cameras, self.sinks)

    def _store(self) -> None:
        if self.report is None:
            return
        self._stored = time.monotonic()
        self._memory_mb["now"] = now_mb = round(resident_mb(), 1)
        if self._stored - self._began > _SETTLED_S:
            self._memory_mb.setdefault("settled", now_mb)
        frames = self.loop.views.frames
        content = {
            **self.about,
            "seconds": round(self._stored - self._began, 2),
            "memory_mb": self._memory_mb,
            "table_in_camera": frames.watch and frames.watch.table_in_camera,
            "frame_notes": frames.notes,
            "tools": self.loop.views.tools.summary(),
            "cut": self.loop.views.cuts.summary(),
            **self.summary(),
            **({} if self.controller is None else self.controller.summary()),
        }
        try:
            store.write_json(self.report, content)
            self.unwritten = ""
        except StorageError as error:  # a full disk must not end what is seen live
            self.unwritten = str(error)


def _cameras(source: str | SourceConfig, options: TrackOptions) -> CameraSetup:
    wrong = ""
    if options.box and (options.views or options.moving):
        wrong = "--box lies before one camera that stands still"
    elif options.intrinsics and options.views:
        wrong = "--intrinsics is of one camera; with --views each says its own"
    elif options.scan and not options.moving:
        wrong = "--scan is of one camera that moves (--moving); several cameras watch all the time"
    if wrong:
        raise InputError(f"{wrong}. Leave it out.")
    return camera_setup((source, *options.views), options.poses, options.moving, options.frame)


def _check(setup: CameraSetup, patient: Patient, what: str, options: TrackOptions) -> None:
    """InputError: the model (``what``) or a source is of another patient, depths were corrected
    already, or the report has no place."""
    patient.check_is(options.stated, what)
    corrects = read_camera(options.intrinsics)[1] != DepthCorrection()
    for text, source in setup.sources.items():
        source.patient().check_shown(patient, text)
        if corrects and getattr(source, "is_corrected", False):
            raise InputError(
                f"the depths of {text} were corrected as they were recorded. Leave "
                "--intrinsics out, or give it without depth_scale and depth_offset_mm; say what "
                "the calibration left by --depth-error MM."
            )
    if options.report is not None:
        check_report(options.report)


def _loop_config(options: TrackOptions, model: Model) -> LoopConfig:
    intrinsics, correction = read_camera(options.intrinsics)
    first_s = max(options.seconds, _FIRST_S, 2 * options.stale)
    return LoopConfig(
        region=options.region(model),
        follower=FollowerConfig(
            rescan_s=options.rescan, smoothing_s=options.smoothing, seed=options.seed
        ),
        intrinsics=intrinsics,
        correction=correction,
        depth_error=options.stated_error,
        stale_s=options.stale,
        frozen_s=options.frozen,
        scan=options.scan,
        give_up_s=min(options.give_up, first_s) if options.seconds else options.give_up,
        seconds=options.seconds,
    )


def check_report(path: Path) -> None:
    """A place for a report; its folder is made. InputError: it cannot be used."""
    store.check_place(path, "", None)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--report {path}: {error.strerror}.") from error


def named_sinks(sinks: Sequence[Any]) -> dict[str, Any]:
    """Sinks, or their configurations, by the names that reports give them. Raises InputError: one
    is not written as it must be, or is given twice."""
    named: dict[str, Any] = {}
    for number, sink in enumerate(sinks):
        name = sink if isinstance(sink, str) else f"sink {number}"
        if name in named:
            raise InputError(f"sink {name!r} is given twice.")
        named[name] = SINKS.parse(sink) if isinstance(sink, str) else sink
    return named


def named_tools(tools: Sequence[str]) -> dict[str, ToolConfig]:
    """Configurations of tools (``NAME=KIND:...``) by name. Raises as ``named_sinks``."""
    named: dict[str, ToolConfig] = {}
    for tool in tools:
        name, _, text = tool.partition("=")
        if not text or not name.isidentifier() or name in named:
            raise InputError(
                f"--tool {tool}: write NAME=KIND:..., as pointer=openigtlink:HOST?name=Stylus. A "
                "name is of letters and digits, and given once."
            )
        named[name] = TOOLS.parse(text)
    return named


@contextmanager
def open_sinks(sinks: Mapping[str, Any], context: SinkContext) -> Iterator[list[SinkWorker]]:
    """``named_sinks``, each at work in a thread of its own. Raises InputError, StorageError: one
    cannot work, or not write."""

    def waiting(sink: Any) -> int:
        return sink.queue_size if isinstance(sink, SinkConfig) else 1

    workers: list[SinkWorker] = []
    with ExitStack() as stack:
        # Those that make a folder last: if another cannot open, none is left behind.
        for name, sink in sorted(sinks.items(), key=lambda pair: waiting(pair[1])):
            try:
                opened = sink.open(context) if isinstance(sink, SinkConfig) else sink
            except OSError as error:  # a sink of another package that does not translate it
                raise StorageError(
                    f"sink {name!r} cannot be opened: {error.strerror}: {error.filename}."
                ) from error
            workers.append(SinkWorker(name, opened, waiting(sink)))
            stack.callback(workers[-1].close)
        yield workers


def check_closed(sinks: list[SinkWorker]) -> None:
    """Raises StorageError where a sink failed at its end."""
    if lost := [sink for sink in sinks if sink.unclosed]:
        raise StorageError(f"sink {lost[0].name} did not end well: {lost[0].error}.")


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
