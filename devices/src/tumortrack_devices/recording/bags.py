"""ROS bags as recordings: rosbag2 (.mcap, .db3, folders of them) and ROS 1 (.bag), by rosbags.

Messages are decoded by the types known here, never by definitions from the bag, which rosbags would
turn into code.
"""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import msgspec

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError, readable
from tumortrack.core.evidence import Evidence
from tumortrack.core.store import natural
from tumortrack.live.values import Observation
from tumortrack_devices.recording.folders import RecordedFrame
from tumortrack_devices.recording.mcap import EVIDENCE, FrameEvidence
from tumortrack_devices.ros import sensors
from tumortrack_devices.ros.messages import Messages, stamp_of

_LOG = logging.getLogger("tumortrack")
_KINDS = (sensors.IMAGE, sensors.CLOUD, sensors.COMPRESSED)
_PACKED = "/compressedDepth"  # image_transport appends it to the image's topic
SUFFIXES = (".mcap", ".db3", ".bag")
ESTIMATES = "/tumortrack/"  # topics of our own estimates: no input
OWN_DEPTH = "/camera/depth/image_rect"  # of the sink ``recording``
MASK_TOPIC, PICTURE_TOPIC = "/camera/mask", "/camera/color/image_raw"
_NO_BAG = "is no bag that can be read, or is damaged from here on"
_REALSENSE = "/device_0/"  # prefix of all topics of the RealSense SDK
# https://mcap.dev/spec
_MAGIC = b"\x89MCAP0\r\n"
_DATA_END = 0x0F


class BagRecording:
    """An open bag: depth images, raw or packed, each with the latest camera_info and the mask and
    picture of its stamp, or clouds. An empty topic means the only one; ``rectified`` and
    ``unit_mm`` as in ``ros.sensors.depth_of``. Raises InputError if it is no bag or damaged, or if
    there is not exactly one topic to choose."""

    def __init__(
        self,
        path: Path,
        topic: str = "",
        info_topic: str = "",
        rectified: bool = False,
        unit_mm: float = 1.0,
    ) -> None:
        files = bag_files(path)
        is_ros1 = files[0].is_file() and files[0].suffix.lower() == ".bag"
        self._path, self._rectified, self._unit_mm = path, rectified, unit_mm
        self._messages = Messages("noetic" if is_ros1 else "humble")
        self._readers: list[Any] = []
        with ExitStack() as opened:
            for file in files:
                with readable(path, _NO_BAG):
                    self._readers.append(_opened(file))
                opened.callback(self._readers[-1].close)
            self._types = {c.topic: c.msgtype for r in self._readers for c in r.connections}
            self._topic = self._choose_topic(topic)
            images = self._types[self._topic] != sensors.CLOUD
            self._info_topic = self._choose_info(info_topic) if images else ""
            self._opened = opened.pop_all()

    def close(self) -> None:
        self._opened.close()

    def frames(self) -> Iterator[RecordedFrame]:
        """From first to last; each call starts again. ``load`` of a damaged frame raises. If the
        first has no stamp, all have the bag's times."""
        first = self._first(self._info_topic) if self._info_topic else None
        companions: dict[str, Any] = {self._info_topic: first}  # the latest of each topic
        stamp_ns, unstamped = 0, None
        waiting: Any = None  # an image: its companions may follow it
        topics = {self._topic, self._info_topic, MASK_TOPIC, self._evidence_topic}
        if self._topic == OWN_DEPTH:  # another bag's picture may not be aligned
            topics.add(PICTURE_TOPIC)
        for topic, message, time_ns in chain(self._all(topics), [("", None, 0)]):
            if topic and topic != self._topic:
                companions[topic] = message
                continue
            if waiting is not None:
                yield RecordedFrame(stamp_ns, partial(self._observed, waiting, {**companions}))
                companions.pop(self._evidence_topic, None)  # it is of one frame
            if message is not None and not isinstance(message, InputError):
                stamp_ns = stamp_of(message.header)
                if unstamped is None and (unstamped := stamp_ns == 0):
                    _LOG.warning("%s: its frames have no stamps; the bag's times count", self._path)
                stamp_ns = time_ns if unstamped else stamp_ns
            waiting = message

    def _observed(self, message: Any, companions: dict[str, Any]) -> Observation:
        if isinstance(message, InputError):
            raise message
        info, image = companions[self._info_topic], companions.get(MASK_TOPIC)
        known = self._known(companions.get(self._evidence_topic), stamp_of(message.header))
        if info is None:
            cloud, frame_id = sensors.cloud_of(message), sensors.frame_of(message)
            return Observation(cloud, 0, frame_id=frame_id, evidence=known)
        if self._types[self._topic] == sensors.COMPRESSED:
            message = sensors.image_of(message, self._messages)
        frame = sensors.depth_of(message, info, self._rectified, self._unit_mm)
        same_time = image is not None and stamp_of(image.header) == frame.stamp_ns
        mask = sensors.mask_of(image) if same_time else None
        picture = companions.get(PICTURE_TOPIC)
        picture = picture and sensors.picture_of(picture, frame)
        return Observation(frame, 0, mask, None, sensors.frame_of(message), picture, known)

    @property
    def _evidence_topic(self) -> str:
        """Of the same camera, where our sink wrote both."""
        own = re.match(r"/camera(_\d+)?/", self._topic)
        return f"{own[0] if own else f'{self._topic}/'}{EVIDENCE}"

    def _known(self, message: Any, stamp_ns: int) -> tuple[Evidence, ...]:
        """What became known with the frame of this stamp."""
        if message is None:
            return ()
        where, fault = f"{self._path}: its {self._evidence_topic}", "is damaged"
        with readable(where, fault):
            given = msgspec.json.decode(message.data)
            known = from_builtins(given, FrameEvidence, f"{where} {fault}")
        return known.evidence if known.stamp_ns == stamp_ns else ()

    def _all(self, topics: set[str]) -> Iterator[tuple[str, Any, int]]:
        """Topic, message and time (ns) in recorded order; an InputError without a topic if a
        message, or the rest of the bag, is damaged."""
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in topics]
            raw = reader.messages(wanted) if wanted else iter(())
            entry: Any = True
            while entry is not None:
                entry = None
                try:
                    with readable(self._path, _NO_BAG):
                        entry = next(raw, None)
                    if entry is not None:
                        topic = entry[0].topic
                        message = self._messages.from_bytes(entry[2], self._types[topic])
                        yield topic, message, entry[1]
                except InputError as error:
                    yield "", error, 0

    def _first(self, topic: str) -> Any:
        for _, message, _ in self._all({topic}):
            if isinstance(message, InputError):
                raise message
            return message
        raise InputError(f"{self._path} has no message on {topic}, which was announced in it.")

    def _choose_topic(self, wanted: str) -> str:
        usable = [topic for topic, kind in self._types.items() if _is_input(topic, kind)]
        if wanted:
            if self._types.get(wanted) in _KINDS:
                return wanted
            raise InputError(
                f"{self._path} has no topic {wanted!r} of depth images or clouds. It has: "
                f"{', '.join(usable) or 'none'}."
            )
        clouds = [topic for topic in usable if self._types[topic] == sensors.CLOUD]
        depths = [topic for topic in usable if self._is_depth(topic)]
        raw = [topic for topic in depths if self._types[topic] == sensors.IMAGE]
        candidates = raw or depths or clouds
        if len(candidates) == 1:
            return candidates[0]
        if any(topic.startswith(_REALSENSE) for topic in self._types):
            raise InputError(
                f"{self._path} is of the RealSense SDK. Give the source realsense:{self._path}."
            )
        if not usable:
            raise InputError(f"{self._path} holds no depth images and no clouds, as cameras send.")
        raise InputError(
            f"{self._path}: which topic holds the depth images or clouds? Say topic=NAME; "
            f"candidates: {', '.join(candidates or usable)}."
        )

    def _is_depth(self, topic: str) -> bool:
        with suppress(InputError):
            match self._types[topic]:
                case sensors.IMAGE:
                    return self._first(topic).encoding in sensors.DEPTHS
                case sensors.COMPRESSED:
                    return bool(sensors.image_of(self._first(topic), self._messages))
        return False

    def _choose_info(self, wanted: str) -> str:
        """The image's camera_info, by the naming of ROS or RealSense; or the only one."""
        infos = [topic for topic, kind in self._types.items() if kind == sensors.CAMERA_INFO]
        if wanted and wanted not in infos:
            raise InputError(f"{self._path} has no camera_info topic {wanted!r}.")
        parent = self._topic.removesuffix(_PACKED).rpartition("/")[0]
        usual = (f"{parent}/camera_info", f"{parent.rpartition('/')[0]}/info/camera_info")
        candidates = [topic for topic in usual if topic in infos] or infos
        if wanted or len(candidates) == 1:
            return wanted or candidates[0]
        raise InputError(
            f"{self._path}: which camera_info belongs to {self._topic}? Say info_topic=NAME; "
            f"candidates: {', '.join(infos) or 'none, so its depth images cannot be used'}."
        )


def bag_files(path: Path) -> list[Path]:
    """The bag's files in the order of their numbers; a rosbag2 folder is itself one. Empty if there
    is no bag."""
    if (path / "metadata.yaml").is_file():
        return [path]
    if not path.is_dir():
        return [path] if path.suffix.lower() in SUFFIXES else []
    inside = (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    return sorted(inside, key=natural)


def bag_contents(path: Path) -> tuple[dict[str, int], float]:
    """The number of depth images or clouds by topic, and the duration in s; also of a bag without
    an end, as after a crash. Raises InputError if it cannot be read."""
    counts: dict[str, int] = {}
    times_ns: list[int] = []
    for file in bag_files(path):
        with readable(path, _NO_BAG), closing(_opened(file)) as reader:
            kinds = [c for c in reader.connections if _is_input(c.topic, c.msgtype)]
            for connection, time_ns, _ in reader.messages(kinds) if kinds else ():
                counts[connection.topic] = counts.get(connection.topic, 0) + 1
                times_ns.append(time_ns)
    return counts, (max(times_ns) - min(times_ns)) * 1e-9 if times_ns else 0.0


def _is_input(topic: str, kind: str) -> bool:
    """Whether it may hold depth images or clouds: neither estimates nor packed colours do."""
    packed = kind != sensors.COMPRESSED or topic.endswith(_PACKED)
    return kind in _KINDS and packed and not topic.startswith(ESTIMATES)


def _opened(path: Path) -> Any:
    """A reader of a file, or of a rosbag2 folder."""
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.storage_mcap import McapReader

    kind = path.suffix.lower() if path.is_file() else ""
    if kind == ".mcap" and (profile := _profile(path)) not in ("ros2", None):
        raise InputError(
            f"{path} is an MCAP of {f'the profile {profile!r}' if profile else 'no profile'}; "
            "allowed: of ros2. Record with rosbag2, or convert it (ROS 1: give the .bag itself)."
        )
    end = _end_of_records(path) if kind == ".mcap" else 0
    if not end:
        whole: Any = rosbag1.Reader(path) if kind == ".bag" else rosbag2.Reader(path)
        whole.open()
        return whole
    # Readers begin at the index. This one is given the end of the records, and scans them all.
    reader: Any = McapReader(path)
    try:
        reader.open()
    except Exception:
        if not reader.data_start:  # the head is damaged too
            raise
    reader.bio, reader.data_end = path.open("rb"), end
    reader.meta_scan()
    return reader


def _profile(path: Path) -> str | None:
    """Whose messages an MCAP says that it holds, in its first record; None: it cannot be read."""
    with path.open("rb") as stream:
        head = stream.read(len(_MAGIC) + 13 + 64)
    size = int.from_bytes(head[len(_MAGIC) + 9 :][:4], "little")
    if not head.startswith(_MAGIC + b"\x01") or size > 64:
        return None
    return head[len(_MAGIC) + 13 :][:size].decode(errors="replace")


def _end_of_records(path: Path) -> int:
    """The end of the last whole record of an MCAP without an end, as after a crash or on a full
    disk; 0 of one with an end, or of another file. A file is magic, records (opcode, length,
    content), footer, magic."""
    with path.open("rb") as stream:
        begins = stream.read(len(_MAGIC)) == _MAGIC
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(size - len(_MAGIC), 0))
        if not begins or (size > len(_MAGIC) and stream.read() == _MAGIC):
            return 0
        end = len(_MAGIC)
        while True:
            stream.seek(end)
            head = stream.read(9)
            beyond = end + 9 + int.from_bytes(head[1:], "little")
            if len(head) < 9 or not 0 < head[0] < _DATA_END or beyond > size:
                return end
            end = beyond
