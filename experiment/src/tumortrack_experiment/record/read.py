"""What `tumortrack record` wrote, by state: depth images, pictures, where the camera was.

A recording is a folder with one MCAP (https://mcap.dev/spec) of ROS 2's messages, or as long as
states are missing with one for each that is finished. Topics: ``/state`` (std_msgs/String: its
name, as it begins), ``/tf``, ``/camera/depth/image_rect`` (32FC1, metres),
``/camera/depth/camera_info``, ``/camera/color/image_raw`` (mono8 or rgb8, of the depth image's
pixels) with its camera_info. Attachments: recording.json, kit.json, calibration.json.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import Affine
from tumortrack.core.store import natural
from tumortrack.core.types import DepthFrame

STATE, TF, CAMERA = "/state", "/tf", "/camera/"
IMAGE, INFO = f"{CAMERA}depth/image_rect", f"{CAMERA}depth/camera_info"
PICTURE = f"{CAMERA}color/image_raw"
WHOLE = "recording.mcap"


@dataclass(frozen=True, eq=False)
class Moment:
    """What the camera saw at one instant. ``depth``: camera frame, mm, with its camera and stamp;
    ``picture``: grey (h, w) or red, green and blue (h, w, 3) in the same pixels, None without
    colour; ``fixed_from_camera``: where the camera was (of one on a tool, without a calibration
    yet: where the tool was), None where nobody says it."""

    depth: DepthFrame
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None
    fixed_from_camera: Affine | None = None


class _Take(NamedTuple):
    """Where a state's messages lie."""

    file: Path
    start_ns: int
    stop_ns: int


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording on disk. ``states``: the finished ones, as they were recorded; ``attachments``:
    files that came with it, by name."""

    folder: Path
    takes: dict[str, _Take]
    attachments: dict[str, bytes]

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.takes)

    def moments(self, state: str) -> Iterator[Moment]:
        """All of a state, one after the other; none is read before its turn. Raises InputError:
        there is no such state, or it is damaged."""
        from tumortrack_devices.ros import sensors
        from tumortrack_devices.ros.messages import stamp_of
        from tumortrack_devices.ros.tf import pose_of

        if state not in self.takes:
            known = ", ".join(self.states) or "none"
            raise InputError(f"{self.folder} has no finished state {state!r}. It has: {known}.")
        beside: dict[str, Any] = {}
        for topic, _, message in messages_in(*self.takes[state]):
            beside[topic] = message
            if topic == IMAGE and INFO in beside:  # it comes last of what belongs to it
                stamp_ns = stamp_of(message.header)
                picture, tf = beside.get(PICTURE), beside.get(TF)
                same = picture is not None and stamp_of(picture.header) == stamp_ns
                yield Moment(
                    sensors.depth_of(message, beside[INFO]),
                    _picture_of(picture) if same else None,
                    pose_of(tf.transforms[0]) if tf is not None and tf.transforms else None,
                )


def read_recorded(folder: Path) -> Recorded:
    """The recording in a folder that `tumortrack record` wrote, finished or not. Raises InputError:
    there is none, or it is damaged."""
    from tumortrack_experiment.record.attachments import attachments_of

    files = (
        [folder / WHOLE]
        if (folder / WHOLE).is_file()
        else sorted(folder.glob("*.mcap"), key=natural)
    )
    takes: dict[str, _Take] = {}
    for file in files:
        began = [(at_ns, message.data) for topic, at_ns, message in messages_in(file, of=STATE)]
        ends_ns = [at_ns for at_ns, _ in began[1:]]
        for (at_ns, name), end_ns in zip(began, [*ends_ns, 2**63 - 1], strict=True):
            takes[name] = _Take(file, at_ns, end_ns)
    if not takes:
        raise InputError(f"{folder} holds no recording with a finished state.")
    return Recorded(folder, takes, attachments_of(files[0]))


def messages_in(
    file: Path, start_ns: int = 0, stop_ns: int = 2**63 - 1, of: str = ""
) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of recording and message, of all topics or one."""
    from tumortrack_devices.ros.messages import Messages

    messages = Messages()
    with _opened(file) as reader:
        wanted = [c for c in reader.connections if of in ("", c.topic)]
        for connection, at_ns, raw in reader.messages(wanted, start_ns, stop_ns):
            yield connection.topic, at_ns, messages.from_bytes(raw, connection.msgtype)


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    from rosbags.rosbag2 import Reader

    try:
        with Reader(file) as reader:
            yield reader
    except TumortrackError:
        raise
    except Exception as error:  # rosbags raises anything on a damaged file
        raise InputError(f"{file} cannot be read: {error}.") from error


def _picture_of(image: Any) -> UInt8[np.ndarray, "h w *rgb"]:
    shape = (image.height, image.width, 3)[: 3 if image.encoding == "rgb8" else 2]
    if len(image.data) != np.prod(shape, dtype=np.int64):
        raise InputError("a picture of the recording is damaged: its size is another.")
    return np.asarray(image.data, np.uint8).reshape(shape)
