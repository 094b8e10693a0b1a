"""How often things happen, how long they take, and how large errors are."""

from __future__ import annotations

import traceback
from collections import Counter
from typing import Any

import numpy as np

from tumortrack.core.report import Finding
from tumortrack.live.values import TrackingResult

_FINEST, _COARSEST = 0.01, 1e6
_KINDS = 50  # of reasons that are counted apart
_DEFECTS = 5  # tracebacks that are kept
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
        if not len(self):
            return float("nan")
        rank = max(int(np.ceil(share / 100 * len(self))), 1)
        place = int(np.searchsorted(np.cumsum(self._counts), rank))
        return min(float(_FINEST * _STEP ** (place + 0.5)), self._largest)

    def summary(self) -> dict[str, float | int]:
        """count, p50, p95, p99, p99.9 and max (JSON types); count alone of nothing."""
        if not len(self):
            return {"count": 0}
        marks = {f"p{mark:g}": round(self.percentile(mark), 3) for mark in (50.0, 95.0, 99.0, 99.9)}
        return {"count": len(self), **marks, "max": round(self._largest, 3)}


class RunStatistics:
    """What a run was like: how often, why not, how fast, how exact."""

    def __init__(self) -> None:
        self.latency = Histogram()
        self.stages: dict[str, Histogram] = {}
        self.errors: dict[str, Histogram] = {}  # mm, of a source that knows the truth
        self.counts: Counter[str] = Counter()  # by quality
        self.reasons: Counter[str] = Counter()  # in words, numbers replaced by #
        self._labels: dict[object, str] = {}
        self.cameras: Counter[str] = Counter()  # of several: estimates that each took part in
        self.clock_jumps = 0  # how often the source's clock was set back
        self.defects: list[str] = []

    def add(self, result: TrackingResult) -> None:
        self.counts[result.quality] += 1
        if result.reason:
            finding = result.finding or Finding("source", {"message": result.reason})
            more = len(self._labels) >= _KINDS
            label = "other reasons" if more else finding.words_without_numbers
            self.reasons[self._labels.setdefault(finding.same_as, label)] += 1
        for name, stage_s in result.seconds.items():
            self.stages.setdefault(name, Histogram()).add(1000 * stage_s)
        if result.estimate is None:
            return
        self.cameras.update(map(str, result.estimate.report.cameras))
        if result.latency_ms is not None:
            self.latency.add(result.latency_ms)
        if result.observation is None or (truth := result.observation.truth) is None:
            return
        for name, true in zip(truth.names, truth.parts, strict=True):
            if (mesh := result.estimate.meshes.get(name)) is not None:
                off = mesh.box_mm.mean(0) - true.box_mm.mean(0)
                self.errors.setdefault(name, Histogram()).add(float(np.linalg.norm(off)))

    def add_defect(self, error: Exception) -> None:
        if len(self.defects) < _DEFECTS:
            self.defects.append("".join(traceback.format_exception(error)))

    def summary(self) -> dict[str, Any]:
        """JSON types; latencies and stage times in ms."""
        return {
            "updates": sum(self.counts.values()),
            "estimates": {"good": self.counts["good"], "poor": self.counts["poor"]},
            "no_estimate": self.counts["none"],
            "reasons": dict(self.reasons.most_common()),
            **({"cameras": dict(sorted(self.cameras.items()))} if self.cameras else {}),
            "clock_jumps": self.clock_jumps,
            "latency_ms": self.latency.summary(),
            "stages_ms": {name: times.summary() for name, times in self.stages.items()},
            "center_error_mm": {name: errors.summary() for name, errors in self.errors.items()},
        }
