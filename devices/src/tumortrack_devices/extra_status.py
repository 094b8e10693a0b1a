"""What to touch next, and what is known beside the clouds, for sinks: published frame, mm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import FREE
from tumortrack.core.geometry import Points, transform_points
from tumortrack.core.report import FAR_OFF, NextEvidence
from tumortrack.live.values import TrackingResult

_SHOWN_S = 3.0  # what contradicts the rest is dropped after one frame: too short to be seen
_NOWHERE = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class NextTouch:
    """A place on the organ's surface. ``label``: its rank, and one standard deviation of the
    tumor's middle along its least sure axis now and then; ``words``: the same in a sentence."""

    place_mm: Float64[np.ndarray, " 3"]
    label: str
    message: str


class ExtraStatus:
    """Of one sink, which gives every result to ``update``: few bring advice, and in between the
    places move with the organ.

    Attributes:
        touches: the best ones, each after those before it. None without an estimate, or of one
            that may have the organ somewhere else.
        known_mm: where evidence in use lies by now; places without tissue are left out.
        contradicting_mm: where evidence lay that was left out in the last seconds.
    """

    def __init__(self) -> None:
        self.touches: tuple[NextTouch, ...] = ()
        self.known_mm, self.contradicting_mm = _NOWHERE, _NOWHERE
        self._advice: list[NextEvidence] = []
        self._points_ct = _NOWHERE  # of the advice
        self._left_out: list[tuple[int, Points]] = []  # stamps (ns) and places

    def update(self, result: TrackingResult) -> None:
        """To what is known by now."""
        estimate, pose = result.estimate, result.published_frame.published_from_camera
        told = () if estimate is None else estimate.report.evidence
        used = [p for e in told if not e.rejected and e.name != FREE for p in e.places_mm]
        self.known_mm = transform_points(pose, np.reshape(used, (-1, 3)))
        out = [place for each in told if each.rejected for place in each.places_mm]
        self._left_out.append((result.stamp_ns, transform_points(pose, np.reshape(out, (-1, 3)))))
        recent = [
            (stamp_ns, places_mm)
            for stamp_ns, places_mm in self._left_out
            if estimate is not None
            and len(places_mm)
            and 0 <= result.stamp_ns - stamp_ns <= _SHOWN_S * 1e9
        ]
        self._left_out = recent
        self.contradicting_mm = np.concatenate([_NOWHERE, *(places for _, places in recent)])
        self.touches = self._touches(estimate if _placed(result) else None, pose)

    def _touches(self, estimate: Estimate | None, pose: np.ndarray) -> tuple[NextTouch, ...]:
        motion = None if estimate is None else estimate.motion
        if estimate is None or motion is None:
            self._advice = []
            return ()
        if new := [each for each in estimate.assessment.next_evidence if each.kind == "touch"]:
            points_ct = motion.inverse(np.array([each.place_mm for each in new]))
            if points_ct is not None:
                self._advice, self._points_ct = new, points_ct
        if not self._advice:
            return ()
        places_mm = transform_points(pose, motion.forward(self._points_ct))
        touches = []
        for rank, (advice, place_mm) in enumerate(zip(self._advice, places_mm, strict=True), 1):
            falls = f"{advice.bound_mm:.1f} -> {advice.then_bound_mm:.1f} mm"
            x, y, z = place_mm
            words = f"touch the organ at {x:.0f}, {y:.0f}, {z:.0f} mm: {advice.part} {falls}"
            touches.append(NextTouch(place_mm, f"{rank}: {falls}", words))
        return tuple(touches)


def _placed(result: TrackingResult) -> bool:
    """Whether the organ lies there: else no place on it is worth touching."""
    return result.quality == "good" or (
        result.finding is not None and result.finding.kind in FAR_OFF
    )
