"""A recording of observations and results, to be played again: a rosbag2 folder (MCAP), as
`ros2 bag play` and Foxglove read it, by rosbags; or plain files."""

from __future__ import annotations

import io
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

import tumortrack
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.store import read_json, write_json, writing
from tumortrack.live.display import wxyz_of
from tumortrack.live.poses import COLUMNS, pose_row
from tumortrack.live.recording import folders
from tumortrack.live.recording.folders import ABOUT, FRAMES, INDEX, SHAPES, FrameFolders, report
from tumortrack.live.ros.messages import MM_PER_M, Messages, Outgoing, xyz
from tumortrack.live.ros.results import ResultMessages
from tumortrack.live.ros.sensors import CAMERA_FRAME, messages_seen
from tumortrack.live.values import CameraView, Sink, SinkConfig, SinkContext, TrackingResult

_KIND = "recording"
POSES, STILL = "poses.csv", "poses.json"  # of a camera that moves; of several that stand still
_CHUNK_S = 0.25  # a killed program loses what is in no chunk yet
_STRING, _TRANSFORMS = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"


class RecordingSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="recording"):
    """A new folder with every result.

    Attributes:
        format: mcap, a rosbag2 folder (depth images as 32FC1 in metres: float32 to 1e-5 mm;
            stamps exact); or files, a folder per frame (depth images in steps of 0.1 mm).
        frames: also what the source saw; otherwise the recording cannot be played.
        meshes_hz: mcap: surfaces at most so often; 0: with every result.
        overwrite: replace a recording of this kind.
    """

    target: ClassVar[str] = "path"
    queue_size: ClassVar[int] = 30

    path: Path
    format: Literal["mcap", "files"] = "mcap"
    frames: bool = True
    meshes_hz: float = 2.0
    overwrite: bool = False

    def __post_init__(self) -> None:
        self.check_between("recording:", meshes_hz=(0, 1000))

    def open(self, context: SinkContext) -> Sink:
        """Raises InputError if the folder exists, and is no recording or ``overwrite`` was not
        given."""
        _make_room(self.path, self.overwrite)
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            sink: McapFile | FrameFolders | WithPoses
            if self.format == "mcap":
                sink = McapFile(self.path, context, self.frames, self.meshes_hz)
            else:
                sink = FrameFolders(self.path, self.frames)
            if context.published_frame.moves:
                sink = WithPoses(sink, self.path / POSES)
        frame = context.published_frame
        about = {
            "kind": _KIND,
            "tumortrack": tumortrack.__version__,
            "patient": to_builtins(context.patient),
            "format": self.format,
            "parts": list(context.parts),
            "frame_id": frame.frame_id,
            "published_from_camera": frame.published_from_camera.tolist(),
            # Plain files lie beside their depth images; messages are as they were published.
            "estimate_frame": "camera" if self.format == "files" else frame.frame_id,
        }
        write_json(self.path / ABOUT, about)
        if context.cameras:
            rows = [pose.tolist() for pose in context.cameras]
            fixed = {"unit": "mm", "frame_id": frame.frame_id, "fixed_from_camera": rows}
            write_json(self.path / STILL, fixed)
        return sink


class WithPoses:
    """Beside a recording, where the camera was in each frame: a table as `track --moving` reads it.
    Whatever the disk refuses raises, and the next result is tried."""

    def __init__(self, sink: McapFile | FrameFolders, path: Path) -> None:
        self._sink, self._file = sink, path.open("ab", buffering=0)
        self._file.write(f"{COLUMNS}\n".encode())

    def publish(self, result: TrackingResult) -> None:
        self._sink.publish(result)
        if result.observation is not None:
            frame, stamp_ns = result.published_frame, result.stamp_ns
            row = pose_row(stamp_ns, frame.frame_id, frame.published_from_camera)
            with writing(Path(self._file.name)):
                self._file.write(row.encode())

    def close(self) -> None:
        self._file.close()
        self._sink.close()


def _make_room(path: Path, overwrite: bool) -> None:
    """Refuse what exists; or take an older recording away, if nothing else lies in it."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(
            f"{path} exists already. Choose another folder, or give overwrite=true to replace the "
            "recording."
        )
    inside = {p.name for p in path.iterdir()} if path.is_dir() else {path.name}
    ours = {ABOUT, INDEX, FRAMES, SHAPES, POSES, STILL, "metadata.yaml", f"{path.name}.mcap"}
    inside = {name for name in inside if not name.startswith(folders.VIEW)}
    is_ours = ABOUT in inside and read_json(path / ABOUT).get("kind") == _KIND
    if inside and (inside - ours or not is_ours or not path.is_dir()):
        raise InputError(
            f"{path} is no recording of tumortrack's, or holds something else too, so it is not "
            "replaced. Choose another folder."
        )
    shutil.rmtree(path)


class McapFile:
    """Topics: ``/camera/...`` what the source saw, in the camera's frame, of further cameras
    ``/camera_2/...``; ``/tumortrack/...`` the results as in ROS, and ``report`` (JSON); ``/tf``
    where the frames differ.

    Messages are filed under their time of arrival, which never goes back; headers have the stamps.
    Where the disk refuses, whole chunks stay, in a file without an end, and each later result
    raises the same StorageError: it is not in the recording.
    """

    def __init__(self, folder: Path, context: SinkContext, frames: bool, meshes_hz: float) -> None:
        self._messages, self._frames = Messages(), frames
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

        self._results = ResultMessages(self._messages, context, meshes_hz, observed=False)
        self._connections: dict[str, Any] = {}
        self._last_ns, self._chunk_s = 0, time.monotonic()
        self._refused = ""
        try:
            # Version 8 is Humble's.
            writer: Any = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)
            writer.open()
        except WriterError as error:  # another process began to record into it a moment ago
            raise InputError(f"{folder} exists already. Choose another folder.") from error
        self._writer, self._storage = writer, writer.storage
        self._storage.bio.close()  # what is buffered could not be taken back on a full disk
        self._storage.bio = self._file = _WholeWrites(self._storage.path)
        self._whole = self._file.tell()  # behind the last whole chunk

    def publish(self, result: TrackingResult) -> None:
        if self._refused:
            raise StorageError(self._refused)
        seen = result.observation
        self._last_ns = max(self._last_ns, time.time_ns() if seen is None else seen.arrived_ns)
        for topic, message_type, message in self._messages_of(result):
            if topic not in self._connections:
                definition, _ = self._messages.definition(message_type)
                type_hash = self._messages.type_hash(message_type)
                self._connections[topic] = self._writer.add_connection(
                    topic, message_type, msgdef=definition, rihs01=type_hash
                )
            data = self._messages.to_bytes(message)
            with self._on_disk():
                self._writer.write(self._connections[topic], self._last_ns, data)
        if time.monotonic() - self._chunk_s >= _CHUNK_S:
            self._flush()

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        if not self._file.closed:
            if self._storage.chunk.msgs:
                self._flush()
            with self._on_disk():
                self._writer.close()

    def _messages_of(self, result: TrackingResult) -> list[Outgoing]:
        """With the full names of their topics."""
        make, frame = self._messages.make, result.published_frame
        text = json.dumps(report(result), allow_nan=False)
        said = Outgoing("report", _STRING, make(_STRING, data=text))
        out = [*self._results.of(result), said]
        out = [one._replace(suffix=f"/tumortrack/{one.suffix}") for one in out]
        if not self._frames or result.observation is None:
            return out
        alone = CameraView(1, result.observation, frame.published_from_camera)
        for view in result.views or (alone,):
            out = [*self._seen(view, frame.frame_id, result.stamp_ns), *out]
        return out

    def _seen(self, view: CameraView, frame_id: str, stamp_ns: int) -> Iterator[Outgoing]:
        """What one camera saw, and its pose in the published frame."""
        way, number = view.published_from_camera, f"_{view.number}" if view.number > 1 else ""
        same = np.array_equal(way, np.eye(4))
        other = CAMERA_FRAME + ("_optical" if frame_id == CAMERA_FRAME else "") + number
        # As the source calls it: a calibration may know the camera by that when this is played.
        camera = view.seen.frame_id or (frame_id if same else other)
        if camera == frame_id and not same:
            camera = other
        for one in messages_seen(view.seen, self._messages, camera):
            yield one._replace(suffix=f"/camera{number}/{one.suffix}")
        if camera != frame_id:
            stamped = {
                "header": self._messages.header(stamp_ns, frame_id),
                "child_frame_id": camera,
                "transform": {
                    "translation": xyz(way[:3, 3] / MM_PER_M),
                    "rotation": dict(zip("wxyz", wxyz_of(way[:3, :3]).tolist(), strict=True)),
                },
            }
            message = self._messages.make(_TRANSFORMS, transforms=[stamped])
            yield Outgoing("/tf", _TRANSFORMS, message)

    def _flush(self) -> None:
        with self._on_disk():
            self._storage.close_chunk()

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        """Around what may write a chunk: where it fails, whole chunks only are left."""
        try:
            yield
        except OSError as error:
            if not self._file.closed:
                os.ftruncate(self._file.fileno(), self._whole)
                self._file.close()
            self._refused = (
                f"cannot write {self._file.name}: {error.strerror}. The recording ends "
                f"{_CHUNK_S:g} s before or less; it can be played with recording:FOLDER, and "
                "`mcap recover` makes it whole for others."
            )
            raise StorageError(self._refused) from error
        if not self._file.closed and (end := self._file.tell()) > self._whole:
            self._whole, self._chunk_s = end, time.monotonic()


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
