"""Writing ROS 2 messages to an MCAP that a crash or a full disk leaves readable up to there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.evidence import Evidence
from tumortrack.core.geometry import Affine
from tumortrack.live.values import Observation, TrackingResult
from tumortrack_devices.ros.messages import Messages, Outgoing
from tumortrack_devices.ros.sensors import CAMERA_FRAME, messages_seen
from tumortrack_devices.ros.tf import TRANSFORMS, transform_fields

STRING = "std_msgs/msg/String"
EVIDENCE = "evidence"  # topic beside the depth image's: what became known with a frame


class FrameEvidence(Config, frozen=True, kw_only=True):
    """What became known with the frame of that stamp, in its camera's frame, mm."""

    stamp_ns: int
    evidence: tuple[Evidence, ...]


class McapBag:
    """A new rosbag2 folder with one MCAP. Raises InputError: there is something already.

    Messages are filed by time of arrival, which never goes back; headers have the stamps. A crash
    loses at most the last MiB, which is not on the disk yet. When the disk is full, whole chunks
    stay, in a file without an end, and each later write raises the same StorageError, which ends
    with ``advice``.
    """

    def __init__(
        self, folder: Path, messages: Messages, advice: str, compressed: bool = False
    ) -> None:
        from rosbags import rosbag2

        self._folder, self._messages, self._advice = folder, messages, advice
        self._connections: dict[str, Any] = {}
        self._last_ns, self._refused, self._closed = 0, "", False
        try:
            # Version 8 is Humble's.
            self._writer = rosbag2.Writer(
                folder, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP
            )
            if compressed:  # each chunk, as ROS 2 does it too
                mode = rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
                self._writer.set_compression(*mode)
            self._writer.open()
        except rosbag2.WriterError as error:
            raise InputError(f"{folder} exists already. Choose another path.") from error

    def write(self, arrived_ns: int, out: Iterable[Outgoing]) -> None:
        """Messages with full topic names."""
        if self._refused:
            raise StorageError(self._refused)
        self._last_ns = max(self._last_ns, arrived_ns)
        with self._on_disk():
            for topic, message_type, message in out:
                if topic not in self._connections:
                    self._connections[topic] = self._writer.add_connection(
                        topic, message_type, typestore=self._messages.store
                    )
                data = self._messages.to_bytes(message)
                self._writer.write(self._connections[topic], self._last_ns, data)

    def close(self) -> None:
        """Write the index and metadata.yaml."""
        if not (self._closed or self._refused):
            self._closed = True
            with self._on_disk():
                self._writer.close()

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            with suppress(OSError):  # it may have more to write
                self._writer.abort()
            self._refused = f"cannot write {self._folder}: {error.strerror}. {self._advice}"
            raise StorageError(self._refused) from error


def camera_messages(
    seen: Observation, fixed_from_camera: Affine, frame_id: str, messages: Messages, number: int = 1
) -> list[Outgoing]:
    """A camera's observation and, if the frames differ, its pose in ``frame_id`` on ``/tf``, with
    full topic names. ``number``: of the camera, from 1."""
    suffix = f"_{number}" if number > 1 else ""
    same = np.array_equal(fixed_from_camera, np.eye(4))
    other = CAMERA_FRAME + ("_optical" if frame_id == CAMERA_FRAME else "") + suffix
    # The source's name, which a calibration may refer to when this is played.
    camera = seen.frame_id or (frame_id if same else other)
    if camera == frame_id and not same:
        camera = other
    out = [
        message._replace(suffix=f"/camera{suffix}/{message.suffix}")
        for message in messages_seen(seen, messages, camera)
    ]
    if camera != frame_id:
        pose = transform_fields(messages, seen.stamp_ns, frame_id, camera, fixed_from_camera)
        out.append(Outgoing("/tf", TRANSFORMS, messages.make(TRANSFORMS, transforms=[pose])))
    return out


def evidence_message(result: TrackingResult, messages: Messages, number: int) -> Outgoing:
    """What became known with a result's frame, as JSON, with the full name of its topic; of the
    camera of that ``number``."""
    known = FrameEvidence(stamp_ns=result.stamp_ns, evidence=result.evidence)
    text = messages.make(STRING, data=msgspec.json.encode(known).decode())
    suffix = f"_{number}" if number > 1 else ""
    return Outgoing(f"/camera{suffix}/{EVIDENCE}", STRING, text)
