"""What the energised electrode has swept, as evidence of where the organ is cut."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from tumortrack.core.evidence import Cut, Evidence
from tumortrack.core.geometry import Affine, swept_places, transform_points
from tumortrack.live.values import TrackingResult
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.motions import CUTTER, Execution, Joints

Line = Float64[np.ndarray, "2 3"]  # tip and rear end of the bare electrode's axis, mm
_APART_MM = 1.0  # between places


class Swept:
    """All of an electrode's bare length cuts. ``line_mm``: from both arms' joints to its axis,
    published frame. ``budget``: its bounds count as three standard deviations. Each place comes
    once, with the next frame."""

    def __init__(
        self, line_mm: Callable[[Joints], Line], radius_mm: float, budget: ErrorBudget
    ) -> None:
        self._line_mm, self._kerf_mm = line_mm, 2 * radius_mm
        self._std_mm, self._shared_std_mm = budget.tool_mm / 3, budget.hand_eye_mm / 3
        self._ways = list[list[Line]]()  # without a break, since the last frame
        self._cutting = self._more = False

    def update(self, execution: Execution, result: TrackingResult) -> None:
        """Called with every result, once the arms have moved on."""
        before, self._cutting = self._cutting, execution.cutting
        if not self._cutting:
            return
        line = self._line_mm(execution.joints_rad)
        if not before:
            self._ways.append([])
        way = self._ways[-1]
        if not way or np.linalg.norm(line - way[-1], axis=1).max() >= _APART_MM:
            way.append(line)
            self._more = True

    def evidence(self, camera_from_published: Affine, stamp_ns: int) -> tuple[Evidence, ...]:
        """Of a frame, in its camera's frame; empty where nothing more was cut."""
        if not self._more:
            return ()
        swept = [swept_places(np.array(way), _APART_MM) for way in self._ways]
        self._ways, self._more = [self._ways[-1][-1:]] * self._cutting, False
        places_mm = transform_points(camera_from_published, np.concatenate(swept))
        told = Cut(
            places_mm=tuple(map(tuple, places_mm.tolist())), kerf_mm=self._kerf_mm,
            std_mm=self._std_mm, shared_std_mm=self._shared_std_mm, stamp_ns=stamp_ns, tool=CUTTER,
        )  # fmt: skip
        return (told,)
