"""How often things happen, how long they take, and how large errors are."""

from __future__ import annotations

import time

import numpy as np

_FINEST, _COARSEST = 0.01, 1e6
_STEP = 1.01  # one bin to the next: percentiles are right to 1 %


class Histogram:
    """Positive numbers (times in ms, errors in mm), counted in bins that widen by 1 %: over hours
    in constant memory."""

    def __init__(self) -> None:
        bins = int(np.ceil(np.log(_COARSEST / _FINEST) / np.log(_STEP))) + 1
        self._counts = np.zeros(bins, np.int64)
        self._largest = 0.0

    def add(self, number: float) -> None:
        """Count one; what lies beyond 0.01 or a million counts as that."""
        place = np.log(max(number, _FINEST) / _FINEST) / np.log(_STEP)
        self._counts[min(int(place), len(self._counts) - 1)] += 1
        self._largest = max(self._largest, number)

    def __len__(self) -> int:
        return int(self._counts.sum())

    def percentile(self, share: float) -> float:
        """What ``share`` per cent do not exceed: the middle of its bin. NaN of nothing."""
        total = self._counts.sum()
        if not total:
            return float("nan")
        rank = max(int(np.ceil(share / 100 * total)), 1)
        place = int(np.searchsorted(np.cumsum(self._counts), rank))
        return min(float(_FINEST * _STEP ** (place + 0.5)), self._largest)

    def summary(self) -> dict[str, float | int]:
        """count, p50, p95, p99, p99.9 and max (JSON types); count alone of nothing."""
        if not len(self):
            return {"count": 0}
        marks = {f"p{mark:g}": round(self.percentile(mark), 3) for mark in (50.0, 95.0, 99.0, 99.9)}
        return {"count": len(self), **marks, "max": round(self._largest, 3)}


class Rate:
    """Lets things happen at most ``hz`` times a second on average; 0: each time."""

    def __init__(self, hz: float) -> None:
        self._period_s = 1 / hz if hz > 0 else 0.0
        self._next_s = 0.0

    def due(self) -> bool:
        now = time.monotonic()
        if now < self._next_s:
            return False
        in_step = now < self._next_s + self._period_s
        self._next_s = (self._next_s if in_step else now) + self._period_s
        return True
