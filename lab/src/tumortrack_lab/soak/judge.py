"""How each fault was handled, and errors of every estimate that was called good."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from tumortrack.cli.console import say
from tumortrack.live.meter import Histogram
from tumortrack.live.session import resident_mb
from tumortrack.live.values import TrackingResult
from tumortrack.live.workers import SinkWorker
from tumortrack_lab.soak.faults import FAULTS, SINK_FAULTS, Fault, Schedule, Staged

_KEPT = 20  # wrong estimates that are listed


@dataclass(eq=False)
class Answer:
    """The reaction to one fault: after how many seconds, in which words, and how long after its end
    there was a good estimate again. NaN: not (yet)."""

    fault: Fault
    named_s: float = np.nan
    words: str = ""
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
                answer.named_s, answer.words = now_s - fault.begun_s, words

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
