"""Who moves while the rest stands, and whether a configuration or a short way is free."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import NoPlan
from tumortrack.plan.arms.cell import ARMS, ArmCell


class Blocked(NoPlan):
    """This way can't be gone; perhaps another can. The text says where and why; ``pair``: who would
    meet whom, if that is it."""

    def __init__(self, text: str, pair: tuple[str, str] | None = None) -> None:
        super().__init__(text)
        self.pair = pair


@dataclass(frozen=True, eq=False)
class Situation:
    """Some joints move while the others stand.

    Attributes:
        arm: cutter or holder; None: both move.
        joints_rad: where both are (12,).
        touching: arms that may touch the organ with their electrode or cup.
    """

    cell: ArmCell
    arm: str | None
    joints_rad: Float64[np.ndarray, " 12"]
    touching: Collection[str] = ()

    @cached_property
    def own(self) -> slice:
        """The moving joints among the twelve."""
        if self.arm is None:
            return slice(0, 6 * len(ARMS))
        first = 6 * ARMS.index(self.arm)
        return slice(first, first + 6)

    @property
    def here_rad(self) -> Float64[np.ndarray, " d"]:
        """The moving joints now."""
        return self.joints_rad[self.own]

    @property
    def limits_rad(self) -> Float64[np.ndarray, " d"]:
        return self.cell.limits_rad[self.own]

    def whole(self, own_rad: Float64[np.ndarray, " d"]) -> Float64[np.ndarray, " 12"]:
        """All twelve joints, the moving ones being these."""
        joints = self.joints_rad.copy()
        joints[self.own] = own_rad
        return joints

    def collides(self, own_rad: Float64[np.ndarray, " d"]) -> tuple[str, str] | None:
        """Who comes nearer than allowed to whom."""
        return self.cell.collisions(self.whole(own_rad), self.touching, moving=self.arm)

    def tests(self, start_rad: np.ndarray, goal_rad: np.ndarray, spacing: float = 1.0) -> int:
        """Into how many steps a straight way must be cut to be tested without a gap.

        With ``spacing`` 1 no point of an arm moves by more than twice the least clearance in one
        step, so that what is free of collisions with that clearance at both ends is free between.
        """
        least_mm = min(self.cell.config.clearance_mm, self.cell.config.organ_clearance_mm)
        levers_mm = self.cell.levers_mm(self.whole(start_rad), self.whole(goal_rad))
        moved_mm = float(np.abs(goal_rad - start_rad) @ levers_mm[self.own])
        return int(np.ceil(moved_mm / (2 * least_mm * spacing)))

    def way_collides(
        self, start_rad: np.ndarray, goal_rad: np.ndarray, spacing: float = 1.0
    ) -> tuple[str, str] | None:
        """The same between two free configurations, on the straight way in joint space."""
        n = self.tests(start_rad, goal_rad, spacing)
        # From the middle outward: what blocks is rarely near the ends.
        for k in sorted(range(1, n), key=lambda k: abs(2 * k - n)):
            if pair := self.collides(start_rad + (goal_rad - start_rad) * (k / n)):
                return pair
        return None
