"""Motions of both arms, stage by stage, as joint angles over time; and their execution, a state
machine without a clock that halts smoothly at any time."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack_resection.halt import Halt
from tumortrack_resection.ur_sink import UR_JOINTS

CUTTER, HOLDER = "cutter", "holder"  # UR10e with the instrument, UR5 with the vacuum grasper
ARMS = (CUTTER, HOLDER)
Joints = Float64[np.ndarray, " 12"]  # radians, in the order of ``JOINTS``
JOINTS = tuple(f"{arm}_{joint}" for arm in ARMS for joint in UR_JOINTS)
_BRAKE_RAD_S2 = 4.0  # deceleration of the fastest joint when arms halt during a motion
_SHORTEST_BRAKE_S = 0.1
_CATCH_UP_S = 0.3  # three times the servo's lookahead; the way in to a cut takes longer


class Stage(StrEnum):
    """Names of stages, and of the states after the last; sweeps have numbers."""

    HOLD = "hold"
    PULL = "pull"  # with a pull, between hold and the first sweep
    TAUT = "taut"
    LIFT = "lift"
    RELEASE = "release"
    WITHDRAW = "withdraw"  # only of motions that were planned again, with an instrument in tissue
    DONE = "done"
    ABORTED = "aborted"


@dataclass(frozen=True, eq=False)
class MotionStage:
    """One state of the procedure: approach, grasp, hold, perhaps pull and taut, sweep 1, ...,
    lift, release, home. ``times_s``: rising from 0; between two times all twelve joints change
    linearly. ``cutting``: whether the instrument's tip is on a cut."""

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

    @property
    def sweep(self) -> int:
        """From 1; 0: the stage is no sweep."""
        return int(self.name.removeprefix("sweep ")) if self.name.startswith("sweep ") else 0

    def at(self, time_s: float) -> Joints:
        return np.array([np.interp(time_s, self.times_s, joint) for joint in self.joints_rad.T])


@dataclass(frozen=True, eq=False)
class Motions:
    """The stages in their order, each beginning where the one before ended."""

    stages: tuple[MotionStage, ...]

    @property
    def seconds(self) -> float:
        return sum(stage.seconds for stage in self.stages)


class Execution:
    """``step`` advances time; ``halt`` slows the arms down to a stop on their path, ``go``
    resumes; ``abort`` is a halt for good. ``pace``: share of the motions' speed. ``halted``: why
    the arms stand or slow down; ``gripped_rad``: the joints at the end of hold."""

    def __init__(self, motions: Motions) -> None:
        self._motions = motions
        self._number, self._time_s = 0, 0.0
        self._speed = 0.0  # of the motions' own time, 0..1
        self.pace = 1.0
        self.halted: Halt | None = None
        self.gripped_rad: Joints | None = None
        self._aborted = False

    @property
    def state(self) -> str:
        if self._aborted:
            return Stage.ABORTED
        return Stage.DONE if self._over else self._stage.name

    @property
    def ended(self) -> bool:
        return self._over or (self._aborted and self.still)

    @property
    def still(self) -> bool:
        return self._speed == 0.0 or self._over

    @property
    def sweep(self) -> int:
        """0 before the first; after the last, the number of sweeps plus 1."""
        stages = self._motions.stages
        past = max(stage.sweep for stage in stages[: self._number + 1])
        before = self._first(Stage.HOLD, -1) < 0  # withdraws before it goes on
        if not past and self.holds and before:
            return next((stage.sweep for stage in stages if stage.sweep), 0)
        after = self._over or not self._stage.sweep
        return past + 1 if past and after else past

    @property
    def holds(self) -> bool:
        """The holder has been at the grasp point: the state is hold or later."""
        return self._number >= self._first(Stage.HOLD, 0)

    @property
    def grips(self) -> bool:
        """The cup has hold of the organ: from the end of hold until the piece is lifted."""
        lift = self._first(Stage.LIFT, len(self._motions.stages))
        return self._first(Stage.HOLD, -1) < self._number < lift

    @property
    def stage(self) -> str:
        """Its name, also of an aborted one."""
        return self._stage.name

    @property
    def cutting(self) -> bool:
        """The instrument is on a cut, and has been for long enough that the arm has caught up."""
        times_s, since_s = self._stage.times_s, self._time_s - _CATCH_UP_S
        first = int(np.searchsorted(times_s, since_s, side="right")) - 1
        last = int(np.searchsorted(times_s, self._time_s, side="left"))
        return first >= 0 and not self._over and bool(self._stage.cutting[first : last + 1].all())

    @property
    def joints_rad(self) -> Joints:
        return self._stage.at(self._time_s)

    def go(self) -> None:
        if not self._aborted:
            self.halted = None

    def halt(self, reason: Halt) -> None:
        if not self._aborted:
            self.halted = reason

    def abort(self, reason: Halt) -> None:
        """No effect once everything has ended."""
        if not self._over:
            self.halt(reason)
            self._aborted = True

    def replace(self, motions: Motions) -> None:
        """Continue with other motions; InputError: they begin elsewhere, or the arms are moving."""
        if not self.still:
            raise InputError("motions can be replaced only while the arms stand.")
        off = np.abs(motions.stages[0].joints_rad[0] - self.joints_rad).max()
        if off > 1e-6:
            raise InputError(f"the new motions begin {off:.2g} rad from where the arms are.")
        self._motions, self._number, self._time_s = motions, 0, 0.0

    def step(self, seconds: float) -> None:
        if not seconds >= 0:
            raise InputError(f"time goes forward; {seconds:g} s does not.")
        while seconds > 0 and not self._over:
            change = min(seconds, 0.02)  # the speed changes in such small steps
            seconds -= change
            target, before = 0.0 if self.halted else self.pace, self._speed
            most = change / self._brake_s()
            self._speed += float(np.clip(target - before, -most, most))
            self._time_s += change * (before + self._speed) / 2
            while not self._over and self._time_s >= (length_s := self._stage.seconds):
                if self._stage.name == Stage.HOLD:
                    self.gripped_rad = self._stage.joints_rad[-1]
                self._number += 1
                self._time_s = length_s if self._over else self._time_s - length_s

    def _brake_s(self) -> float:
        stage = self._stage
        here = int(np.searchsorted(stage.times_s, self._time_s, side="right"))
        around = slice(max(0, here - 3), here + 3)
        times, joints = stage.times_s[around], stage.joints_rad[around]
        if len(times) < 2:
            return _SHORTEST_BRAKE_S
        speed = np.abs(np.diff(joints, axis=0) / np.diff(times)[:, None]).max()
        return max(_SHORTEST_BRAKE_S, float(speed) / _BRAKE_RAD_S2)

    def _first(self, name: str, without: int) -> int:
        """``without``: where there is none."""
        names = [stage.name for stage in self._motions.stages]
        return names.index(name) if name in names else without

    @property
    def _over(self) -> bool:
        return self._number >= len(self._motions.stages)

    @property
    def _stage(self) -> MotionStage:
        return self._motions.stages[min(self._number, len(self._motions.stages) - 1)]
