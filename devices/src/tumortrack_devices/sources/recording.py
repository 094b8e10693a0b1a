"""A recording as a source: at the pace of its stamps, or as fast as the loop takes frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

from tumortrack.core.errors import InputError
from tumortrack.core.patient import NOBODY, Patient, patient_in
from tumortrack.core.store import read_json
from tumortrack.live.values import Observation, SourceConfig, SourceEnded, SourceLost
from tumortrack_devices.recording.bags import BagRecording, bag_contents, bag_files
from tumortrack_devices.recording.folders import ABOUT, RecordedFrame, folder_frames

Frames = Callable[[], Iterator[RecordedFrame]]
_LONGEST_WAIT_S = 2.0  # less than what the loop takes for a frozen source


class RecordingSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="recording"):
    """Frames from disk: a folder (clouds, depth images, scene folders), a rosbag2 or ROS 1 bag,
    or what the sink ``recording`` wrote.

    Attributes:
        rate: 1 plays at the pace of the stamps, 2 twice as fast; 0: every frame, as fast as the
            loop takes them. Pauses are cut to 2 s.
        fps: of files without stamps.
        unit: of cloud files; bags are in metres, depth images state theirs.
        topic, info_topic: of a bag with several.
        rectified: the images are rectified: P of the bag's camera_info holds.
        unit_mm: one step of a bag's 16-bit depth images.
    """

    target: ClassVar[str] = "path"

    path: Path
    rate: float = 1.0
    fps: float = 30.0
    unit: Literal["mm", "m"] = "mm"
    topic: str = ""
    info_topic: str = ""
    rectified: bool = False
    unit_mm: float = 1.0

    def __post_init__(self) -> None:
        if self.rate != 0 and not 0.01 <= self.rate <= 100:
            raise InputError(
                f"recording: rate is {self.rate:g}; it must lie in 0.01..100, or be 0 for as fast "
                "as it goes."
            )
        self.check_between("recording:", fps=(0.01, 1000))
        if not 0 < self.unit_mm <= 100:
            raise InputError(f"recording: unit_mm is {self.unit_mm:g}; it must lie in 0..100 mm.")

    def patient(self) -> Patient:
        if not self.path.exists():
            raise InputError(f"{self.path} does not exist, so it cannot be played.")
        about = self.about
        return patient_in(read_json(about).get("patient"), str(about)) if about else NOBODY

    @classmethod
    def describe(cls, path: Path) -> list[str]:
        if not bag_files(path):
            frames = len(folder_frames(path, 30.0, "mm"))
            return [f"{frames} frames, a file each; `track` plays them from recording:{path}"]
        counts, seconds = bag_contents(path)
        files = [path] if path.is_file() else path.rglob("*")
        size_mb = sum(file.stat().st_size for file in files) / 2**20
        lines = [f"a recording of {seconds:.1f} s, {size_mb:.1f} MB"]
        about = cls(path=path).about
        stated = read_json(about) if about else {}
        match stated.get("patient"):
            case {"id": name, "side": side} if name and side:
                lines.append(f"patient {name}, side {side}")
        if stated.get("corrected"):
            lines.append("its depths were corrected by --intrinsics")
        for topic, count in counts.items():
            rate = f", {(count - 1) / seconds:.1f} a second" if seconds else ""
            lines.append(f"{topic}: {count} frame{'s' * (count != 1)}{rate}")
        return lines

    @property
    def is_corrected(self) -> bool:
        """Whether the recording states that its depths are corrected."""
        return self.about is not None and read_json(self.about).get("corrected") is True

    @property
    def about(self) -> Path | None:
        about = (self.path if self.path.is_dir() else self.path.parent) / ABOUT
        return about if about.is_file() else None

    def open(self) -> RecordingSource:
        """Find the frames; none is read yet. Raises InputError if there are none."""
        self.patient()
        if bag_files(self.path):
            options = self.topic, self.info_topic, self.rectified, self.unit_mm
            bag = BagRecording(self.path, *options)
            return RecordingSource(self, bag.frames, bag.close)
        frames = folder_frames(self.path, self.fps, self.unit)
        return RecordingSource(self, partial(iter, frames), lambda: None)


class RecordingSource:
    """Plays ``frames`` from first to last. Frames that were due before they could be read are
    dropped, unless it is ``lossless``. A damaged frame raises InputError, and the next read
    continues after it."""

    host_clock = False  # the stamps are those of the recording
    on_demand = True

    def __init__(
        self, config: RecordingSourceConfig, frames: Frames, close: Callable[[], None]
    ) -> None:
        self.lossless, self.dropped = config.rate == 0, 0
        self._close, self._rate = close, config.rate
        self._frames = frames()
        self._next: RecordedFrame | None = None
        self._shown_ns: int | None = None  # stamp of the previous frame
        self._due_s = 0.0  # when the next one is due, by time.monotonic
        self._closed = threading.Event()
        self._lock = threading.Lock()  # close may come while a frame is being read

    def read(self, timeout_s: float) -> Observation | None:
        with self._lock:
            frame = self._newest_due()
        if frame is None:
            self._closed.wait(min(timeout_s, max(self._due_s - time.monotonic(), 0)))
        with self._lock:
            if frame is None and (frame := self._newest_due()) is None:
                return None
            seen = frame.load()
        content = seen.content
        if content.stamp_ns != frame.stamp_ns:
            content = replace(content, stamp_ns=frame.stamp_ns)
        return replace(seen, content=content, arrived_ns=time.time_ns())

    def close(self) -> None:
        self._closed.set()
        with self._lock:
            self._close()

    def _newest_due(self) -> RecordedFrame | None:
        """The latest frame that is due; earlier ones are dropped."""
        due: RecordedFrame | None = None
        while True:
            if self._closed.is_set():
                raise SourceLost("the recording is closed; open it again.")
            if self._next is None and (ahead := next(self._frames, None)) is not None:
                if self._shown_ns is None or self.lossless:
                    self._due_s = time.monotonic()
                else:
                    gap_s = max(ahead.stamp_ns - self._shown_ns, 0) * 1e-9 / self._rate
                    self._due_s += min(gap_s, _LONGEST_WAIT_S)
                self._next, self._shown_ns = ahead, ahead.stamp_ns
            if self._next is None and due is None:
                raise SourceEnded("the recording is at its end.")
            if self._next is None or self._due_s > time.monotonic():
                return due
            self.dropped += due is not None
            due, self._next = self._next, None
            if self.lossless:
                return due
