"""What the holder's cup has hold of, as evidence of where the organ is."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from tumortrack.core.evidence import Evidence, Grasp
from tumortrack.core.geometry import Affine, transform_points
from tumortrack.live.values import TrackingResult
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.motions import ARMS, HOLDER, Execution, Joints

Place = Float64[np.ndarray, " 3"]


class _Taken(NamedTuple):
    point_ct: tuple[float, float, float]
    std_mm: float


class Grip:
    """From the end of the stage hold until the piece is lifted, the holder's tip is where one
    point of the CT is: the one that the last good estimate before had where the cup gripped.
    ``tip_mm``: from an arm's name and its six joints to its tip. ``std_mm``: of the tip's way
    since then, along any axis. ``pulled_mm``: how far the holder has moved; other threads may
    read it."""

    def __init__(
        self, tip_mm: Callable[[str, Float64[np.ndarray, " 6"]], Place], std_mm: float
    ) -> None:
        self._of_arm, self._std_mm = tip_mm, std_mm
        self._before: TrackingResult | None = None  # the last good one before it gripped
        self._taken: _Taken | None = None
        self._tip_mm: Place | None = None  # now
        self._step_mm = 0.0  # since the last update: a frame is not as old as that
        self.pulled_mm = 0.0

    def update(self, execution: Execution, result: TrackingResult) -> None:
        """Called with every result, once the arms have moved on."""
        if not execution.grips:
            self._taken, self._tip_mm, self.pulled_mm = None, None, 0.0
            self._before = result if result.quality == "good" else self._before
            return
        if execution.gripped_rad is None:  # the first motions begin with what is held
            return
        tip_mm, gripped_mm = map(self._place, (execution.joints_rad, execution.gripped_rad))
        last_mm = gripped_mm if self._tip_mm is None else self._tip_mm
        self._tip_mm, self._step_mm = tip_mm, float(np.linalg.norm(tip_mm - last_mm))
        self.pulled_mm = float(np.linalg.norm(tip_mm - gripped_mm))
        if self._taken is None and self._before is not None:
            self._taken = _point_at(gripped_mm, self._before)

    def evidence(self, camera_from_published: Affine, stamp_ns: int) -> tuple[Evidence, ...]:
        """Of a frame, in its camera's frame; empty unless it grips."""
        if self._taken is None or self._tip_mm is None:
            return ()
        tip_mm = transform_points(camera_from_published, self._tip_mm[None])[0]
        held = Grasp(
            point_ct=self._taken.point_ct, point_std_mm=self._taken.std_mm,
            place_mm=tuple(tip_mm.tolist()), std_mm=math.hypot(self._std_mm, self._step_mm),
            stamp_ns=stamp_ns, tool=HOLDER,
        )  # fmt: skip
        return (held,)

    def _place(self, joints_rad: Joints) -> Place:
        return self._of_arm(HOLDER, joints_rad[6 * ARMS.index(HOLDER) :][:6])


def held_std_mm(budget: ErrorBudget) -> float:
    """The tool's bound counts as three standard deviations of the holder's way. The hand-eye
    calibration's error is in both ends of the way alike."""
    return budget.tool_mm / 3


def _point_at(tip_mm: Place, result: TrackingResult) -> _Taken | None:
    """The point of the CT that an estimate has there; None: it knows no motion."""
    motion = None if result.estimate is None else result.estimate.motion
    if motion is None:
        return None
    camera_from_published = np.linalg.inv(result.published_frame.published_from_camera)
    point_ct = motion.inverse(transform_points(camera_from_published, tip_mm[None]))
    if point_ct is None or (std_mm := motion.std_mm(point_ct)) is None:
        return None
    return _Taken(tuple(point_ct[0].tolist()), float(std_mm[0]))
