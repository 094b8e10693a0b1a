"""Interleaved timing: versions take turns, so that what else the machine does meets all of them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tumortrack.core.config import Config

_FEWEST, _MOST = 3, 25  # rounds
_LEAST_S = 0.01  # that a turn lasts: shorter calls are repeated within it
_LONG_S = 0.5  # a first call that takes longer is warm enough
_LONGER_S = 1.0  # and one that takes longer still is a turn: what it loaded is little beside it


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
        best, median, low, high = (
            seconds * factor for seconds in (self.best_s, self.median_s, self.low_s, self.high_s)
        )
        return InterleavedTiming(
            best_s=best, median_s=median, low_s=low, high_s=high, turns=self.turns
        )


def interleaved(*versions: Call, budget_s: float, fewest: int = _FEWEST) -> list[InterleavedTiming]:
    """Seconds a call of each version. Every version is called before (compiled, cached, warm);
    then all take turns until ``budget_s`` is spent, between ``fewest`` and 25 times each. A first
    call that took more than a second counts as a turn: a median of three bears a cold one. Where
    time is up, those that have had the fewest turns leave the last to the others."""
    begun = time.perf_counter()
    warmed = [_warm(version) for version in versions]
    repeats = [max(1, math.ceil(_LEAST_S / max(took_s, 1e-7))) for took_s, _ in warmed]
    seconds = [[counted_s] if took_s > _LONGER_S else [] for took_s, counted_s in warmed]
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        up = past_s * (done + 1) / max(done, 1) > budget_s
        if up and min(map(len, seconds)) >= fewest:
            break
        for times, version, repeat in zip(seconds, versions, repeats, strict=True):
            if not (up and len(times) >= fewest):
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
    """Median and quartiles of the turns' seconds."""
    low, middle, high = (float(np.quantile(seconds, q)) for q in (0.25, 0.5, 0.75))
    return InterleavedTiming(
        best_s=min(seconds), median_s=middle, low_s=low, high_s=high, turns=len(seconds)
    )


def _warm(version: Call) -> tuple[float, float]:
    """Of the last call of those that warm it up."""
    first = _turn(version, 1)
    return first if first[0] > _LONG_S else _turn(version, 1)
