"""Frames that all differ, and recordings of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from live_objects import STAMP_NS, small_frame, small_setting, small_update
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live import values as live
from tumortrack.live.sinks.recording import RecordingSinkConfig as RecordTo
from tumortrack.live.values import Observation

PERIOD_NS = 40_000_000


def frame_number(n: int) -> DepthFrame:
    """All frames differ."""
    frame = small_frame(STAMP_NS + n * PERIOD_NS)
    return replace(frame, depth_mm=frame.depth_mm + np.float32(0.1 * n))


def update_number(
    n: int, content: DepthFrame | SensorCloud | None = None, **seen
) -> live.TrackingResult:
    content = frame_number(n) if content is None else content
    update = small_update(n, content.stamp_ns)
    return replace(update, observation=Observation(content, content.stamp_ns + 2_000_000, **seen))


def record(path: Path, updates: list[live.TrackingResult], **options) -> Path:
    sink = RecordTo(path=path, **options).open(small_setting())
    for update in updates:
        sink.publish(update)
    sink.close()
    sink.close()
    return path
