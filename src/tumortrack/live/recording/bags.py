"""ROS bags as recordings: rosbag2 (.mcap, .db3, folders of them) and ROS 1 (.bag), by rosbags.

Messages are read by the types that are known here, never by definitions from the bag: those would
become code.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.recording import RecordedFrame
from tumortrack.live.ros.messages import Messages, stamp_of
from tumortrack.live.ros.sensors import CAMERA_INFO, CLOUD, IMAGE, cloud_of, depth_of, mask_of
from tumortrack.live.values import Observation

SUFFIXES = (".mcap", ".db3", ".bag")
ESTIMATES = "/tumortrack/"  # topics of our own estimates, which are no input
MASK_TOPIC = "/camera/mask"
_REALSENSE = "/device_0/"  # how the RealSense SDK names all its topics
# https://mcap.dev/spec
_MAGIC = b"\x89MCAP0\r\n"
_DATA_END = 0x0F
_LAST_OPCODE = 0x0F
# An empty DataEnd, then a footer of three zeros: where a summary would start, and its checksum.
_ENDING = struct.pack("<BQI", _DATA_END, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + _MAGIC
_DEPTHS = ("16UC1", "mono16", "32FC1")


@dataclass(frozen=True)
class BagChoice:
    """Which topics, and how their depth images are meant; an empty topic: the only one there is.

    ``rectified`` and ``unit_mm`` as in ``ros.sensors.depth_of``.
    """

    topic: str = ""
    info_topic: str = ""
    rectified: bool = False
    unit_mm: float = 1.0


def is_bag(path: Path) -> bool:
    """Whether this is a bag's file, or a folder of one."""
    return (path / "metadata.yaml").is_file() or bool(_files(path))


class BagRecording:
    """An open bag: depth images, each with the camera_info that came last and the mask of its own
    stamp, or clouds.

    Raises:
        InputError: no bag, damaged, or not exactly one topic to choose.
    """

    def __init__(self, path: Path, choice: BagChoice) -> None:
        files = _files(path)
        self._path, self._choice = path, choice
        self._messages = Messages("noetic" if files and files[0].suffix == ".bag" else "humble")
        self._readers: list[Any] = []
        try:
            for file in [path] if (path / "metadata.yaml").is_file() else files:
                self._readers.append(_guarded(path, partial(_open, file)))
            self._types = {c.topic: c.msgtype for r in self._readers for c in r.connections}
            self._topic = self._choose_topic()
            self._info_topic = self._choose_info() if self._types[self._topic] == IMAGE else ""
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        readers, self._readers = self._readers, []
        for reader in readers:
            with suppress(AssertionError):  # of rosbags: it was not open
                reader.close()

    def frames(self) -> Iterator[RecordedFrame]:
        images = bool(self._info_topic)
        info = self._first(self._info_topic) if images else None
        mask: Any = None
        waiting: Any = None  # an image: its camera_info and mask may follow it
        last_ns = 0
        for topic, message in self._all({self._topic, self._info_topic, MASK_TOPIC}):
            if topic and topic != self._topic:
                info, mask = (info, message) if topic == MASK_TOPIC else (message, mask)
                continue
            if waiting is not None:
                yield self._image_frame(waiting, info, mask)
                waiting = None
            if isinstance(message, InputError):
                yield RecordedFrame(last_ns, partial(_refuse, message))
                continue
            last_ns = stamp_of(message.header)
            if images:
                waiting = message
            else:
                yield RecordedFrame(last_ns, partial(_cloud, message))
        if waiting is not None:
            yield self._image_frame(waiting, info, mask)

    def _image_frame(self, image: Any, info: Any, mask: Any) -> RecordedFrame:
        stamp_ns = stamp_of(image.header)

        def load() -> Observation:
            frame = depth_of(image, info, self._choice.rectified, self._choice.unit_mm)
            here = mask is not None and stamp_of(mask.header) == stamp_ns
            return Observation(frame, 0, mask_of(mask) if here else None)

        return RecordedFrame(stamp_ns, load)

    def _all(self, topics: set[str]) -> Iterator[tuple[str, Any]]:
        """Topic and message in the order of their recording; without a topic an InputError, where
        a message, or the bag from there on, is damaged."""
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            if not wanted:
                continue
            raw = reader.messages(wanted)
            while True:
                try:
                    got = _guarded(self._path, partial(next, raw, None))
                except InputError as error:
                    yield "", error
                    break
                if got is None:
                    break
                topic = got[0].topic
                try:
                    yield topic, self._messages.from_bytes(got[2], self._types[topic])
                except InputError as error:
                    yield "", error

    def _first(self, topic: str) -> Any:
        for _, message in self._all({topic}):
            if isinstance(message, InputError):
                raise message
            return message
        raise InputError(f"{self._path} has no message on {topic}, which was announced in it.")

    def _choose_topic(self) -> str:
        usable = {
            topic: kind
            for topic, kind in self._types.items()
            if kind in (IMAGE, CLOUD) and not topic.startswith(ESTIMATES)
        }
        if wanted := self._choice.topic:
            if self._types.get(wanted) in (IMAGE, CLOUD):
                return wanted
            raise InputError(
                f"{self._path} has no topic {wanted!r} of depth images or clouds. It has: "
                f"{', '.join(usable) or 'none'}."
            )
        images = [t for t, kind in usable.items() if kind == IMAGE and self._is_depth(t)]
        found = images or [topic for topic, kind in usable.items() if kind == CLOUD]
        if len(found) == 1:
            return found[0]
        if any(topic.startswith(_REALSENSE) for topic in self._types):
            raise InputError(
                f"{self._path} was recorded by the RealSense SDK, whose depth unit stands apart: "
                f"give the source realsense:{self._path}."
            )
        if not usable:
            raise InputError(
                f"{self._path} holds no depth images and no clouds (topics of {IMAGE} or {CLOUD}; "
                f"those under {ESTIMATES} are estimates)."
            )
        raise InputError(
            f"{self._path}: which topic holds the depth images or clouds? Say topic=NAME; "
            f"candidates: {', '.join(found or usable)}."
        )

    def _is_depth(self, topic: str) -> bool:
        try:
            return self._first(topic).encoding in _DEPTHS
        except InputError:
            return False

    def _choose_info(self) -> str:
        """The camera_info beside the image, by ROS's convention or RealSense's; or the only one."""
        if self._choice.info_topic:
            if self._types.get(self._choice.info_topic) == CAMERA_INFO:
                return self._choice.info_topic
            raise InputError(f"{self._path} has no camera_info topic {self._choice.info_topic!r}.")
        infos = [topic for topic, kind in self._types.items() if kind == CAMERA_INFO]
        parent = self._topic.rpartition("/")[0]
        beside = (f"{parent}/camera_info", f"{parent.rpartition('/')[0]}/info/camera_info")
        found = [topic for topic in beside if topic in infos] or infos
        if len(found) == 1:
            return found[0]
        raise InputError(
            f"{self._path}: which camera_info belongs to {self._topic}? Say info_topic=NAME; "
            f"candidates: {', '.join(infos) or 'none, so its depth images cannot be used'}."
        )


def _files(path: Path) -> list[Path]:
    """The bag's files in the order of their numbers."""
    if not path.is_dir():
        return [path] if path.suffix.lower() in SUFFIXES else []
    inside = (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    return sorted(inside, key=lambda p: (len(p.name), p.name))


def _open(path: Path) -> Any:
    """An opened reader of a file, or of a rosbag2 folder."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    kind = path.suffix.lower() if path.is_file() else ""
    reader: Any
    if kind == ".mcap" and not _is_whole(path):
        from rosbags.rosbag2.storage_mcap import McapReader

        reader = McapReader(_CutMcap(path))  # type: ignore[arg-type]
    else:
        reader = Reader1(path) if kind == ".bag" else Reader2(path)
    reader.open()
    return reader


def _guarded(path: Path, step: Callable[[], Any]) -> Any:
    """What ``step`` returns, or an InputError that names the bag."""
    try:
        return step()
    except TumortrackError:
        raise
    except Exception as error:  # rosbags, sqlite and unpackers raise anything on a damaged bag
        raise InputError(
            f"{path} is no bag that can be read, or is damaged from here on: {error}."
        ) from error


def _cloud(message: Any) -> Observation:
    return Observation(cloud_of(message), 0)


def _refuse(error: InputError) -> NoReturn:
    raise error


def _is_whole(path: Path) -> bool:
    """Whether the file ends as it should; of one without a beginning too, which is no MCAP."""
    with path.open("rb") as stream:
        begins = stream.read(len(_MAGIC)) == _MAGIC
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(size - len(_MAGIC), 0))
        return not begins or (size > len(_MAGIC) and stream.read() == _MAGIC)


class _CutMcap(io.RawIOBase):
    """An MCAP file without an end, as a killed recorder or a full disk leaves it, with an end.

    A file is magic, records (opcode, length, content), footer, magic; readers begin at the footer.
    Here the whole records get a footer that says "no index", in memory, so that the library reads
    them from first to last; the file stays as it is. To the library this is the file's path.
    """

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self._kept = _end_of_records(self._stream)
        self._at = 0

    def open(self, mode: str) -> io.BufferedReader:
        return io.BufferedReader(self)

    def __str__(self) -> str:
        return self._stream.name

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._kept + len(_ENDING)}
        self._at = max(start[whence] + offset, 0)
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at < self._kept:
            self._stream.seek(self._at)
            got = self._stream.read(min(len(buffer), self._kept - self._at))
        else:
            begin = self._at - self._kept
            got = _ENDING[begin : begin + len(buffer)]
        buffer[: len(got)] = got
        self._at += len(got)
        return len(got)

    def close(self) -> None:
        self._stream.close()
        super().close()


def _end_of_records(stream: io.BufferedReader) -> int:
    """Behind the last record that is there from its first to its last byte."""
    size = stream.seek(0, io.SEEK_END)
    end = len(_MAGIC)
    while True:
        stream.seek(end)
        head = stream.read(9)
        if len(head) < 9 or not 0 < head[0] < _LAST_OPCODE:
            return end
        beyond = end + 9 + int.from_bytes(head[1:], "little")
        if beyond > size:
            return end
        end = beyond
