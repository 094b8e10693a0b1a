"""Checks that a frame is new, and from the calibrated camera at its calibrated pose: by frame name,
intrinsics, and the plane of the table."""

from __future__ import annotations

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.report import Finding
from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.live.values import Observation, PublishedFrame
from tumortrack.sense.region import RegionConfig
from tumortrack.sense.region.watch import TableWatch

UNNAMED = (
    "the calibration names no camera_frame_id: nobody checks that frames come from the camera that "
    "it is for"
)
_NAMELESS = "the source does not say whose frames it sends: nobody checks it"
_BLIND = "no table is seen: nobody notices if the camera moves"
_SLIDING = (
    "the table's plane is watched; a camera that slides along it, or turns about its normal, is "
    "not noticed"
)


class FrameCheck:
    """State of one run. ``notes``: what cannot be checked, once each. The table is watched only if
    results depend on the camera's pose: with a calibration, and a camera that is not meant to move.

    A sensor's noise never repeats bit for bit: an image that does is old, whatever its stamp. A
    camera that was replaced, zoomed or set to another mode may also have another pose, so its
    frames are refused until a restart.
    """

    def __init__(self, published: PublishedFrame, config: RegionConfig, frozen_s: float) -> None:
        self._published, self._frozen_s = published, frozen_s
        self._values: np.ndarray | None = None
        self._since_ns = self._last_ns = 0  # the earliest arrival of this image; the last frame
        self._camera: Intrinsics | None = None
        self._first: Observation | None = None
        watched = published.calibrated and not published.moves
        self.watch = TableWatch(config, published.table_in_camera) if watched else None
        self.notes: list[str] = []
        if published.calibrated and not published.camera_frame_id:
            self.notes.append(UNNAMED)

    def check(self, seen: Observation) -> str:
        """A doubt about this frame, or an empty text. Raises NoEstimate if its camera is not that
        of the calibration and of the first frame, and once camera or table have moved."""
        name, wanted = seen.frame_id, self._published.camera_frame_id
        self._first = self._first or seen
        first = self._first.frame_id
        self._note(_NAMELESS, bool(wanted) and first is None)
        if wanted and name not in (None, wanted):
            raise NoEstimate(Finding("other_frame_id", {"name": name, "wanted": wanted}))
        if name != first:
            raise NoEstimate(Finding("frame_id_changed", {"first": first, "name": name}))
        if isinstance(seen.content, DepthFrame):
            camera = seen.content.intrinsics
            self._camera = self._camera or camera
            if camera != self._camera:
                values = {"before": _text(self._camera), "now": _text(camera)}
                raise NoEstimate(Finding("intrinsics_changed", values))
        if self.watch is None:
            return ""
        doubt = self.watch.check(seen.content)
        self._note(_SLIDING, self.watch.table_in_camera is not None)
        self._note(_BLIND, self.watch.blind)
        return doubt

    def check_new(self, content: DepthFrame | SensorCloud) -> None:
        """Raises NoEstimate if the same image has been repeated for too long."""
        values = content.depth_mm if isinstance(content, DepthFrame) else content.points_mm
        before_ns, self._last_ns = self._last_ns, content.stamp_ns
        if self._values is None or not _same(values, self._values):
            # It may have come right after the frame taken last: others were dropped.
            self._since_ns = content.stamp_ns if self._values is None else before_ns
            self._values = values
            return
        same_s = (content.stamp_ns - self._since_ns) * 1e-9
        if 0 < self._frozen_s <= same_s:
            raise NoEstimate(Finding("frozen", {"seconds": same_s}))

    def _note(self, note: str, now: bool) -> None:
        if now and note not in self.notes:
            self.notes.append(note)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Bit for bit: NaN (no return) equals itself."""
    return a is b or (a.shape == b.shape and bool(np.array_equal(a.view("u4"), b.view("u4"))))


def _text(camera: Intrinsics) -> str:
    size, center = f"{camera.width} x {camera.height}", f"({camera.cx:g}, {camera.cy:g})"
    return f"{size} (f {camera.fx:g}, {camera.fy:g}, centre {center})"
