"""The error budget of each live update."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import to_builtins
from tumortrack.core.halt import Halt
from tumortrack.core.types import Mesh
from tumortrack.live.values import TrackingResult
from tumortrack_resection.budget import ErrorBudget, tightest

_SPEED_S = 0.3  # time over which a speed is averaged: estimates jitter from frame to frame
_GAP_S = 0.5  # an older position does not count for the speed


class LiveBudget:
    """Adds up the errors of every update.

    Args:
        planned: the plan's, one a tumor. If a person accepted a distance that does not cover one,
            that tumor's errors are reported only: they never halt the arms, unless they become
            unknown.
        servo_s: how far the arms lag behind their targets.

    Attributes:
        now: of the last estimate and the tumor that is the least safe. ``worst``: the one with the
            least margin left while the arms were allowed to move.
    """

    def __init__(self, planned: Sequence[ErrorBudget], servo_s: float = 0.0) -> None:
        self._planned = {budget.part: budget for budget in planned}
        self._servo_s = servo_s
        self.now: ErrorBudget | None = None
        self.worst: ErrorBudget | None = None
        # Of the tumor's centroid, by stamp
        self._places: deque[tuple[int, Float64[np.ndarray, " 3"]]] = deque()

    def add_up(
        self,
        update: TrackingResult,
        part: str,
        tumors: Mapping[str, tuple[Mesh, float]],
        least_mm: Mapping[str, float],
    ) -> tuple[Halt | None, bool]:
        """Why the arms must halt (None: they need not), and whether a new plan would help.

        Args:
            update: with an estimate.
            part: the planned tumor's name.
            tumors: all tumors' surfaces, table frame, each with its largest distance from where it
                was planned, mm.
            least_mm: the electrode's least distances from them, as planned.
        """
        estimate = update.estimate
        assert estimate is not None
        late_ms = max(update.latency_ms or 0.0, 0.0)  # a camera's clock may be ahead
        smoothing = estimate.report.smoothing
        late_ms += 0.0 if smoothing is None else smoothing.lag_ms
        speed_mm_s = self._speed_mm_s(update.stamp_ns, tumors[part][0])
        lag_mm = speed_mm_s * (late_ms / 1000 + self._servo_s)
        bounds = estimate.assessment.bounds
        budgets = {
            name: self._planned[name].updated(
                bounds[name].error_bound95_mm if name in bounds else None,
                margin_mm=least_mm[name], motion_mm=float(motion_mm), lag_mm=lag_mm,
            )
            for name, (_, motion_mm) in tumors.items()
            if name in self._planned
        }  # fmt: skip
        self.now = tightest(list(budgets.values()))
        for name, now in budgets.items():
            if "tracking" in now.assumed and "tracking" not in self._planned[name].assumed:
                return Halt("no_bound", {"part": name}), False
        covered = {n: each for n, each in budgets.items() if self._planned[n].left_mm >= 0}
        if not covered or (worst := tightest(list(covered.values()))).left_mm >= 0:
            return None, False
        return worst.as_halt, msgspec.structs.replace(worst, motion_mm=0.0).left_mm >= 0

    def went_on(self) -> None:
        """The arms may move on the last estimate."""
        if self.now is not None and (self.worst is None or self.now.left_mm < self.worst.left_mm):
            self.worst = self.now

    def forget(self) -> None:
        """There is no estimate."""
        self.now = None

    def summary(self) -> dict[str, Any]:
        """For the report: as planned, and at its worst."""
        planned = tightest(list(self._planned.values()))
        budgets = {"planned": planned, "worst": self.worst}
        return {
            name: {**to_builtins(budget), "sum_mm": budget.sum_mm, "left_mm": budget.left_mm}
            for name, budget in budgets.items()
            if budget is not None
        }

    def _speed_mm_s(self, stamp_ns: int, tumor: Mesh) -> float:
        """Recent speed of the tumor's centroid; 0 for the first estimate."""
        places = self._places
        if places and not 0 < stamp_ns - places[-1][0] <= 1e9 * _GAP_S:
            places.clear()
        places.append((stamp_ns, tumor.vertices_mm.mean(0)))
        while len(places) > 2 and places[-1][0] - places[1][0] >= 1e9 * _SPEED_S:
            places.popleft()
        (first_ns, first_mm), (last_ns, last_mm) = places[0], places[-1]
        if last_ns == first_ns:
            return 0.0
        return float(np.linalg.norm(last_mm - first_mm)) / (1e-9 * (last_ns - first_ns))
