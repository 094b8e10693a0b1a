"""An hour of tracking with injected faults.

    make soak ARGS="MODEL CASE [--minutes 60] [--seed 0] [--table FILE]"

A simulated case in motion is tracked by `track`'s own loop into four sinks: viewer, recorder, ROS 2
and OpenIGTLink (with a client that reads). At random moments faults are injected, of the kinds in
soak_faults.py. It fails if an estimate that was called good was stale or wrong, a
fault was not named in its words in time, no good estimate came after it, memory grew by
over 20 MB after the first minute, an internal error was met, or a tape that a full disk cut off
cannot be read to its last second.
"""

from __future__ import annotations

import os
import platform
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from soak_faults import (
    FAULTS,
    SINK_FAULTS,
    Fault,
    FaultyCamera,
    FaultySink,
    Schedule,
    Staged,
    Tapes,
)
from tyro.conf import Positional

from tumortrack import api
from tumortrack.cli.console import keep_loaded, say
from tumortrack.core.errors import InputError
from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.meter import Histogram
from tumortrack.live.session import resident_mb
from tumortrack.live.spec import SINKS, SOURCES
from tumortrack.live.values import (
    Controls,
    PublishedFrame,
    SinkContext,
    SourceEnded,
    TrackingResult,
)
from tumortrack.live.workers import SinkWorker, SourceWorker
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.physics.kidneys import random_anatomy
from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig
from tumortrack_devices.sources.virtual import VirtualSourceConfig

_KEPT = 20  # wrong estimates that are listed
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


def main(config: SoakConfig) -> None:
    os.environ.setdefault("ROS_DOMAIN_ID", "47")
    with tempfile.TemporaryDirectory(prefix="tumortrack-soak-") as folder:
        text, problems = soak(config, Path(folder))
    if config.table:
        config.table.write_text(text)
    print(text, *(f"FAILED: {problem}" for problem in problems), sep="\n")
    sys.exit(bool(problems))


@dataclass(eq=False)
class Answer:
    """The reaction to one fault: after how many seconds, in which words, and how long after its end
    there was a good estimate again. NaN: not (yet)."""

    fault: Fault
    named_s: float = np.nan
    message: str = ""
    back_s: float = np.nan
    good: int = 0  # estimates called good while it was on


@dataclass(eq=False)
class Judge:
    """Sees every result when the sinks do.

    A good estimate is ``wrong`` where the middle of a part lies over ``wrong_mm`` from the truth at
    the frame's stamp, and ``stale`` where its image is older than ``stale_s``.
    """

    schedule: Schedule
    workers: list[SinkWorker]
    stale_s: float
    wrong_mm: float
    within_s: float  # a fault must be named
    answers: dict[int, Answer] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    error_mm: Histogram = field(default_factory=Histogram)
    latency: Histogram = field(default_factory=Histogram)  # of all estimates, ms
    memory_mb: list[tuple[float, float]] = field(default_factory=list)  # (s, MB)
    _begin_s: float = np.nan

    def see(self, result: TrackingResult) -> None:
        now_s = time.monotonic()
        if result.observation is not None and np.isnan(self._begin_s):
            self._begin_s = now_s
        self.counts[result.quality] += 1
        fault = self.schedule.now()
        if result.quality == "good":
            self._check(result)
        if result.estimate is not None and result.latency_ms is not None:
            self.latency.add(result.latency_ms)
        for begun in self.schedule.faults:
            if not np.isnan(begun.begun_s):
                self._answer(begun, begun is fault, result, now_s)
        if not np.isnan(self._begin_s) and now_s - self._begin_s >= 10 * len(self.memory_mb):
            self.memory_mb.append((now_s - self._begin_s, resident_mb()))
            if len(self.memory_mb) % 6 == 1:
                counts = ", ".join(f"{count:,} {what}" for what, count in self.counts.items())
                say(f"{self._since_s() / 60:.0f} minutes: {counts}")

    def _check(self, result: TrackingResult) -> None:
        frame, latency_ms = result.observation, result.latency_ms
        if not isinstance(frame, Staged) or frame.truth is None or latency_ms is None:
            raise TypeError("a good estimate without a frame of the camera's")
        age_s = latency_ms / 1000 + (frame.stamp_ns - frame.exposed_ns) * 1e-9
        off_mm = max(
            float(np.linalg.norm(center - true.box_mm.mean(0)))
            if (center := result.center_mm(name)) is not None
            else np.inf
            for name, true in zip(frame.truth.names, frame.truth.parts, strict=True)
        )
        self.error_mm.add(off_mm)
        for kind, is_so in (("stale", age_s > self.stale_s), ("wrong", off_mm > self.wrong_mm)):
            if is_so:
                self.counts[kind] += 1
                what = f"{kind} at {self._since_s():.1f} s: {off_mm:.1f} mm off, {age_s:.2f} s old"
                self.wrong.append(f"{what}, frame {frame.fault or 'as it was'}")
                del self.wrong[_KEPT:]

    def _answer(self, fault: Fault, is_on: bool, result: TrackingResult, now_s: float) -> None:
        answer = self.answers.setdefault(id(fault), Answer(fault))
        if is_on:
            answer.good += result.quality == "good"
        elif np.isnan(answer.back_s) and result.quality == "good":
            answer.back_s = now_s - self.schedule.ended_s(fault)
        if np.isnan(answer.named_s):
            texts = [result.reason or result.warning]
            if fault.kind in SINK_FAULTS:
                texts = [worker.trouble for worker in self.workers if worker.name == fault.victim]
            if words := next((text for text in texts if re.search(FAULTS[fault.kind], text)), ""):
                answer.named_s, answer.message = now_s - fault.begun_s, words

    def _since_s(self) -> float:
        return time.monotonic() - self._begin_s

    def problems(self) -> list[str]:
        """Violations; none if all is well."""
        problems = list(self.wrong)
        for answer in self.answers.values():
            kind, at_s = answer.fault.kind, answer.fault.planned_s
            if np.isnan(answer.named_s):
                problems.append(f"{kind} at {at_s:.0f} s was never named")
            elif answer.named_s > self.within_s:
                problems.append(f"{kind} at {at_s:.0f} s was named after {answer.named_s:.2f} s")
            if np.isnan(answer.back_s):
                problems.append(f"{kind} at {at_s:.0f} s: no good estimate came after it")
        problems += [f"{fault.kind}: never begun" for fault in self.schedule.faults
                  if np.isnan(fault.begun_s)]  # fmt: skip
        if not self.counts["good"]:
            problems.append("there was no good estimate")
        return problems


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
    last_s = seconds - config.within_s  # the last fault, too, has so long to be answered
    schedule = Schedule(config.seed, last_s, config.stale_s, sinks, kinds)
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
    before_mb, after_mb = grown_mb(judge)
    if after_mb - before_mb > _GROWN_MB:
        problems.append(f"memory grew from {before_mb:.0f} to {after_mb:.0f} MB")
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


def document(judge: Judge, report: dict[str, Any], about: str) -> str:
    """The run's figures, and a row per kind of fault, in Markdown."""
    rows = {f"results: {name}": f"{count:,}" for name, count in judge.counts.items()}
    for name, of in {"latency, ms": judge.latency, "worst part, mm off": judge.error_mm}.items():
        found = of.summary()
        rows[name] = ", ".join(f"{key} {found.get(key)}" for key in ("p50", "p99", "p99.9", "max"))
    rows["memory, MB, after a minute and at the end"] = "{:.0f}, {:.0f}".format(*grown_mb(judge))
    for name, sink in report["sinks"].items():
        counts = (f"{sink[key]:,} {key}" for key in ("delivered", "dropped", "errors"))
        rows[f"sink {name}"] = ", ".join(counts)
    faults = []
    for kind in FAULTS:
        answers = [one for one in judge.answers.values() if one.fault.kind == kind]
        named = [one.named_s for one in answers] or [np.nan]
        faults.append({
            "fault": kind, "times": len(answers),
            "named after (median; longest), s": f"{np.median(named):.2f}; {max(named):.2f}",
            "in these words": answers[0].message[:90] if answers else "",
            "good again after (longest), s": max((a.back_s for a in answers), default=np.nan),
        })  # fmt: skip
    figures = pd.DataFrame(rows.items(), columns=["", "found"])
    return "\n\n".join([about, table_of(figures), table_of(pd.DataFrame(faults))]) + "\n"


def grown_mb(judge: Judge) -> tuple[float, float]:
    """Memory after a minute (or at the first view), and at the end."""
    times, megabytes = np.array(judge.memory_mb).T
    return float(megabytes[int(np.abs(times - 60.0).argmin())]), float(megabytes[-1])


if __name__ == "__main__":
    scripting.run(main, SoakConfig)
