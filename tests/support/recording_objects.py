"""Frames that all differ, and recordings of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from live_objects import STAMP_NS, small_frame, small_setting, small_update
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live import values as live
from tumortrack.live.values import Observation, SourceEnded
from tumortrack_devices.ros.messages import Messages
from tumortrack_devices.ros.sensors import messages_seen
from tumortrack_devices.sinks.recording import RecordingSinkConfig as RecordTo
from tumortrack_devices.sources.recording import RecordingSourceConfig

PERIOD_NS = 40_000_000


def frame_number(n: int) -> DepthFrame:
    """All frames differ."""
    frame = small_frame(STAMP_NS + n * PERIOD_NS)
    return replace(frame, depth_mm=frame.depth_mm + np.float32(0.1 * n))


def update_number(
    n: int, content: DepthFrame | SensorCloud | None = None, **more: Any
) -> live.TrackingResult:
    content = frame_number(n) if content is None else content
    update = small_update(n, content.stamp_ns)
    return replace(update, observation=Observation(content, content.stamp_ns + 2_000_000, **more))


def record(path: Path, updates: list[live.TrackingResult], **options: Any) -> Path:
    sink = RecordTo(path=path, **options).open(small_setting())
    for update in updates:
        sink.publish(update)
    sink.close()
    sink.close()
    return path


def write_bag(path: Path, topics: dict[str, tuple[str, list[Any]]], kind: str) -> Path:
    """A foreign bag: per topic messages' suffix in ``messages_seen`` and frames."""
    messages = Messages("noetic" if kind == "bag" else "humble")
    plugin = StoragePlugin.MCAP if "mcap" in kind else StoragePlugin.SQLITE3
    writer = Writer1(path) if kind == "bag" else Writer(path, version=8, storage_plugin=plugin)
    if kind.startswith("packed"):
        mode = CompressionMode.STORAGE if "mcap" in kind else CompressionMode.MESSAGE
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        rows = [
            (content.stamp_ns, topic, out)
            for topic, (suffix, contents) in topics.items()
            for content in contents
            for out in messages_seen(Observation(content, 0), messages)
            if out.suffix == suffix
        ]
        for stamp_ns, topic, out in sorted(rows, key=lambda row: row[:2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, out.message_type, typestore=messages.store
                )
            writer.write(connections[topic], stamp_ns, messages.to_bytes(out.message))
    return path


def play(path: Path, **options: Any) -> list[Observation | InputError]:
    """Everything to the end, errors in their place."""
    source = RecordingSourceConfig(path=path, **({"rate": 0} | options)).open()
    got: list[Observation | InputError] = []
    try:
        while True:
            try:
                seen = source.read(0.2)
            except InputError as error:
                seen = error
            if seen is not None:
                got.append(seen)
    except SourceEnded:
        return got
    finally:
        source.close()
        source.close()
