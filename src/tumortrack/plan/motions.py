"""What both arms do, in stages, as joint angles over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.live.sinks.ur import UR_JOINTS

CUTTER, HOLDER = "cutter", "holder"  # UR10e with the instrument, UR5 with the vacuum grasper
JOINTS = tuple(f"{arm}_{joint}" for arm in (CUTTER, HOLDER) for joint in UR_JOINTS)


@dataclass(frozen=True, eq=False)
class MotionStage:
    """One state of the procedure: approach, grasp, hold, sweep 1, sweep 2, ..., release, home.

    Attributes:
        times_s: rising from 0 (n,); one entry where nothing moves.
        joints_rad: of all twelve joints in the order of ``JOINTS`` (n, 12); between two times
            they change linearly.
        cutting: True at the times at which the instrument's tip is on a cut (n,).
    """

    name: str
    times_s: Float64[np.ndarray, " n"]
    joints_rad: Float64[np.ndarray, "n 12"]
    cutting: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.times_s)
        if not (n and self.joints_rad.shape == (n, len(JOINTS)) and self.cutting.shape == (n,)):
            raise InputError(f"stage {self.name}: times, joints and cutting must match.")
        if self.times_s[0] != 0 or (np.diff(self.times_s) <= 0).any():
            raise InputError(f"stage {self.name}: times must rise from 0.")

    @property
    def seconds(self) -> float:
        return float(self.times_s[-1])

    def at(self, time_s: float) -> Float64[np.ndarray, " 12"]:
        """Joint angles so long after the stage began."""
        t = self.times_s
        return np.array([np.interp(time_s, t, self.joints_rad[:, j]) for j in range(len(JOINTS))])


@dataclass(frozen=True, eq=False)
class Motions:
    """The stages in their order, each beginning where the one before ended."""

    stages: tuple[MotionStage, ...]

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)
