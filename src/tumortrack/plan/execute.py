"""Stage after stage in time: where the arms are now, halted smoothly and at any moment."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.plan.motions import Motions, MotionStage

DONE, ABORTED = "done", "aborted"
_BRAKE_RAD_S2 = 4.0  # of the fastest joint, where arms are halted in the middle of a motion
_SHORTEST_BRAKE_S = 0.1


class Execution:
    """Walks through motions. ``step`` says how much time went by; ``halt`` lets the arms slow down
    and stand, on their way, and ``go`` lets them go on; ``abort`` is a halt for good.

    ``state`` is the name of the stage, ``done`` or ``aborted``.
    """

    def __init__(self, motions: Motions) -> None:
        self._motions = motions
        self._number, self._time_s = 0, 0.0
        self._speed = 0.0  # of the motions' own time, 0..1
        self._reason, self._aborted = "", False

    @property
    def state(self) -> str:
        if self._aborted:
            return ABORTED
        return DONE if self._over else self._stage.name

    @property
    def ended(self) -> bool:
        """Nothing will move any more."""
        return self._over or (self._aborted and self.still)

    @property
    def halted(self) -> str:
        """Why the arms stand or slow down; empty where they don't."""
        return self._reason

    @property
    def still(self) -> bool:
        """The arms stand."""
        return self._speed == 0.0 or self._over

    @property
    def sweep(self) -> int:
        """Of the stage: the sweep's number; 0 before the first, and one more than there are after
        the last."""
        past = 0
        for stage in self._motions.stages[: self._number + 1]:
            if stage.name.startswith("sweep "):
                past = int(stage.name.removeprefix("sweep "))
        after = self._over or not self._stage.name.startswith("sweep ")
        return past + 1 if past and after else past

    @property
    def holds(self) -> bool:
        """The holder has been at the grasp point: the state is hold or later."""
        names = [stage.name for stage in self._motions.stages]
        return "hold" not in names or self._number >= names.index("hold")

    @property
    def cutting(self) -> bool:
        """The instrument's tip is on a cut."""
        stage = self._stage
        at = int(np.searchsorted(stage.times_s, self._time_s, side="right")) - 1
        return not self._over and bool(stage.cutting[max(at, 0)])

    @property
    def joints_rad(self) -> Float64[np.ndarray, " 12"]:
        return self._stage.at(self._time_s)

    def go(self) -> None:
        """Take up the motion again, or begin."""
        if not self._aborted:
            self._reason = ""

    def halt(self, reason: str) -> None:
        """Slow down and stand."""
        if not reason:
            raise InputError("a halt needs its reason.")
        if not self._aborted:
            self._reason = reason

    def abort(self, reason: str) -> None:
        """Slow down and stand, and never go on. Nothing, where it has ended anyway."""
        if not self._over:
            self.halt(reason)
            self._aborted = True

    def replace(self, motions: Motions) -> None:
        """Go on with other motions, which begin where the arms stand now.

        Raises:
            InputError: they begin elsewhere, or the arms are moving.
        """
        if not self.still:
            raise InputError("motions can be replaced only while the arms stand.")
        off = np.abs(motions.stages[0].joints_rad[0] - self.joints_rad).max()
        if off > 1e-6:
            raise InputError(f"the new motions begin {off:.2g} rad from where the arms are.")
        self._motions, self._number, self._time_s = motions, 0, 0.0

    def step(self, seconds: float) -> None:
        """Let so much time go by."""
        if not seconds >= 0:
            raise InputError(f"time goes forward; {seconds:g} s does not.")
        while seconds > 0 and not self._over:
            change = min(seconds, 0.02)  # the speed changes in steps as short as that
            seconds -= change
            wanted = 0.0 if self._reason else 1.0
            most = change / self._brake_s()
            before = self._speed
            self._speed += float(np.clip(wanted - self._speed, -most, most))
            self._advance(change * (before + self._speed) / 2)

    def _advance(self, seconds: float) -> None:
        self._time_s += seconds
        while not self._over and self._time_s >= self._stage.seconds:
            if self._number + 1 == len(self._motions.stages):
                self._number, self._time_s = self._number + 1, self._stage.seconds
                return
            self._time_s -= self._stage.seconds
            self._number += 1

    def _brake_s(self) -> float:
        """Time in which the motion comes to rest without more than the brake's acceleration."""
        stage = self._stage
        here = int(np.searchsorted(stage.times_s, self._time_s, side="right"))
        around = slice(max(0, here - 3), here + 3)
        times, joints = stage.times_s[around], stage.joints_rad[around]
        if len(times) < 2:
            return _SHORTEST_BRAKE_S
        speed = np.abs(np.diff(joints, axis=0) / np.diff(times)[:, None]).max()
        return max(_SHORTEST_BRAKE_S, float(speed) / _BRAKE_RAD_S2)

    @property
    def _over(self) -> bool:
        return self._number >= len(self._motions.stages)

    @property
    def _stage(self) -> MotionStage:
        return self._motions.stages[min(self._number, len(self._motions.stages) - 1)]
