"""Updates into a rosbag2 folder (MCAP), as `ros2 bag play` and Foxglove read it, by rosbags."""

from __future__ import annotations

import io
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import StorageError
from tumortrack.live.meter import Rate
from tumortrack.live.recording.frame_folders import report
from tumortrack.live.ros.messages import MM_PER_M, Messages, Outgoing, xyz
from tumortrack.live.ros.results import messages_of
from tumortrack.live.ros.sensors import CAMERA_FRAME, messages_seen
from tumortrack.live.ros.workcell import WorkcellMessages
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult

# A killed program loses what is in no chunk yet.
_CHUNK_S = 0.5


class McapFile:
    """Topics: ``/camera/...`` what the source saw, in the camera's frame; ``/tumortrack/...`` the
    estimates and what arms do, and ``/tumortrack/report`` (JSON); ``/tf`` where the two frames
    differ.

    Messages are filed under their time of arrival, which never goes back; headers have the stamps.

    Raises:
        StorageError: the disk refused. Whole chunks stay, in a file without an end.
    """

    def __init__(self, folder: Path, context: SinkContext, frames: bool, meshes_hz: float) -> None:
        self._messages, self._context = Messages("humble"), context
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._frames, self._meshes = frames, Rate(meshes_hz)
        self._workcell = (
            WorkcellMessages(self._messages, meshes_hz, observed=False) if context.arms else None
        )
        self._connections: dict[str, Any] = {}
        self._last_ns, self._chunk_s = 0, time.monotonic()
        writer: Any = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)  # 8: Humble's
        writer.open()
        self._writer, self._storage = writer, writer.storage
        self._storage.bio.close()  # what is buffered could not be taken back on a full disk
        self._storage.bio = self._file = _WholeWrites(self._storage.path)
        self._whole = self._file.tell()  # behind the last whole chunk

    def write(self, result: TrackingResult) -> None:
        for out in self._messages_of(result):
            topic = out.suffix if out.suffix.startswith("/") else f"/tumortrack/{out.suffix}"
            self._write(topic, out, self._time_of(result))
        if time.monotonic() - self._chunk_s >= _CHUNK_S:
            self._flush()

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        try:
            if self._storage.chunk.msgs:
                self._flush()
            self._writer.close()
        except OSError as error:
            self._give_up(error)

    def _messages_of(self, result: TrackingResult) -> list[Outgoing]:
        messages, published = self._messages, result.published_frame
        due = self._meshes.due()
        out = messages_of(result, messages, self._context.parts, due, self._workcell)
        text = json.dumps(report(result), allow_nan=False)
        string = "std_msgs/msg/String"
        out.append(Outgoing("report", string, messages.make(string, data=text)))
        if self._frames and result.observation is not None:
            camera = _camera_frame(published)
            seen = messages_seen(result.observation, messages, camera)
            out = [*(one._replace(suffix=f"/camera/{one.suffix}") for one in seen), *out]
            if camera != published.frame_id:
                out.append(_transform(result.stamp_ns, published, camera, messages))
        return out

    def _time_of(self, result: TrackingResult) -> int:
        now_ns = time.time_ns() if result.observation is None else result.observation.arrived_ns
        self._last_ns = max(self._last_ns, now_ns)
        return self._last_ns

    def _write(self, topic: str, out: Outgoing, time_ns: int) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic,
                out.message_type,
                msgdef=self._messages.definition(out.message_type),
                rihs01=self._messages.type_hash(out.message_type),
            )
        data = self._messages.to_bytes(out.message)
        chunks = len(self._storage.chunks)
        try:
            self._writer.write(self._connections[topic], time_ns, data)
        except OSError as error:
            self._give_up(error)
        if len(self._storage.chunks) > chunks:
            self._done()

    def _flush(self) -> None:
        try:
            self._storage.close_chunk()
        except OSError as error:
            self._give_up(error)
        self._done()

    def _done(self) -> None:
        self._whole, self._chunk_s = self._file.tell(), time.monotonic()

    def _give_up(self, error: OSError) -> None:
        """Leave whole chunks only."""
        if not self._file.closed:
            os.ftruncate(self._file.fileno(), self._whole)
            self._file.close()
        raise StorageError(
            f"cannot write {self._file.name}: {error.strerror}. The recording ends {_CHUNK_S:g} s "
            "before or less; it can be played with recording:FOLDER, and `mcap recover` makes it "
            "whole for others."
        ) from error


class _WholeWrites(io.FileIO):
    """Appends, without a buffer; each write is whole or raises."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r+")
        self.seek(0, io.SEEK_END)

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        while left:
            left = left[super().write(left) or 0 :]
        return size


def _camera_frame(frame: PublishedFrame) -> str:
    """The name of the camera's frame: the published one's where it is the same."""
    if np.array_equal(frame.published_from_camera, np.eye(4)):
        return frame.frame_id
    return CAMERA_FRAME if frame.frame_id != CAMERA_FRAME else f"{CAMERA_FRAME}_optical"


def _transform(stamp_ns: int, frame: PublishedFrame, camera: str, messages: Messages) -> Outgoing:
    """The camera's pose in the published frame, for /tf."""
    from scipy.spatial.transform import Rotation

    way = frame.published_from_camera
    quaternion = Rotation.from_matrix(np.array(way[:3, :3])).as_quat().tolist()
    stamped = {
        "header": messages.header(stamp_ns, frame.frame_id),
        "child_frame_id": camera,
        "transform": {
            "translation": xyz(way[:3, 3] / MM_PER_M),
            "rotation": dict(zip("xyzw", quaternion, strict=True)),
        },
    }
    kind = "tf2_msgs/msg/TFMessage"
    return Outgoing("/tf", kind, messages.make(kind, transforms=[stamped]))
