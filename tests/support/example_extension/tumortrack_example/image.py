"""One depth image again and again, as a camera that stands still: ``image:FOLDER``."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from tumortrack.core.types import DepthFrame
from tumortrack.io.depth_files import read_depth_png
from tumortrack.live.values import Observation, SourceConfig, SourceLost


class ImageSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="image"):
    """``depth.png`` and ``intrinsics.json`` of a folder, ``fps`` times a second."""

    target: ClassVar[str] = "folder"

    folder: Path
    fps: float = 30.0

    def open(self) -> ImageSource:
        frame = read_depth_png(self.folder / "depth.png", self.folder / "intrinsics.json")
        return ImageSource(frame, 1 / self.fps)


class ImageSource:
    host_clock = True  # stamps are time.time_ns
    lossless = False  # the newest frame wins
    on_demand = True  # no camera: where no frame comes, this computer is slow
    dropped = 0

    def __init__(self, frame: DepthFrame, period_s: float) -> None:
        self._frame, self._period_s = frame, period_s
        self._next_s = time.monotonic()
        self._closed = threading.Event()

    def read(self, timeout_s: float) -> Observation | None:
        wait_s = self._next_s - time.monotonic()
        if self._closed.wait(max(0.0, min(wait_s, timeout_s))):
            raise SourceLost("the image source is closed; open it again.")
        if wait_s > timeout_s:
            return None
        self._next_s = time.monotonic() + self._period_s
        now_ns = time.time_ns()
        return Observation(replace(self._frame, stamp_ns=now_ns), arrived_ns=now_ns)

    def close(self) -> None:
        self._closed.set()
