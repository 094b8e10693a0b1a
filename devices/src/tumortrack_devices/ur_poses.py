"""Poses of a camera, or of another tool, that an arm of Universal Robots holds."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, rigid
from tumortrack.live.poses import CameraPoses, PoseBuffer, PosesConfig
from tumortrack.live.values import Observation

_TICK_S = 0.004  # UR controllers send at 500 Hz (e-Series) or 125 Hz (CB3)
_WAIT_S = 0.05  # for a UR pose after the frame's stamp


class UrPosesConfig(PosesConfig, frozen=True, kw_only=True, tag="ur"):
    """The tool of the arm of Universal Robots at ``host`` in its base's frame, by the controller's
    tool centre point, which must be as at the hand-eye calibration. It only reads."""

    target: ClassVar[str] = "host"

    host: str

    def open(self) -> UrPoses:
        return UrPoses(self.host)


class UrPoses(CameraPoses):
    """Through ur_rtde. Poses have the time of their arrival: milliseconds late. ``felt`` gets that
    stamp and the force at the tool, N and Nm (6). Raises InputError: ur_rtde is missing, or the arm
    cannot be reached."""

    def __init__(self, host: str, felt: Callable[[int, np.ndarray], None] | None = None) -> None:
        try:
            import rtde_receive

            self._receive = rtde_receive.RTDEReceiveInterface(host)
        except (ImportError, RuntimeError) as error:
            raise InputError(
                f"ur: the arm at {host} cannot be read ({error}). That needs ur_rtde (pip install "
                "'tumortrack-devices[ur]') and an arm that is on, and reachable on port 30004."
            ) from error
        self.poses, self._felt, self._closed = PoseBuffer(), felt, threading.Event()
        threading.Thread(target=self._read, name="ur poses", daemon=True).start()

    def pose(self, seen: Observation) -> Affine:
        return self.poses.at(seen.stamp_ns, _WAIT_S)

    def close(self) -> None:
        self._closed.set()

    def _read(self) -> None:
        """An arm that falls silent repeats its clock: no pose is added, and frames find none."""
        last_s = -1.0
        while not self._closed.wait(_TICK_S):
            if (clock_s := self._receive.getTimestamp()) != last_s and self._receive.isConnected():
                last_s, numbers = clock_s, np.array(self._receive.getActualTCPPose(), float)
                turn = Rotation.from_rotvec(numbers[3:]).as_matrix()
                self.poses.add(now_ns := time.time_ns(), rigid(turn, 1000 * numbers[:3]))
                if self._felt is not None:
                    self._felt(now_ns, np.array(self._receive.getActualTCPForce(), float))
        self._receive.disconnect()
