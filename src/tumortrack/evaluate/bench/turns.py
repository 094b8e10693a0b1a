"""Timing several versions in turns, so that what else the machine does meets all of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tumortrack.core.config import Config

_FEWEST, _MOST = 3, 25  # rounds
_LEAST_S = 0.01  # that a turn lasts: shorter calls are repeated within it
_PATIENCE = 2.0  # times the budget that the fewest turns may take
_LONG_S = 0.5  # a first call that takes longer is warm enough


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

    def times(self, factor: float) -> Timing:
        """Of so many calls, or of a part of one."""
        return Timing(
            best_s=self.best_s * factor,
            median_s=self.median_s * factor,
            low_s=self.low_s * factor,
            high_s=self.high_s * factor,
            turns=self.turns,
        )


def in_turns(*versions: Call, budget_s: float, fewest: int = _FEWEST) -> list[Timing]:
    """Seconds a call of each version. Every version is called before (compiled, cached, warm);
    then all take turns until ``budget_s`` is spent, between ``fewest`` and 25 times each; fewer
    only where that would take more than twice as long."""
    repeats = [_repeats(version) for version in versions]
    seconds: list[list[float]] = [[] for _ in versions]
    begun = time.perf_counter()
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        if done >= fewest and past_s * (done + 1) / done > budget_s:
            break
        if done and past_s > _PATIENCE * budget_s:
            break
        for times, version, repeat in zip(seconds, versions, repeats, strict=True):
            start, uncounted = time.perf_counter(), 0.0
            for _ in range(repeat):
                told = version()
                uncounted += told.seconds if isinstance(told, Uncounted) else 0.0
            times.append((time.perf_counter() - start - uncounted) / repeat)
    return [timing_of(times) for times in seconds]


def timing_of(seconds: list[float]) -> Timing:
    """Median and quartiles of the turns' seconds."""
    low, middle, high = (float(np.quantile(seconds, q)) for q in (0.25, 0.5, 0.75))
    return Timing(best_s=min(seconds), median_s=middle, low_s=low, high_s=high, turns=len(seconds))


def _repeats(version: Call) -> int:
    for _ in range(2):
        start = time.perf_counter()
        version()
        took_s = time.perf_counter() - start
        if took_s > _LONG_S:
            break
    return max(1, math.ceil(_LEAST_S / max(took_s, 1e-7)))
