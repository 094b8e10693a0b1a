"""Workloads, timed in turns, and the rows that become of them: what was done, and how long it took.
Versions take turns, so that what else the machine does meets all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.config import Config

_FEWEST, _MOST = 3, 25  # rounds
_LEAST_S = 0.01  # that a turn lasts: shorter calls are repeated within it
_LONG_S = 0.5  # a first call that takes longer is warm enough
_LONGER_S = 1.0  # and one that takes longer still is a turn: what it loaded is little beside it
PRESETS = "clinic", "paper"  # whose models are measured
# What rows are called.
SEARCH, FIRST_LOOK = "search", "search and refinement"
FRAME, EVERY, TRACKING = "frame", "frame, every query asked", "tracking frame"
PATIENT = "labels to first estimate"
VOLUME, COMMAND, LARGE = "400^3 labels", "`locate` command", "`locate --grid 400` command"
PLAN, MOTIONS, TRAINING = "plan", "motions", "training, generator included"
PEAK = "peak bytes"  # among ``others``


@dataclass(frozen=True)
class Uncounted:
    """What a timed call returns if some of its seconds belong to something else."""

    seconds: float


Call = Callable[[], object]


class InterleavedTiming(Config, frozen=True):
    """Seconds of one call: the median of several turns, the quartiles about it, the fastest."""

    best_s: float
    median_s: float
    low_s: float
    high_s: float
    turns: int

    def times(self, factor: float) -> InterleavedTiming:
        """Of so many calls, or of a part of one."""
        seconds = {key: factor * getattr(self, key) for key in self.__struct_fields__[:4]}
        return InterleavedTiming(**seconds, turns=self.turns)


def interleaved(*versions: Call, budget_s: float) -> list[InterleavedTiming]:
    """Seconds a call of each version. Every version is called before (compiled, cached, warm);
    then all take turns until ``budget_s`` is spent, between 3 and 25 times each. A first
    call that took more than a second counts as a turn: a median of three bears a cold one. Where
    time is up, those that have had the fewest turns leave the last to the others."""
    begun = time.perf_counter()
    warmed = []
    for version in versions:
        first = _turn(version, 1)
        warmed.append(first if first[0] > _LONG_S else _turn(version, 1))
    repeats = [max(1, math.ceil(_LEAST_S / max(took_s, 1e-7))) for took_s, _ in warmed]
    seconds = [[counted_s] if took_s > _LONGER_S else [] for took_s, counted_s in warmed]
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        up = past_s * (done + 1) / max(done, 1) > budget_s
        if up and min(map(len, seconds)) >= _FEWEST:
            break
        for times, version, repeat in zip(seconds, versions, repeats, strict=True):
            if not (up and len(times) >= _FEWEST):
                times.append(_turn(version, repeat)[1] / repeat)
    return [timing_of(times) for times in seconds]


def _turn(version: Call, repeat: int) -> tuple[float, float]:
    """Seconds of so many calls: in all, and those that count."""
    start, uncounted = time.perf_counter(), 0.0
    for _ in range(repeat):
        result = version()
        uncounted += result.seconds if isinstance(result, Uncounted) else 0.0
    took_s = time.perf_counter() - start
    return took_s, took_s - uncounted


def timing_of(seconds: list[float]) -> InterleavedTiming:
    low, middle, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
    return InterleavedTiming(
        best_s=min(seconds), median_s=middle, low_s=low, high_s=high, turns=len(seconds)
    )


class BenchRow(Config, frozen=True):
    """One measured part.

    ``item`` is what a call makes: a pair, a frame; ``per_call``: how many of them. ``naive`` is the
    plain form's time for the same, ``naive_is`` says what it is. ``agreement``: share of labels
    equal to the naive form's in single precision. ``others``: other figures, by name.
    """

    name: str
    what: str
    threads: int
    item: str
    ours: InterleavedTiming
    naive: InterleavedTiming | None = None
    naive_is: str = ""
    per_call: int = 1
    agreement: float | None = None
    others: dict[str, float] = msgspec.field(default_factory=dict)
    note: str = ""
    device: str = "cpu"

    @property
    def ratio(self) -> float | None:
        """How many times faster than the naive form."""
        return None if self.naive is None else self.naive.median_s / self.ours.median_s

    @property
    def per_s(self) -> float:
        """Items a second."""
        return self.per_call / self.ours.median_s


@dataclass(eq=False)
class Workload:
    """What becomes a row: our form and the naive one, each a call or what it took.

    ``naive_share``: how many times the naive
    form's part the whole work is; ``facts``: the row's other fields, asked for once it is timed;
    ``beside``: other forms of ours, timed in the same turns and beside the same naive form.
    ``naive`` holds the seconds once they are known.
    """

    name: str
    what: str
    item: str
    ours: Call | InterleavedTiming
    naive: Call | InterleavedTiming | None = None
    naive_is: str = ""
    naive_share: float = 1.0
    facts: Callable[[], dict[str, Any]] = dict
    beside: tuple[Workload, ...] = ()

    def rows(self, threads: int, budget_s: float) -> Iterator[BenchRow]:
        """Time all forms in turns."""
        forms = (self, *self.beside)
        calls = [call for call in (*(f.ours for f in forms), self.naive) if callable(call)]
        seconds = interleaved(*calls, budget_s=budget_s)
        timed: dict[object, Any] = dict(zip(calls, seconds, strict=True))
        self.naive = known = timed.get(self.naive, self.naive)
        naive = None if known is None else known.times(self.naive_share)
        for form in forms:
            ours = timed.get(form.ours, form.ours)
            yield BenchRow(
                name=form.name, what=form.what, threads=threads, item=form.item, ours=ours,
                naive=naive, naive_is=self.naive_is, **form.facts(),
            )  # fmt: skip


class BenchResult(Config, frozen=True):
    """All that was measured in one run, and on what."""

    machine: dict[str, str]
    command: str
    rows: tuple[BenchRow, ...] = ()
