"""`track`: source -> loop -> sinks, and its lines on the screen."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import console, keep_loaded, model_folder, options_of, say, say_notes
from tumortrack.tracking.options import TrackOptions

if TYPE_CHECKING:
    from tumortrack.live.session import Session
    from tumortrack.live.values import TrackingResult
    from tumortrack.live.workers import SinkWorker

_SAY_S, _SAY_PLAIN_S = 1.0, 5.0  # between two lines of state: on a terminal, in a file
_END_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, kw_only=True)
class Track(TrackOptions):
    """Follow organ and tumors live, from a camera to viewers, recordings and robots.

    Sources and sinks are written kind:target?option=value&option=value. Sources: virtual:CASE,
    recording:PATH, realsense[:SERIAL|FILE], ros2:TOPIC. Sinks: viewer[:PORT],
    recording:FOLDER, ros2[:TOPIC], moveit, openigtlink[:PORT], and for `resect` ur:HOST. All but
    ur come with tumortrack-devices; other installed packages can add more. A wrong one is answered
    with what is allowed. docs/live.md has examples.

    Attributes:
        model: a case, or a folder that `train` wrote.
        source: where frames come from.
        sinks: where estimates go; any number.
    """

    model: Positional[Path]
    source: Positional[str]
    sinks: Positional[tuple[str, ...]] = ()
    tool: UseAppendAction[tuple[str, ...]] = ()

    def run(self) -> None:
        from tumortrack import api
        from tumortrack.live import session  # noqa: F401 - to be loaded by then

        keep_loaded()
        model_folder(self.model)
        report = self.report or default_report("track")
        asked = options_of(replace(self, report=report), TrackOptions)
        follow(api.session(self.model, self.source, self.sinks, **asked))


def follow(run: Session) -> None:
    """Until the source ends, the time is up, the controller has ended, or Ctrl-C."""

    def stop() -> None:
        if run.controller is not None:
            run.controller.stop("interrupted")
        run.loop.stop()

    say("warming up ...")
    run.loop.warm()
    say_notes(weakness.message for weakness in run.tracker.model.warnings)
    screen = _Screen(run)
    with stopping(stop), ExitStack() as ending:
        ending.push(screen.end)
        with run.opened():
            say_opened(run.sinks)
            say(f"{run.tracker.model.patient}: tracking {', '.join(run.setup.sources)} in "
                f"frame {run.setup.published.frame_id!r}; Ctrl-C ends it.")  # fmt: skip
            run.run(screen.show)


def say_opened(sinks: list[SinkWorker]) -> None:
    """Say where each sink can be reached, and by whom."""
    for sink in sinks:
        for note in sink.notes:
            say(f"sink {sink.name}: {note}")


def say_failures(sinks: list[SinkWorker], known: dict[str, str]) -> None:
    """Say what is wrong with each sink, unless ``known`` has it, and add it there."""
    for sink in sinks:
        if (trouble := sink.trouble) and known.get(sink.name) != trouble:
            known[sink.name] = trouble
            say(f"sink {sink.name}: {trouble}")


def default_report(command: str) -> Path:
    """The report's file where no option gives one."""
    return Path("runs") / f"{command}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.json"


@contextmanager
def stopping(end: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C, SIGTERM and a closed terminal call ``end``, which lets the loop finish its frame and
    sinks flush; a second Ctrl-C interrupts."""

    def stop(number: int, _: object) -> None:
        end()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in _END_SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Screen:
    """Prints a line of state now and then, every change of quality, and a summary."""

    def __init__(self, run: Session) -> None:
        self._run = run
        self._began = self._shown = time.monotonic()
        self._before, self._changed, self._unwritten = 0, 0.0, ""
        self._state: list[object] = []  # as last printed, without its numbers
        self._errors: dict[str, str] = {}
        self._notes = 0  # how many notes on the camera's frame were printed

    def show(self, result: TrackingResult) -> None:
        state = result.describe()
        finding, used = result.finding, result.estimate and result.estimate.report.cameras
        kind: list[object] = [result.quality, finding.same_as if finding else result.reason, used]
        if (control := result.control) is not None:
            state += f"; {control.line}"
            kind.append(control.kind)
        now = time.monotonic()
        if kind != self._state and now - self._changed >= _SAY_S:
            self._state, self._changed = kind, now
            say(state)
        notes = self._run.loop.views.frames.notes
        for note in notes[self._notes :]:
            say(f"note: {note}.")
        self._notes = len(notes)
        say_failures(self._run.sinks, self._errors)
        if self._run.unwritten and not self._unwritten:
            say(f"report: {self._run.unwritten}")
        self._unwritten = self._run.unwritten
        if now - self._shown >= (_SAY_S if console.is_terminal else _SAY_PLAIN_S):
            self._line(now)

    def end(self, error: type[BaseException] | None, *_: object) -> None:
        """Print the summary, once all is written; nothing if the start failed."""
        from tumortrack.live.session import check_closed

        if error is not None and not self._run.started:
            return
        source, statistics = self._run.cameras, self._run.loop.statistics
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
        for sink in self._run.sinks:
            if sink.dropped or sink.errors:
                last = f"; the last: {sink.error}" if sink.error else ""
                say(f"sink {sink.name}: {sink.dropped} missed, {sink.errors} errors{last}.")
        for name, told in self._run.loop.views.tools.summary().items():
            words = [f"{count} {what}" for what, count in told.items() if what != "trouble"]
            say(f"tool {name}: {', '.join(words) or 'nothing'}.")
        if told := self._run.loop.views.cuts.summary():
            unknown = f", {told['unknown']:.0%} of the way unknown" if told["unknown"] else ""
            say(f"cut: {told['known']} places, {told['in_use']} in use{unknown}.")
        for name, errors in statistics.errors.items():
            off = errors.summary()
            say(f"{name}: centre off by {off['p50']:.1f} mm (median; 95 %: {off['p95']:.1f} mm).")
        if not self._run.unwritten:
            say(f"written to {self._run.report}.")
        elif not self._unwritten:
            say(f"report: {self._run.unwritten}")
        check_closed(self._run.sinks)

    def _line(self, now: float) -> None:
        statistics, source = self._run.loop.statistics, self._run.cameras
        total = sum(statistics.counts.values())
        rate = (total - self._before) / (now - self._shown)
        self._before, self._shown = total, now
        if len(statistics.latency):
            from tumortrack.live.session import resident_mb

            p50, p95 = (statistics.latency.percentile(percent) for percent in (50, 95))
            say(
                f"{now - self._began:6.0f} s  {rate:5.1f} updates/s  latency p50 {p50:.1f} p95 "
                f"{p95:.1f} ms  dropped {source.dropped}  {resident_mb():.0f} MB"
            )
