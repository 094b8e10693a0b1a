"""The rehearsal's depth camera as a source for commands: ``rehearsal:FOLDER``.

FOLDER has ``camera.json``, the device's own intrinsics, and ``now.npy``, the depth image that it
would measure without noise, mm, which ``rehearsal.hands`` replaces.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import ClassVar

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.io.depth_files import read_intrinsics
from tumortrack.live.values import Observation, SourceConfig, SourceLost
from tumortrack.simulation.noise import D405_NOISE, add_noise


class BenchSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="rehearsal"):
    """A rehearsal's camera.

    Attributes:
        folder: with ``camera.json`` and ``now.npy``.
        fps: frames a second.
        seed: of the noise.
    """

    target: ClassVar[str] = "folder"

    folder: Path
    fps: float = 10.0
    seed: int = 0

    def open(self) -> BenchSource:
        """Raises InputError: there is no camera in the folder."""
        return BenchSource(self, read_intrinsics(self.folder / "camera.json"))


class BenchSource:
    """The present depth image, with a D405's noise."""

    host_clock, lossless, on_demand, dropped = True, False, True, 0

    def __init__(self, config: BenchSourceConfig, camera: Intrinsics) -> None:
        self._config, self._camera = config, camera
        self._rng = np.random.default_rng(config.seed)
        self._due = time.monotonic()
        self._closed = threading.Event()

    def read(self, timeout_s: float) -> Observation | None:
        """The next frame, when it is due. Raises SourceLost: closed; InputError: no image."""
        wait_s = self._due - time.monotonic()
        if self._closed.wait(max(min(wait_s, timeout_s), 0)):
            raise SourceLost("the rehearsal's camera is closed; open it again.")
        if wait_s > timeout_s:
            return None
        self._due = max(self._due + 1 / self._config.fps, time.monotonic())
        path = self._config.folder / "now.npy"
        try:
            depth_mm = np.load(path, allow_pickle=False)
        except (OSError, ValueError) as error:
            raise InputError(f"{path} shows nothing: {error}.") from error
        frame = DepthFrame(depth_mm, self._camera, time.time_ns())
        return Observation(add_noise(frame, D405_NOISE, self._rng), time.time_ns())

    def close(self) -> None:
        """May be called twice."""
        self._closed.set()
