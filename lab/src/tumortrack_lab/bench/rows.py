"""Workloads, and the rows that they become when they are timed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tumortrack.core.config import Config

_FEWEST, _MOST = 3, 25  # turns
_LEAST_S = 0.01  # of a turn: shorter calls are repeated within it
_LONG_S = 0.5  # a first call that takes longer is warm enough
_LONGER_S = 1.0  # and one that takes longer still is a turn: what it loaded is little beside it
METHOD = "clinic"  # the default method's preset
# What rows are called.
SEARCH, FIRST_LOOK = "search", "search and refinement"
FRAME, TRACKING = "frame", "tracking frame"
PATIENT = "labels to first estimate"
VOLUME, COMMAND, LARGE = "400^3 labels", "`locate` command", "`locate --grid 400` command"
PLAN, MOTIONS = "plan", "motions"


@dataclass(frozen=True)
class Uncounted:
    """What a timed call returns if some of its seconds belong to something else."""

    seconds: float


Call = Callable[[], object]


class Timing(Config, frozen=True):
    """Seconds of one call: the median of several turns, the quartiles about it, the fastest."""

    best_s: float
    median_s: float
    low_s: float
    high_s: float
    turns: int


def timed(call: Call, budget_s: float) -> Timing:
    """Seconds a call. It is called before (compiled, cached, warm), then until ``budget_s`` is
    spent, between 3 and 25 times. A first call that took more than a second counts as a turn: a
    median of three bears a cold one."""
    begun = time.perf_counter()
    took_s, counted_s = _turn(call, 1)
    if took_s <= _LONG_S:
        took_s, counted_s = _turn(call, 1)
    repeat = max(1, math.ceil(_LEAST_S / max(took_s, 1e-7)))
    seconds = [counted_s] if took_s > _LONGER_S else []
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        if len(seconds) >= _FEWEST and past_s * (done + 1) / max(done, 1) > budget_s:
            break
        seconds.append(_turn(call, repeat)[1] / repeat)
    return timing_of(seconds)


def _turn(call: Call, repeat: int) -> tuple[float, float]:
    """Seconds of so many calls: in all, and those that count."""
    start, uncounted = time.perf_counter(), 0.0
    for _ in range(repeat):
        result = call()
        uncounted += result.seconds if isinstance(result, Uncounted) else 0.0
    took_s = time.perf_counter() - start
    return took_s, took_s - uncounted


def timing_of(seconds: list[float]) -> Timing:
    low, middle, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
    return Timing(best_s=min(seconds), median_s=middle, low_s=low, high_s=high, turns=len(seconds))


class BenchRow(Config, frozen=True):
    """One measured part. ``item``: what a call makes, such as a frame; ``peak_bytes``: of a
    process's memory (0: not measured)."""

    name: str
    what: str
    threads: int
    item: str
    timing: Timing
    peak_bytes: int = 0
    note: str = ""

    @property
    def per_s(self) -> float:
        """Items a second."""
        return 1 / self.timing.median_s


@dataclass(frozen=True, eq=False)
class Workload:
    """What becomes a row; ``facts``: the row's other fields, asked for once it is timed."""

    name: str
    what: str
    item: str
    call: Call
    facts: Callable[[], dict[str, Any]] = dict

    def row(self, threads: int, budget_s: float) -> BenchRow:
        """Time it."""
        timing = timed(self.call, budget_s)
        about = {"threads": threads, "item": self.item, "timing": timing, **self.facts()}
        return BenchRow(self.name, self.what, **about)


class BenchResult(Config, frozen=True):
    """All that was measured in one run, and on what."""

    machine: dict[str, str]
    command: str
    rows: tuple[BenchRow, ...] = ()
