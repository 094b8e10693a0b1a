"""A stereo endoscope, or any two cameras side by side, as a source of depth images.

A thread keeps the newest pair of two devices: OpenCV's queue would hand over old pictures. The
cameras must be synchronised, as an endoscope's are.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.values import Observation, SourceConfig, SourceEnded, SourceLost
from tumortrack_devices.stereo import StereoRig, opencv, read_calibration


class StereoSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="stereo"):
    """Two devices' numbers (/dev/videoN), two videos, or pictures numbered as in left_%04d.png:
    ``stereo:LEFT,RIGHT?calibration=FILE``.

    Attributes:
        pair: the left and the right one, separated by a comma.
        calibration: OpenCV's stereo calibration (``read_calibration``).
        near_mm, far_mm: range of depths.
        block_px: side of the compared blocks: larger ones are less noisy, and spread the nearer
            surface farther over edges.
        fps: of files; their stamps begin at 0.
    """

    target: ClassVar[str] = "pair"

    pair: str
    calibration: Path
    near_mm: float = 50.0
    far_mm: float = 400.0
    block_px: int = 7
    fps: float = 30.0

    def __post_init__(self) -> None:
        deep, side = (1.0, 10_000.0), (3, 21)
        self.check_between("stereo:", fps=(0.01, 1000), near_mm=deep, far_mm=deep, block_px=side)
        if self.near_mm >= self.far_mm or self.block_px % 2 == 0:
            raise InputError("stereo: near_mm must be less than far_mm, and block_px odd.")
        sides = self.pair.split(",")
        if len(sides) != 2 or sides[0].isdecimal() != sides[1].isdecimal():
            raise InputError(
                f"stereo: {self.pair!r} is no pair; write LEFT,RIGHT: two devices' numbers, or two "
                "files."
            )

    def open(self) -> StereoSource:
        options = self.near_mm, self.far_mm, self.block_px, str(self.calibration)
        rig = StereoRig(read_calibration(self.calibration), *options)
        left, right = self.pair.split(",")
        return StereoSource(rig, (left, right), self.fps)


class StereoSource:
    """Depth images with the rectified left picture: from devices the newest, from files all."""

    dropped = 0

    def __init__(self, rig: StereoRig, pair: tuple[str, str], fps: float) -> None:
        self._rig, self._fps, self._cv2 = rig, fps, opencv()
        self.host_clock = pair[0].isdecimal()
        self.lossless = self.on_demand = not self.host_clock
        self._room, self._closed = threading.Condition(), False
        self._newest: tuple[list[np.ndarray], int] | None = None
        self._end: TumortrackError | None = None
        self._cameras = [self._opened(name) for name in pair]
        self._thread = threading.Thread(target=self._keep_reading, name="stereo", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Observation | None:
        with self._room:
            self._room.wait_for(lambda: self._newest or self._end or self._closed, timeout_s)
            if self._closed:
                raise SourceLost("the stereo cameras are closed; open them again.")
            if self._newest is None:
                if self._end is not None:
                    raise self._end
                return None
            pictures, stamp_ns = self._newest
            self._newest = None
            self._room.notify_all()
        arrived_ns = time.time_ns()
        left, right = self._rig.rectified(*pictures)
        return Observation(self._rig.depth(left, right, stamp_ns), arrived_ns, picture=left)

    def close(self) -> None:
        with self._room:
            self._closed = True
            self._room.notify_all()
        self._thread.join()

    def _opened(self, name: str) -> Any:
        cv2, device, camera = self._cv2, name.isdecimal(), self._rig.intrinsics
        with _quiet(cv2):
            capture = cv2.VideoCapture(int(name) if device else name)
        if device:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
        if not capture.isOpened():
            if device:
                raise SourceLost(f"/dev/video{name} does not open. Plug the camera in.")
            raise InputError(
                f"{name} cannot be read. Give a video, or pictures as FOLDER/left_%04d.png."
            )
        return capture

    def _keep_reading(self) -> None:
        number = 0
        while not self._closed and self._end is None:
            grabbed = [camera.grab() for camera in self._cameras]  # both first: decoding is slow
            stamp_ns = time.time_ns() if self.host_clock else round(number * 1e9 / self._fps)
            seen = [camera.retrieve() for camera in self._cameras] if all(grabbed) else []
            number += 1
            with self._room:
                if self.lossless:
                    self._room.wait_for(lambda: self._newest is None or self._closed)
                if seen and all(good for good, _ in seen):
                    self.dropped += self._newest is not None
                    convert, to_rgb = self._cv2.cvtColor, self._cv2.COLOR_BGR2RGB
                    self._newest = [convert(picture, to_rgb) for _, picture in seen], stamp_ns
                elif self.lossless:
                    self._end = SourceEnded(f"no pair of pictures follows the first {number - 1}.")
                else:
                    self._end = SourceLost("a camera gives no more pictures. Replug it.")
                self._room.notify_all()
        for camera in self._cameras:
            camera.release()


@contextmanager
def _quiet(cv2: ModuleType) -> Iterator[None]:
    """Without the lines of OpenCV and FFmpeg, whose matter is said in one of ours."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when the first file is opened
    logging = cv2.utils.logging
    before = logging.setLogLevel(logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logging.setLogLevel(before)
