"""Workloads, timed in turns, and the rows that become of them: what was done and how long it took.
Versions take turns, so that what else the machine does meets all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.config import Config

_FEWEST, _MOST = 3, 25  # rounds
_LEAST_S = 0.01  # that a turn lasts: shorter calls are repeated within it
_LONG_S = 0.5  # a first call that takes longer is warm enough
_LONGER_S = 1.0  # and one that takes longer still is a turn: what it loaded is little beside it
# What rows are called.
GENERATOR, FRAME, TRACKING = "generator", "frame", "tracking frame"
VOLUME, COMMAND, LARGE = "400^3 labels", "`locate` command", "`locate --grid 400` command"
PLAN, MOTIONS, STEP, TRAINING = "plan", "motions", "training step", "training, generator included"
BEFORE_TORCH, PEAK = "seconds before torch is imported", "peak bytes"  # among ``others``

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
    then all take turns until ``budget_s`` is spent, between 3 and 25 times each. A first call that
    took more than a second counts as a turn: a median of three bears a cold one. Where time is up,
    those that have had the fewest turns leave the last to the others."""
    begun = time.perf_counter()
    warmed = []
    for version in versions:
        first_s = _turn_s(version, 1)
        warmed.append(first_s if first_s > _LONG_S else _turn_s(version, 1))
    repeats = [max(1, math.ceil(_LEAST_S / max(took_s, 1e-7))) for took_s in warmed]
    seconds = [[took_s] if took_s > _LONGER_S else [] for took_s in warmed]
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        up = past_s * (done + 1) / max(done, 1) > budget_s
        if up and min(map(len, seconds)) >= _FEWEST:
            break
        for times, version, repeat in zip(seconds, versions, repeats, strict=True):
            if not (up and len(times) >= _FEWEST):
                times.append(_turn_s(version, repeat) / repeat)
    return [timing_of(times) for times in seconds]


def _turn_s(version: Call, repeat: int) -> float:
    start = time.perf_counter()
    for _ in range(repeat):
        version()
    return time.perf_counter() - start


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


@dataclass(frozen=True, eq=False)
class Workload:
    """What becomes a row: our form, a call or what it took, and perhaps a naive one.

    ``calls``: how many items one call of ours makes; ``naive_share``: how many times the naive
    form's part the whole work is; ``facts``: the row's other fields, asked for once it is timed.
    """

    name: str
    what: str
    item: str
    ours: Call | InterleavedTiming
    naive: Call | None = None
    naive_is: str = ""
    calls: int = 1
    naive_share: float = 1.0
    facts: Callable[[], dict[str, Any]] = dict

    def row(self, threads: int, budget_s: float) -> BenchRow:
        """Time both forms in turns."""
        ours, naive = self.ours, None
        if not isinstance(ours, InterleavedTiming):
            forms = [ours, *([self.naive] if self.naive else [])]
            ours, *others = interleaved(*forms, budget_s=budget_s)
            naive = others[0].times(self.naive_share) if others else None
        return BenchRow(
            name=self.name, what=self.what, threads=threads, item=self.item,
            ours=ours.times(1 / self.calls), naive=naive, naive_is=self.naive_is, **self.facts(),
        )  # fmt: skip


class BenchResult(Config, frozen=True):
    """All that was measured in one run, and on what."""

    machine: dict[str, str]
    command: str
    rows: tuple[BenchRow, ...] = ()
