"""Whether a frame's stamp is valid, and whether a live estimate should be relied on."""

from __future__ import annotations

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.live.values import Quality
from tumortrack.sense.render import render_depth

_AHEAD_S = 0.1  # what two clocks may differ by
_ACCEPTED_AFTER = 3  # frames whose stamps increase: then the clock was set back
_UNSURE_MM = 3.0  # standard deviation of a tumor's middle
# Shares of the organ's picture. Right estimates have up to 0.03 (moving and pushed, on tables, in
# beds and cavities, among instruments and hands), an organ upside down 0.12 to 0.16, one laid on
# the points of a hand 0.2 to 0.4, a model laid on another patient's kidney mostly 0.1 to 0.24.
_LIMITS = 0.05, 0.09  # doubtful, impossible
# Without a motion surfaces are rougher: where centres are 2 to 8 mm off, 0.09 to 0.15 are usual.
_ROUGH_LIMITS = 0.1, 0.2
_WIDTH = 212  # pixels: so coarse a picture tells
_THROUGH_MM = 6.0  # behind the estimated surface: what is seen there lies behind, not beside
_UNSURE = 0.6  # mean probability of a tumor's points


def judge(estimate: Estimate, content: DepthFrame | SensorCloud) -> tuple[Quality, str]:
    """``good``, or ``poor`` and the reason in words, of an estimate from what was seen.

    Poor is an estimate that fits the points worse than usual in validation, through which the
    camera sees, that lacks a tumor, or that says itself that a tumor's place is unsure. Good means
    no more than that none holds. The share that is seen through goes into the estimate's report.

    Raises:
        NoEstimate: the camera sees through so much of it that the organ cannot lie there.
    """
    if isinstance(content, DepthFrame):
        share = seen_through(estimate, content)
        estimate.report["seen_through"] = share
        doubtful, impossible = _LIMITS if estimate.motion is not None else _ROUGH_LIMITS
        if share > impossible:
            raise NoEstimate(
                f"the camera sees through {100 * share:.0f} % of where the organ would lie: what "
                "was taken for it is something else, or lies as no organ in training did."
            )
        if share > doubtful:
            return "poor", f"the camera sees through {100 * share:.0f} % of where the organ lies"
    cost = estimate.report.get("fit_cost")
    if cost is not None and cost["now"] > cost["usual"]:
        return "poor", "the organ's surface fits the points worse than in most validation scenes"
    for name, part in estimate.report["parts"].items():
        if not part["found"]:
            return "poor", f"{name} was not found"
        if part.get("center_std_mm", 0.0) > _UNSURE_MM:
            return "poor", f"the place of {name} is unsure by {part['center_std_mm']:.1f} mm"
        if part["probability"] is not None and part["probability"] < _UNSURE:
            return "poor", f"the points of {name} have a probability of {part['probability']:.2f}"
    return "good", ""


def seen_through(estimate: Estimate, frame: DepthFrame) -> float:
    """The share of the estimated organ's picture behind whose surface the camera sees something,
    a table, say, which it could not see if the organ lay there. Pixels without return, and those
    where something lies before the organ, say nothing. 0 where no pixel says anything."""
    every = max(1, round(frame.intrinsics.width / _WIDTH))
    seen_mm = frame.depth_mm[::every, ::every]
    organ = next(iter(estimate.meshes.values()))
    given = frame.intrinsics
    scaled = (number / every for number in (given.fx, given.fy, given.cx, given.cy))
    few = Intrinsics(*seen_mm.shape[::-1], *scaled)
    organ_mm = render_depth(organ.vertices_mm, organ.faces, few).depth_mm
    both = np.isfinite(organ_mm) & np.isfinite(seen_mm)
    if not both.any():
        return 0.0
    return float((seen_mm[both] > organ_mm[both] + _THROUGH_MM).mean())


class StampCheck:
    """Refuses stale frames, and stamps that go back unless the clock was set back."""

    def __init__(self, stale_s: float) -> None:
        self._stale_s = stale_s
        self._last_ns = -1
        self._behind: list[int] = []

    def check(self, stamp_ns: int, age_s: float, other_clock: bool = True) -> bool:
        """True if the clock was set back. ``age_s``: how long ago the frame was made, or came, as
        far as is known; ``other_clock``: by a camera's clock against this computer's. Raises
        NoEstimate for a frame that is stale or out of order."""
        clocks = "the clocks of camera and computer"
        if age_s > self._stale_s:
            doubt = f", if {clocks} agree" if other_clock else ""
            raise NoEstimate(f"the frame is stale: {age_s:.2f} s old{doubt}")
        if age_s < -_AHEAD_S:
            raise NoEstimate(
                f"the frame's stamp lies {-age_s:.2f} s in the future: {clocks} disagree"
            )
        if stamp_ns < 0:
            raise NoEstimate(f"the frame's stamp is {stamp_ns} ns; it must be 0 or more")
        back_ns = self._last_ns - stamp_ns
        if back_ns >= 0:
            grows = not self._behind or stamp_ns > self._behind[-1]
            self._behind = [*self._behind, stamp_ns] if grows else [stamp_ns]
            if len(self._behind) < _ACCEPTED_AFTER:
                raise NoEstimate(f"the frame's stamp went back by {back_ns * 1e-9:.3f} s")
        self._last_ns, self._behind = stamp_ns, []
        return back_ns >= 0
