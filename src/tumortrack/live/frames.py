"""Whether a frame shows something new, and comes from the camera that the run began with."""

from __future__ import annotations

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud

Content = DepthFrame | SensorCloud


class FrameCheck:
    """Refuses images that repeat and intrinsics that change.

    A sensor's noise never repeats bit for bit: an image that does is an old one, whatever its
    stamp says. A camera that is replaced, zoomed or set to another mode in between may stand
    elsewhere too, so its frames are refused until the run is started again.
    """

    def __init__(self, frozen_s: float) -> None:
        self._frozen_s = frozen_s
        self._values: np.ndarray | None = None
        self._since_ns = 0
        self._camera: Intrinsics | None = None

    def same_camera(self, content: Content) -> None:
        """Raises NoEstimate for other intrinsics than the first frame had."""
        if not isinstance(content, DepthFrame):
            return
        self._camera = self._camera or content.intrinsics
        if content.intrinsics != self._camera:
            raise NoEstimate(
                f"the camera's intrinsics changed from {_text(self._camera)} to "
                f"{_text(content.intrinsics)}. If that is meant, start again."
            )

    def new(self, content: Content) -> None:
        """Raises NoEstimate where the same image has been coming for too long."""
        values = content.depth_mm if isinstance(content, DepthFrame) else content.points_mm
        if self._values is None or not _same(values, self._values):
            self._values, self._since_ns = values, content.stamp_ns
            return
        same_s = (content.stamp_ns - self._since_ns) * 1e-9
        if 0 < self._frozen_s <= same_s:
            raise NoEstimate(
                f"the source is frozen: the same image for {same_s:.2f} s. Look at the camera; a "
                "simulated one without noise needs --frozen 0."
            )


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    """Bit for bit: no return (NaN) is equal to itself."""
    if one is other:
        return True
    return one.shape == other.shape and bool(np.array_equal(one.view("u4"), other.view("u4")))


def _text(camera: Intrinsics) -> str:
    size, center = f"{camera.width} x {camera.height}", f"({camera.cx:g}, {camera.cy:g})"
    return f"{size} (f {camera.fx:g}, {camera.fy:g}, centre {center})"
