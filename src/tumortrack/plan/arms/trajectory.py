"""Motions as they come about: piece after piece, stage after stage."""

from __future__ import annotations

from collections.abc import Collection
from copy import copy

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.arms import timing
from tumortrack.plan.arms.cell import ArmCell
from tumortrack.plan.arms.situation import Situation
from tumortrack.plan.arms.tracks import follow
from tumortrack.plan.motions import Motions, MotionStage

_THERE_RAD = 1e-6  # a thousandth of a millimetre at the tip: no motion to be timed


class TrajectoryBuilder:
    """Where both arms are by now (``joints_rad``), and how they came there."""

    def __init__(
        self, cell: ArmCell, start_rad: Float64[np.ndarray, " 12"], rng: np.random.Generator
    ) -> None:
        self.cell, self.joints_rad, self.rng = cell, start_rad, rng
        self._stages: tuple[MotionStage, ...] = ()
        self._pieces: tuple[tuple[np.ndarray, np.ndarray, bool], ...] = ()

    def copy(self) -> TrajectoryBuilder:
        """The same so far; what is added to either is not in the other."""
        return copy(self)

    def situation(self, arm: str | None, touching: Collection[str] = ()) -> Situation:
        """This arm (None: both) moves from here."""
        return Situation(self.cell, arm, self.joints_rad, touching)

    def go(
        self,
        arm: str,
        path_rad: Float64[np.ndarray, "m 6"],
        tip_mm_s: float | None = None,
        cutting: bool = False,
    ) -> None:
        """One arm along a path that begins where it is; its tip no faster than said."""
        situation = self.situation(arm)
        if np.ptp(path_rad, axis=0).max() < _THERE_RAD:
            return
        speeds = self.cell.speeds_rad_s[situation.own]
        if tip_mm_s is None:
            times, own = timing.along(path_rad, speeds)
        else:
            tips = [self.cell.tips(situation.whole(joints))[arm][:3, 3] for joints in path_rad]
            times, own = timing.along(path_rad, speeds, np.array(tips), tip_mm_s)
        joints = np.repeat(self.joints_rad[None], len(times), axis=0)
        joints[:, situation.own] = own
        self.add((times, joints), cutting)

    def follow(self, arm: str, poses: Float64[np.ndarray, "n 4 4"], tip_mm_s: float) -> None:
        """One arm's tip along poses that begin where it is, on or in the organ or not.

        Raises:
            Blocked: as ``tracks.follow``.
        """
        situation = self.situation(arm, ("cutter", "holder"))
        self.go(arm, follow(situation, poses), tip_mm_s)

    def still(self, seconds: float) -> None:
        self.add((np.array([0.0, seconds]), np.repeat(self.joints_rad[None], 2, axis=0)))

    def add(self, timed: timing.Timed, cutting: bool = False) -> None:
        """All twelve joints (n, 12) over time, from where they are."""
        times, joints = timed
        joints[0] = self.joints_rad
        self._pieces += ((times, joints, cutting),)
        self.joints_rad = joints[-1]

    def close(self, name: str) -> None:
        """What was added since the last stage is the stage of this name."""
        times, joints = (
            [np.zeros(1)],
            [self._pieces[0][1][:1] if self._pieces else self.joints_rad[None]],
        )
        cutting = [np.array([bool(self._pieces) and self._pieces[0][2]])]
        for piece_times, piece_joints, cuts in self._pieces:
            cutting[-1][-1] |= cuts  # a corner between way in and cut is on the cut
            times.append(times[-1][-1] + piece_times[1:])
            joints.append(piece_joints[1:])
            cutting.append(np.full(len(piece_times) - 1, cuts))
        stage = MotionStage(
            name, np.concatenate(times), np.concatenate(joints), np.concatenate(cutting)
        )
        self._stages += (stage,)
        self._pieces = ()

    def motions(self) -> Motions:
        return Motions(self._stages)
