"""Poses of a camera, or of another tool, that an arm of Universal Robots holds.

By RTDE, protocol 2 (the maker's guide to the Real-Time Data Exchange), of which three requests and
one kind of package are needed. Not by ur_rtde: an arm that hung up and is connected again, or that
accepts and says nothing, crashes it, or holds the whole process up for 5 s (version 1.6.5).
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.report import Finding
from tumortrack.live.poses import CameraPoses, PoseBuffer, PosesConfig
from tumortrack.live.values import Observation

_WAIT_S = 0.05  # for a UR pose after the frame's stamp
_PORT = 30004
_RETRY_S = 1.0  # of silence, and between attempts to connect
_VERSION, _OUTPUTS, _START, _DATA = b"VOSU"  # kinds of packages
_WANTED = struct.pack(">d", 125.0) + b"actual_TCP_pose,actual_TCP_force"  # Hz: every UR can
_HAS = b"VECTOR6D,VECTOR6D"


class UrPosesConfig(PosesConfig, frozen=True, kw_only=True, tag="ur"):
    """The tool of the arm of Universal Robots at ``host`` in its base's frame, by the controller's
    tool centre point, which must be as at the hand-eye calibration. It only reads."""

    target: ClassVar[str] = "host"

    host: str

    def open(self) -> UrPoses:
        return UrPoses(self.host)


class UrPoses(CameraPoses):
    """Poses have the time of their arrival: milliseconds late. ``felt`` gets that stamp and the
    force at the tool, N and Nm (6). ``trouble``: nothing is heard of the arm, which is connected
    again until it speaks. Raises InputError: it cannot be reached."""

    def __init__(self, host: str, felt: Callable[[int, np.ndarray], None] | None = None) -> None:
        self.poses, self._felt, self._closed = PoseBuffer(), felt, threading.Event()
        self.trouble, self._host = "", host
        try:
            link = _Link(host)
        except (OSError, ValueError) as error:  # ValueError: a name that cannot be one
            raise InputError(
                f"ur: the arm at {host}, port {_PORT}, cannot be read ({error}). Is it on?"
            ) from error
        self._thread = threading.Thread(
            target=self._read, args=(link,), name="ur poses", daemon=True
        )
        self._thread.start()

    def pose(self, seen: Observation) -> Affine:
        try:
            return self.poses.at(seen.stamp_ns, _WAIT_S)
        except NoEstimate as error:
            if not (trouble := self.trouble):
                raise
            raise NoEstimate(Finding("source", {"message": trouble})) from error

    def close(self) -> None:
        self._closed.set()
        self._thread.join()

    def _read(self, link: _Link | None) -> None:
        while not self._closed.is_set():
            try:
                link = link or _Link(self._host)
                while not self._closed.is_set():
                    self._hear(link.newest())
            except OSError as error:
                self.trouble = f"the arm at {self._host} is lost ({error}); it is tried again"
                if link:
                    link.close()
                link = None
                self._closed.wait(_RETRY_S)
        if link:
            link.close()

    def _hear(self, numbers: np.ndarray) -> None:
        turn = Rotation.from_rotvec(numbers[3:6]).as_matrix()
        self.poses.add(now_ns := time.time_ns(), rigid(turn, 1000 * numbers[:3]))
        if self._felt is not None:
            self._felt(now_ns, numbers[6:])
        self.trouble = ""


class _Link:
    """A connection that has begun. Everything raises OSError if the arm is silent or hangs up."""

    def __init__(self, host: str) -> None:
        self._heard, self._socket = b"", socket.create_connection((host, _PORT), _RETRY_S)
        try:
            self._ask(_VERSION, struct.pack(">H", 2), b"\x01")
            self._ask(_OUTPUTS, _WANTED, _HAS)
            self._ask(_START, b"", b"\x01")
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        self._socket.close()

    def newest(self) -> np.ndarray:
        """Pose (m, rotation vector) and force, 12: what came before was late already."""
        if len(content := self._take(_DATA)[1:]) != 96:
            raise ConnectionError("it sends something else")
        return np.frombuffer(content, ">f8").astype(float)

    def _ask(self, kind: int, content: bytes, wanted: bytes) -> None:
        self._socket.sendall(struct.pack(">HB", 3 + len(content), kind) + content)
        if not (said := self._take(kind)).endswith(wanted):
            raise ConnectionError(f"it answered {said!r}")

    def _take(self, kind: int) -> bytes:
        """Of that kind, the last that has come by now; others, such as texts, are passed over."""
        until_s, found = time.monotonic() + _RETRY_S, b""
        while not found:
            if not (more := self._socket.recv(65536)) or time.monotonic() > until_s:
                raise ConnectionError("it says nothing")
            self._heard += more
            while len(self._heard) >= max(3, size := int.from_bytes(self._heard[:2])):
                if size < 3:
                    raise ConnectionError("it does not speak RTDE")
                whole, self._heard = self._heard[:size], self._heard[size:]
                found = whole[3:] if whole[2] == kind else found
        return found
