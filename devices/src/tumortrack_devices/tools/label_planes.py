"""Images of labels beside the poses of a tracked ultrasound probe: outlines of parts, as it moves.

A steady stream tells little more than where the probe was: a plane counts once it is away from the
last one that did. Borders wait for their image's pose, which may come after it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import NoEstimate
from tumortrack.core.evidence import Outline
from tumortrack.core.geometry import Affine, Points, transform_points
from tumortrack.core.ultrasound import PIXEL_MM, part_borders_px
from tumortrack.io.ultrasound_files import read_image_to_probe
from tumortrack.live.poses import PoseBuffer
from tumortrack_devices.igtl.message import ProtocolError, unpack_labels
from tumortrack_devices.tools.tip import Piece

# From the last plane that counts.
_MOVED_MM, _TURNED_COS, _RENEWED_NS = 3.0, np.cos(np.radians(5.0)), 500_000_000
_SOONEST_NS = 100_000_000  # between images that are looked at
# Places of a plane and planes in one frame: the fit keeps 200 places, and takes longer with each.
_MOST_PLACES, _MOST_WAITING = 24, 5


class LabelPlanes:
    """Of one probe. ``parts``: of labels 1, 2, 3, ...; ``part``: of all that is not 0 instead.
    ``axes``: from those that are sent; ``image_to_probe``: None: IMAGEs state their pose
    themselves. Raises InputError: there is no such file, or no matrix in it."""

    def __init__(
        self, parts: Sequence[str], part: str, axes: Affine, image_to_probe: Path | None
    ) -> None:
        self._parts = {1: part} if part else dict(enumerate(parts, start=1))
        self._one, self._axes = bool(part), axes
        self._probe_from_image = image_to_probe and read_image_to_probe(image_to_probe)
        # When; to the probe, or the published frame, from (column, row, 0); and borders there.
        self._waiting = deque[tuple[int, Affine, dict[str, Points]]](maxlen=_MOST_WAITING)
        self._heard_ns, self._last = -_SOONEST_NS, (-_RENEWED_NS, axes)  # a plane that counts

    def hear(self, stamp_ns: int, content: bytes) -> None:
        """An IMAGE, in the link's thread. Raises ProtocolError: it is not read, a label is no part,
        or pixels have no such size."""
        if abs(stamp_ns - self._heard_ns) < _SOONEST_NS:
            return
        self._heard_ns, (labels, from_pixel, lps) = stamp_ns, unpack_labels(content)
        labels = labels != 0 if self._one else labels
        if not 0 <= labels.min() <= labels.max() <= len(self._parts):
            names = ", ".join(f"{number} {name}" for number, name in self._parts.items())
            raise ProtocolError(
                f"an IMAGE has the label {labels.max()}. Allowed: 0, {names}; with part= any."
            )
        if self._probe_from_image is not None:
            from_pixel = self._axes @ self._probe_from_image @ from_pixel
        elif not lps:
            from_pixel = self._axes @ from_pixel
        across, down = np.linalg.norm(from_pixel[:3, :2], axis=0).tolist()
        if not PIXEL_MM[0] <= min(across, down) <= max(across, down) <= PIXEL_MM[1]:
            raise ProtocolError(f"an IMAGE has pixels of {across:.4g} x {down:.4g} mm.")
        borders = part_borders_px(labels.astype(np.uint8), self._parts, (across, down))
        places_mm, most = {}, max(_MOST_PLACES // max(len(borders), 1), 1)
        for part, border in borders.items():
            if count := min(len(border), most):
                some = border[np.linspace(0, len(border) - 1, count).round().astype(int)]
                places_mm[part] = transform_points(from_pixel, np.pad(some, ((0, 0), (0, 1))))
        if places_mm:
            self._waiting.append((stamp_ns, from_pixel, places_mm))

    def pieces(self, poses: PoseBuffer, lag_ns: int) -> Iterator[Piece]:
        """Outlines that have a pose by now and did not before, in the loop's thread. Raises
        NoEstimate: one never will; the next call goes on."""
        while self._waiting:
            stamp_ns, pose, places_mm = waiting = self._waiting.popleft()
            published_from_probe = np.eye(4)
            try:
                if self._probe_from_image is not None:
                    published_from_probe = poses.at(stamp_ns - lag_ns)
            except NoEstimate as error:
                late = error.finding is not None and error.finding.kind in ("no_pose", "old_pose")
                if late and len(self._waiting) < _MOST_WAITING - 1:  # it may come yet
                    return self._waiting.appendleft(waiting)
                raise
            pose, (last_ns, last) = published_from_probe @ pose, self._last
            cosines = (_directions(last) * _directions(pose)).sum(0)
            near = cosines.min() > _TURNED_COS and np.linalg.norm((pose - last)[:3, 3]) < _MOVED_MM
            if near and abs(stamp_ns - last_ns) < _RENEWED_NS:
                continue
            self._last = stamp_ns, pose
            for part, places in places_mm.items():
                placed = transform_points(published_from_probe, places)
                yield Piece(Outline, placed, {"part": part}, stamp_ns - lag_ns)


def _directions(pose: Affine) -> Float[np.ndarray, "3 2"]:
    return pose[:3, :2] / np.linalg.norm(pose[:3, :2], axis=0)
