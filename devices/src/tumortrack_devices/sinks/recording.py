"""Recordings of observations and results: a rosbag2 folder (MCAP) for the source ``recording``,
`ros2 bag play` and Foxglove, written by rosbags."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from typing import Any, ClassVar

import tumortrack
from tumortrack.core.config import to_builtins
from tumortrack.core.store import write_json, writing
from tumortrack.core.types import SensorCloud
from tumortrack.io.csv_tables import COLUMNS
from tumortrack.io.run_folder import report_entry
from tumortrack.live.poses import pose_row
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.recording.folders import ABOUT
from tumortrack_devices.recording.mcap import STRING, McapBag, camera_messages, evidence_message
from tumortrack_devices.ros.messages import Messages, Outgoing
from tumortrack_devices.ros.results import ResultMessages

POSES, STILL = "poses.csv", "poses.json"  # of a moving camera; of several fixed ones
_ON_FULL_DISK = (
    "The recording ends up to 1 MiB before; it can be played with recording:FOLDER, and "
    "`mcap recover` makes it whole for others."
)


class RecordingSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="recording"):
    """A new folder with every result and observation: depth images as 32FC1 in metres (float32 to
    1e-5 mm), stamps exact. ``meshes_hz``: limit for surfaces; 0: with every result. ``compressed``:
    without loss (zstd), to about a third; that takes a good part of a core from the tracker."""

    target: ClassVar[str] = "path"
    queue_size: ClassVar[int] = 30

    path: Path
    meshes_hz: float = 2.0
    compressed: bool = False

    def __post_init__(self) -> None:
        self.check_between("recording:", meshes_hz=(0, 1000))

    def made_path(self) -> Path:
        return self.path

    def open(self, context: SinkContext) -> RecordingSink:
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            sink = RecordingSink(self, context)
        frame = context.published_frame
        about = {
            "kind": "recording",
            "tumortrack": tumortrack.__version__,
            "patient": to_builtins(context.patient),
            "parts": list(context.parts),
            "corrected": context.corrected,
            "frame_id": frame.frame_id,
            "published_from_camera": frame.published_from_camera.tolist(),
        }
        write_json(self.path / ABOUT, about)
        if context.cameras:
            rows = [pose.tolist() for pose in context.cameras]
            fixed = {"unit": "mm", "frame_id": frame.frame_id, "fixed_from_camera": rows}
            write_json(self.path / STILL, fixed)
        return sink


class RecordingSink:
    """Topics: ``/camera/...`` observations in the camera's frame, of further cameras
    ``/camera_2/...``; of the one that leads also ``/camera/evidence`` (JSON), what became known
    with the frame; ``/tumortrack/...`` the results as in ROS, and ``report`` (JSON); ``/tf`` where
    the frames differ. For a moving camera also a table of its poses for `track --moving`."""

    def __init__(self, config: RecordingSinkConfig, context: SinkContext) -> None:
        folder, self._messages = config.path, Messages()
        self._results = ResultMessages(self._messages, context, config.meshes_hz, observed=False)
        self._bag = McapBag(folder, self._messages, _ON_FULL_DISK, config.compressed)
        self._poses: io.FileIO | None = None
        if context.published_frame.moves:
            self._poses = io.FileIO(folder / POSES, "a")
            self._poses.write(f"{COLUMNS}\n".encode())

    def publish(self, result: TrackingResult) -> None:
        """Raises StorageError; later results are still tried."""
        seen, frame = result.observation, result.published_frame
        arrived_ns = time.time_ns() if seen is None else seen.arrived_ns
        self._bag.write(arrived_ns, self._messages_of(result))
        if seen is not None and self._poses is not None:
            row = pose_row(result.stamp_ns, frame.frame_id, frame.published_from_camera)
            with writing(Path(self._poses.name)):
                self._poses.write(row.encode())

    def close(self) -> None:
        if self._poses is not None:
            self._poses.close()
        self._bag.close()

    def _messages_of(self, result: TrackingResult) -> list[Outgoing]:
        """With the full names of their topics."""
        make, frame = self._messages.make, result.published_frame
        report = make(STRING, data=json.dumps(_report(result), allow_nan=False))
        results = [*self._results.messages(result), Outgoing("report", STRING, report)]
        out = [message._replace(suffix=message.topic("/tumortrack")) for message in results]
        if result.observation is None:
            return out
        for view in result.camera_views:
            pose = view.published_from_camera, frame.frame_id
            known = view.seen is result.observation and result.evidence
            more = [evidence_message(result, self._messages, view.number)] if known else []
            out = [*camera_messages(view.seen, *pose, self._messages, view.number), *more, *out]
        return out


def _report(result: TrackingResult) -> dict[str, Any]:
    """A result as JSON types: its fields, times of stages, and the estimate's own report, or null
    and the reason."""
    seen = result.observation
    kind = None if seen is None else "cloud" if isinstance(seen.content, SensorCloud) else "depth"
    copied = ("quality", "reason", "warning", "latency_ms", "cameras")
    return {
        "sequence": result.sequence,
        "stamp_ns": result.stamp_ns,
        "arrived_ns": None if seen is None else seen.arrived_ns,
        "seen": kind,
        **{name: getattr(result, name) for name in copied},
        "organ_points": None if result.organ is None else len(result.organ.points_mm),
        "seconds": dict(result.seconds),
        "estimate": None if result.estimate is None else report_entry(result.estimate),
    }
