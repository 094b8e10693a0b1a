"""A tool at an arm of Universal Robots, which feels by its force when it touches."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine
from tumortrack.live.values import SinkContext
from tumortrack_devices.tools.tip import TipConfig, TipTool
from tumortrack_devices.ur_poses import UrPoses

_REST_S = 2.0  # time constant of the mean force at rest: the weight's share drifts as the arm turns
_RELEASED = 0.5  # of the threshold: below that the contact has ended


class UrToolConfig(TipConfig, frozen=True, kw_only=True, tag="ur"):
    """The tool centre point of the arm at ``host``, in its base's frame. It only reads.
    ``force_n``: it touches when the force differs by that from its mean at rest, N."""

    target: ClassVar[str] = "host"

    host: str
    force_n: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_between("ur:", force_n=(0.2, 100))
        if self.electrode_mm:
            raise InputError("ur: its force does not tell that an electrode is energised.")

    def open(self, context: SinkContext, name: str) -> UrTool:
        return UrTool(self, context, name)


class UrTool(TipTool):
    """Raises InputError: the arm cannot be reached."""

    def __init__(self, config: UrToolConfig, context: SinkContext, name: str) -> None:
        super().__init__(config, context, name, "")
        self._threshold_n = config.force_n
        self._rest_n: np.ndarray | None = None
        self._felt_ns, self._feels = 0, False
        self._arm = UrPoses(config.host, self._feel)

    def pose(self, stamp_ns: int) -> Affine:
        return self._arm.poses.at(stamp_ns)

    def refresh(self, stamp_ns: int) -> None:
        self.trouble = self._arm.trouble or self.trouble

    def close(self) -> None:
        self._arm.close()

    def _feel(self, stamp_ns: int, force_n: np.ndarray) -> None:
        """Of the arm's own thread: the force at its tool (3 N, then 3 Nm)."""
        force_n = force_n[:3]
        if self._rest_n is None:
            self._rest_n, self._felt_ns = force_n, stamp_ns
        off_n = float(np.linalg.norm(force_n - self._rest_n))
        touches = off_n > self._threshold_n * (_RELEASED if self._feels else 1.0)
        if not touches:
            share = 1 - np.exp(-(stamp_ns - self._felt_ns) * 1e-9 / _REST_S)
            self._rest_n = self._rest_n + share * (force_n - self._rest_n)
        self._feels, self._felt_ns = touches, stamp_ns
        self.contact(stamp_ns, touches)
