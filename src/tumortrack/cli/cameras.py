"""The cameras of `track`: their sources, and where they are."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import HERE, Affine

if TYPE_CHECKING:
    from tumortrack.live.cameras import Cameras
    from tumortrack.live.poses import CameraPoses
    from tumortrack.live.values import PublishedFrame, SourceConfig


@dataclass(frozen=True, eq=False)
class CameraSetup:
    """``published``: the frame of results; ``sources`` by what they are called; ``still``: where
    several cameras stand in that frame; ``poses``: of one that moves; ``about``: for a report."""

    published: PublishedFrame
    sources: dict[str, SourceConfig]
    still: tuple[Affine, ...] = ()
    poses: CameraPoses | None = None
    about: dict[str, Any] = field(default_factory=dict)

    def open(self, stale_s: float) -> Cameras:
        """All sources begin to be read."""
        from tumortrack.live.cameras import Cameras
        from tumortrack.live.workers import SourceWorker

        workers = [SourceWorker(source.open) for source in self.sources.values()]
        places = self.still or (self.published.published_from_camera,)
        return Cameras(workers, self.poses or places, stale_s)


def camera_setup(
    source: str, views: tuple[str, ...], poses: Path | None, moving: str, frame: Path | None
) -> CameraSetup:
    """As the options of `track` say it. Raises InputError: they do not go together."""
    import numpy as np

    from tumortrack.live.calibration_file import read_frames
    from tumortrack.live.poses import ToolPoses
    from tumortrack.live.spec import POSES, SOURCES
    from tumortrack.live.values import PublishedFrame
    from tumortrack.sense.files import read_poses

    texts = source, *views
    if len(set(texts)) < len(texts) or bool(views) != (poses is not None) or (views and moving):
        raise InputError(
            "--views needs --poses FILE, each source once, and no --moving; --poses needs --views."
        )
    sources = {text: SOURCES.parse(text) for text in texts}
    if moving:
        published = read_frames(frame, moves=True) if frame else None
        where: CameraPoses = POSES.parse(moving).open()
        if published is None:
            published = PublishedFrame(where.frame_id, calibrated=True, moves=True)
        elif where.frame_id not in ("", published.frame_id):
            raise InputError(
                f"--moving gives poses in {where.frame_id!r}, and {frame} is of "
                f"{published.frame_id!r}; they must be of one frame."
            )
        else:
            where = ToolPoses(where, published.published_from_camera)
            published = published.of_camera(HERE)
        return CameraSetup(published, sources, poses=where, about={"moving": moving})
    published = read_frames(frame) if frame else PublishedFrame()
    if poses is None:
        return CameraSetup(published, sources)
    frame_id, places = read_poses(poses, len(texts))
    if frame is None:
        published = PublishedFrame(frame_id, places[0], calibrated=True)
    published_from_fixed = published.published_from_camera @ np.linalg.inv(places[0])
    places = (published.published_from_camera, *(published_from_fixed @ p for p in places[1:]))
    about = {
        "views": list(views),
        "poses_sha256": store.sha256_of(poses),
        "published_from_cameras": [place.tolist() for place in places],
    }
    return CameraSetup(published, sources, places, about=about)
