"""What is written about an update, besides its points and surfaces."""

from __future__ import annotations

import numpy as np

import tumortrack
from tumortrack.core.types import SensorCloud
from tumortrack.live.ros.observed import CAMERA_FRAME
from tumortrack.live.values import PublishedFrame, TrackingResult

KIND = "recording"


def facts(update: TrackingResult) -> dict:
    """One line about an update (JSON types)."""
    seen = None
    if update.seen is not None:
        seen = "cloud" if isinstance(update.seen.content, SensorCloud) else "depth"
    return {
        "sequence": update.sequence,
        "stamp_ns": update.stamp_ns,
        "arrived_ns": None if update.seen is None else update.seen.arrived_ns,
        "seen": seen,
        "quality": update.quality,
        "reason": update.reason,
        "warning": update.warning,
        "latency_ms": update.latency_ms,
    }


def report(update: TrackingResult) -> dict:
    """Everything about an update: its facts, times of stages, and the estimate's own report, or
    null with the reason."""
    return {
        **facts(update),
        "organ_points": None if update.organ is None else len(update.organ.points_mm),
        "seconds": dict(update.seconds),
        "estimate": None if update.estimate is None else update.estimate.report,
    }


def about(form: str, parts: tuple[str, ...], frames: PublishedFrame) -> dict:
    """What a recording is: recording.json."""
    return {
        "kind": KIND,
        "tumortrack": tumortrack.__version__,
        "format": form,
        "parts": list(parts),
        "frame_id": frames.frame_id,
        "published_from_camera": frames.published_from_camera.tolist(),
        # Plain files lie beside their depth images; messages are as they were published.
        "estimate_frame": "camera" if form == "files" else frames.frame_id,
    }


def camera_frame(frames: PublishedFrame) -> str:
    """The name of the camera's frame: the published one's where it is the same."""
    if np.array_equal(frames.published_from_camera, np.eye(4)):
        return frames.frame_id
    return CAMERA_FRAME if frames.frame_id != CAMERA_FRAME else f"{CAMERA_FRAME}_optical"
