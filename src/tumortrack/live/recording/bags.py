"""ROS bags as recordings: rosbag2 (.mcap, .db3, folders of them) and ROS 1 (.bag), by rosbags.

Messages are read by the types that are known here, never by definitions that the bag brings along:
those would become code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.recording.cut_mcap import is_whole, open_cut
from tumortrack.live.recording.shots import Content, Shot, refuse
from tumortrack.live.ros.incoming import CAMERA_INFO, CLOUD, IMAGE, cloud_of, depth_of, mask_of
from tumortrack.live.ros.messages import Messages, stamp_of

SUFFIXES = (".mcap", ".db3", ".bag")
ESTIMATES = "/tumortrack/"  # topics of our own estimates, which are no input
MASK_TOPIC = "/camera/mask"
_REALSENSE = "/device_0/"  # how the RealSense SDK names all its topics
_DEPTHS = ("16UC1", "mono16", "32FC1")


@dataclass(frozen=True)
class BagChoice:
    """Which topics, and how their depth images are meant; an empty topic: the only one there is.

    ``rectified`` and ``unit_mm`` as in ``ros.incoming.depth_of``.
    """

    topic: str = ""
    info_topic: str = ""
    rectified: bool = False
    unit_mm: float = 1.0


def is_bag(path: Path) -> bool:
    """Whether this is a bag's file, or a folder of one."""
    return (path / "metadata.yaml").is_file() or bool(_files(path))


class BagReel:
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

    def shots(self) -> Iterator[Shot]:
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
                yield self._image_shot(waiting, info, mask)
                waiting = None
            if isinstance(message, InputError):
                yield Shot(last_ns, partial(refuse, message))
                continue
            last_ns = stamp_of(message.header)
            if images:
                waiting = message
            else:
                yield Shot(last_ns, partial(_cloud, message))
        if waiting is not None:
            yield self._image_shot(waiting, info, mask)

    def _image_shot(self, image: Any, info: Any, mask: Any) -> Shot:
        stamp_ns = stamp_of(image.header)
        if mask is not None and stamp_of(mask.header) != stamp_ns:
            mask = None
        return Shot(stamp_ns, partial(_frame, image, info, mask, self._choice))

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
    if kind == ".mcap" and not is_whole(path):
        return open_cut(path)
    reader: Any = Reader1(path) if kind == ".bag" else Reader2(path)
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


def _cloud(message: Any) -> Content:
    return Content(cloud_of(message))


def _frame(image: Any, info: Any, mask: Any, choice: BagChoice) -> Content:
    frame = depth_of(image, info, choice.rectified, choice.unit_mm)
    return Content(frame, None if mask is None else mask_of(mask))
