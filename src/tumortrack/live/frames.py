"""Whether frames are of the camera that results are placed by: by the names of frames, and by a
table that stands still."""

from __future__ import annotations

from tumortrack.core.errors import NoEstimate
from tumortrack.live.values import Observation, PublishedFrame
from tumortrack.sense.region.picture import RegionConfig
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
    """Of one run. ``notes``: what nobody can check, said once each, as it turns out. The table is
    watched only where places depend on where the camera stands: in the frame of a calibration."""

    def __init__(self, published: PublishedFrame, config: RegionConfig) -> None:
        self._published = published
        self._name: str | None = None  # of the first frame
        self.watch = TableWatch(config, published.table_in_camera) if published.calibrated else None
        self.notes: list[str] = []
        if published.calibrated and not published.camera_frame_id:
            self.notes.append(UNNAMED)

    def check(self, seen: Observation) -> str:
        """A doubt about this frame, or nothing. Raises NoEstimate for a frame of another camera
        than the calibration or the first frame was of, and once camera or table have moved."""
        name, wanted = seen.frame_id, self._published.camera_frame_id
        if self._name is None:
            self._name = name
            if wanted and not name:
                self.notes.append(_NAMELESS)
        if wanted and name and name != wanted:
            raise NoEstimate(
                f"the frame is in {name!r}, and the calibration is for {wanted!r}. Give the "
                "calibration of this camera, or its camera's topic"
            )
        if name != self._name:
            raise NoEstimate(
                f"the source's frame changed from {self._name!r} to {name!r}: another camera, or "
                "another setting of it. Restart to accept it"
            )
        if self.watch is None:
            return ""
        doubt = self.watch.check(seen.content)
        self._note(_SLIDING, self.watch.table_in_camera is not None)
        self._note(_BLIND, self.watch.blind)
        return doubt

    def _note(self, note: str, now: bool) -> None:
        if now and note not in self.notes:
            self.notes.append(note)
