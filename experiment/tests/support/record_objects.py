"""A bench in small: a table with an organ on it, seen as fast as it is asked for."""

from __future__ import annotations

import os
import signal
from typing import ClassVar

import numpy as np

from tumortrack.core.types import DepthFrame, Intrinsics, SensorCloud
from tumortrack.live.values import Observation, SourceConfig, SourceEnded, SourceLost

CAMERA = Intrinsics(96, 72, 60.0, 60.0, 47.5, 35.5)
TABLE_MM, PERIOD_NS, BEGIN_NS = 190.0, 33_333_333, 1_790_000_000_000_000_000
SPEC = "record_objects:SmallBenchConfig"


class SmallBenchConfig(SourceConfig, frozen=True, kw_only=True, tag="small"):
    """``organ``: wobbles | sinks | still; ``lift_mm``: of the camera; ``grey``: of its picture,
    0: none; ``noise_mm``; ``frames`` until it ends, ``lost_at`` and ``kill_at``: frames at which it
    breaks, or the process is killed; ``cloud``: it gives clouds; ``frame_id`` of the camera."""

    target: ClassVar[str] = "organ"

    organ: str = "still"
    lift_mm: float = 0.0
    noise_mm: float = 0.2
    hole_share: float = 0.0
    grey: int = 0
    frames: int = 10_000
    lost_at: int = -1
    kill_at: int = -1
    cloud: bool = False
    frame_id: str = ""
    taken: ClassVar[list[Observation]] = []
    number: ClassVar[list[int]] = [0]

    def open(self) -> SmallBench:
        return SmallBench(self)


class SmallBench:
    """Its stamps go on from one opening to the next."""

    host_clock, lossless, on_demand, dropped = False, True, True, 0

    def __init__(self, config: SmallBenchConfig) -> None:
        self._config, self._read = config, 0
        self._rng = np.random.default_rng(config.number[0])

    def read(self, timeout_s: float) -> Observation | None:
        config = self._config
        if self._read == config.kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        self._read += 1
        config.number[0] += 1
        if self._read - 1 == config.lost_at:
            raise SourceLost("the small bench is unplugged")
        if self._read > config.frames:
            raise SourceEnded("that was all")
        stamp_ns = BEGIN_NS + PERIOD_NS * config.number[0]
        frame = DepthFrame(self._depth_mm(), CAMERA, stamp_ns)
        if config.cloud:
            return Observation(SensorCloud(np.ones((9, 3)), stamp_ns), stamp_ns)
        picture = None
        if config.grey:
            picture = np.full((CAMERA.height, CAMERA.width, 3), config.grey, np.uint8)
            picture[0] = config.number[0] % 200
        name = config.frame_id or None
        observation = Observation(frame, stamp_ns + 1000, frame_id=name, picture=picture)
        config.taken.append(observation)
        return observation

    def close(self) -> None:
        pass

    def _depth_mm(self) -> np.ndarray:
        """A bump of 40 mm on a plane."""
        config = self._config
        rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
        slow = 2.0 * np.sin(self._read / 5) if config.organ == "wobbles" else 0.0
        slow += 0.1 * self._read if config.organ == "sinks" else 0.0
        bump = 40.0 * np.exp(-((rows - 36) ** 2 + (columns - 48) ** 2) / 250.0)
        depth_mm = TABLE_MM + config.lift_mm - bump + slow * (bump > 5)
        depth_mm += self._rng.normal(0, config.noise_mm, depth_mm.shape)
        depth_mm[self._rng.random(depth_mm.shape) < config.hole_share] = np.nan
        return depth_mm.astype(np.float32)
