"""One run: the loop of `track`, a faulty camera, faulty sinks, and the judge."""

from __future__ import annotations

import platform
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from tumortrack import api
from tumortrack.cli.console import keep_loaded
from tumortrack.core.errors import InputError
from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.spec import SINKS, SOURCES
from tumortrack.live.values import Controls, PublishedFrame, SinkContext, SourceEnded
from tumortrack.live.workers import SinkWorker, SourceWorker
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_lab.soak.faults import FAULTS, Fault, FaultyCamera, FaultySink, Schedule, Tapes
from tumortrack_lab.soak.judge import Judge
from tumortrack_lab.soak.table import document, memory_marks
from tumortrack_lab.world.kidneys import random_anatomy

_GROWN_MB = 20.0
_OTHERS = range(11, 19)  # seeds of other kidneys
_LOST_S = 1.0  # of a tape before the disk was full
_READER = """
import socket, sys
peer = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
while peer.recv(1 << 20):
    pass
"""


@dataclass(frozen=True, kw_only=True)
class SoakConfig:
    """Track with injected faults.

    Attributes:
        model: of the case, or the case again.
        case: folder that `prepare` wrote.
        stale_s: older frames are refused, s; faults last 3 to 6 times as long.
        wrong_mm: a part so far off is wrong.
        within_s: how soon a fault must be named.
        kinds: of faults; empty: all.
        table: file for the Markdown tables, which are also printed.
    """

    model: Positional[Path] = Path("runs/demo/case")
    case: Positional[Path] = Path("runs/demo/case")
    minutes: float = 60.0
    fps: float = 30.0
    seed: int = 0
    stale_s: float = 0.5
    wrong_mm: float = 5.0
    within_s: float = 0.5
    kinds: tuple[str, ...] = ()
    table: Path | None = None


def soak(config: SoakConfig, folder: Path) -> tuple[str, list[str]]:
    """The tables (Markdown), and problems; tapes go to the folder."""
    seconds = 60 * config.minutes
    model = api.load_model(config.model)
    tracker = Tracker(model)
    context = SinkContext(model.parts, PublishedFrame(), tracker.anatomy_ct, Controls())
    region = region_for(model)
    looped = LoopConfig(region=region, stale_s=config.stale_s, seconds=seconds)
    loop = Loop(tracker, context, looped)
    loop.warm()
    sinks, kinds = ["viewer", "ros2", "openigtlink"], [*(config.kinds or FAULTS)]
    schedule = Schedule(config.seed, seconds, config.stale_s, sinks, kinds)
    player = VirtualSourceConfig(case=config.case, seed=config.seed).player()
    others = [ScenePlayer(*random_anatomy(seed), ScenePlayerConfig(), seed) for seed in _OTHERS]
    camera = FaultyCamera(player, others, config.fps, schedule)
    keep_loaded()
    with (
        _sinks(context, schedule, folder) as (workers, tapes),
        closing(SourceWorker(camera.open)) as reader,
    ):
        # A frozen image with new stamps is taken for new for so long.
        stale_s = config.stale_s + looped.frozen_s
        judge = Judge(schedule, workers, stale_s, config.wrong_mm, config.within_s)
        with suppress(KeyboardInterrupt):  # the results until then are judged
            loop.run(reader, workers, judge.see)
        report = summary(loop, reader, workers)
    problems = judge.problems()
    problems += [text for cut_off in tapes.refused if (text := _unread(*cut_off))]
    problems += [f"internal error: {defect}" for defect in report["defects"]]
    marks = memory_marks(judge)
    if marks["end"] - marks["1 min"] > _GROWN_MB:
        problems.append(f"memory grew from {marks['1 min']:.0f} to {marks['end']:.0f} MB")
    about = (
        f"{config.minutes:g} minutes at {config.fps:g} Hz, {len(judge.answers)} faults, seed "
        f"{config.seed}; {platform.processor() or platform.machine()}, Python "
        f"{platform.python_version()}. {len(tapes.refused)} tapes cut off by a full disk were "
        "read to their last second."
    )
    return document(judge, report, about), problems


@contextmanager
def _sinks(
    context: SinkContext, schedule: Schedule, folder: Path
) -> Iterator[tuple[list[SinkWorker], Tapes]]:
    """Viewer, ROS 2 and OpenIGTLink, whose faults are scheduled, and the recorder."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    kinds = {"viewer": "viewer:0", "ros2": "ros2", "openigtlink": f"openigtlink:{port}"}
    workers: list[SinkWorker] = []
    with ExitStack() as ending:
        for name, text in kinds.items():
            sink = FaultySink(name, SINKS.parse(text).open(context), schedule)
            workers.append(SinkWorker(name, sink, 1))
            ending.callback(workers[-1].close)
        tapes = Tapes(folder, context, schedule)
        workers.append(SinkWorker("recording", tapes, 30))
        ending.callback(workers[-1].close)
        client = subprocess.Popen([sys.executable, "-c", _READER, str(port)])
        ending.callback(client.wait)
        ending.callback(client.terminate)
        yield workers, tapes


def _unread(tape: Path, fault: Fault, ran_s: float) -> str:
    """The problem of a tape that a full disk cut off after ``ran_s``; empty: it lasts until
    then, but for the longest pause between two of its frames."""
    began_ns = time.time_ns() - int((time.monotonic() - fault.begun_s) * 1e9)
    stamps_ns = [began_ns - int(ran_s * 1e9)]
    try:
        with closing(SOURCES.parse(f"recording:{tape}?rate=0").open()) as source:
            while (observation := source.read(1.0)) is not None:
                stamps_ns.append(observation.stamp_ns)
    except (SourceEnded, InputError):  # the end, or nothing was written yet
        pass
    *pauses_s, lost_s = np.diff([*stamps_ns, began_ns]) * 1e-9
    whole = lost_s < _LOST_S + max(pauses_s[1:], default=0.0)
    return "" if whole else f"{tape.name} lacks {lost_s:.1f} s before the disk was full"
