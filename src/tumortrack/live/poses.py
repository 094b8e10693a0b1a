"""The pose of a moving camera at a frame's stamp, interpolated; and poses from a file."""

from __future__ import annotations

import threading
from abc import abstractmethod
from bisect import bisect_left
from pathlib import Path
from typing import ClassVar

from tumortrack.core.config import Config
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import IDENTITY, Affine, rigid
from tumortrack.core.report import Finding
from tumortrack.io.csv_tables import read_pose_table
from tumortrack.live.values import Observation

# Between two poses an arm that accelerates by 1 m/s2 deviates from linear interpolation by at most
# a t^2 / 8 = 1.3 mm, about the tolerance of a camera's place (``simulation.noise.CAMERA_STD``).
_GAP_NS = 100_000_000
_BACK_NS = 1_000_000_000
_KEPT = 2000  # poses of a live source: 4 s at 500 Hz


class CameraPoses:
    """Poses of a camera, or of the tool that holds it at ``tool_from_camera``; for one thread.
    ``frame_id`` names the fixed frame; empty: unknown."""

    frame_id = ""
    tool_from_camera = IDENTITY

    def at(self, seen: Observation) -> Affine:
        """Fixed frame from camera at the observation's stamp. Raises NoEstimate: it is unknown."""
        return self.pose(seen) @ self.tool_from_camera

    @abstractmethod
    def pose(self, seen: Observation) -> Affine:
        """The same without the tool."""

    def known(self, seconds: float) -> dict[tuple[str, str], Affine]:
        """The newest ``b_from_a`` of all (b, a) heard of within so long, where it hears of any."""
        return {}

    def close(self) -> None:
        """Release everything."""


class PosesConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of configurations of a moving camera's poses; as ``live.values.SourceConfig``."""

    target: ClassVar[str] = ""

    @abstractmethod
    def open(self) -> CameraPoses:
        """Raises InputError if it can never work."""


class PoseBuffer:
    """The latest stamped poses of one thing. One thread may add while another asks."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._poses: list[Affine] = []
        self._lock = threading.Condition()

    def add(self, stamp_ns: int, pose: Affine, kept: int = _KEPT) -> None:
        """A pose that is out of order is ignored; if its stamp goes back by more than a second, all
        earlier ones are discarded: the clock was set back."""
        with self._lock:
            if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
                if stamp_ns > self._stamps_ns[-1] - _BACK_NS:
                    return
                self._stamps_ns, self._poses = [], []
            self._stamps_ns.append(stamp_ns)
            self._poses.append(pose)
            del self._stamps_ns[:-kept], self._poses[:-kept]
            self._lock.notify_all()

    @property
    def newest(self) -> Affine:
        """There is one."""
        return self._poses[-1]

    def at(self, stamp_ns: int, wait_s: float = 0.0) -> Affine:
        """Interpolated between its neighbours (linear, slerp). ``wait_s``: for the later one.
        Raises NoEstimate: one is missing, or they are too far apart."""
        with self._lock:
            self._lock.wait_for(lambda: max(self._stamps_ns, default=-1) >= stamp_ns, wait_s)
            place, stamps_ns = bisect_left(self._stamps_ns, stamp_ns), self._stamps_ns
            if stamp_ns in stamps_ns[place : place + 1]:
                return self._poses[place]
            if not stamps_ns:
                raise NoEstimate(Finding("no_pose"))
            if place in (0, len(stamps_ns)):
                off_s = abs(stamp_ns - stamps_ns[place and -1]) * 1e-9
                raise NoEstimate(
                    Finding("old_pose" if place else "new_pose", {"seconds": float(off_s)})
                )
            before_ns, after_ns = stamps_ns[place - 1 : place + 1]
            a, b = self._poses[place - 1 : place + 1]
        if (gap_ns := after_ns - before_ns) > _GAP_NS:
            values = {"seconds": float(gap_ns * 1e-9), "allowed_s": _GAP_NS * 1e-9}
            raise NoEstimate(Finding("pose_gap", values))
        from scipy.spatial.transform import Rotation, Slerp  # slow to import

        share = (stamp_ns - before_ns) / gap_ns
        turns = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))([share])
        return rigid(turns.as_matrix()[0], (1 - share) * a[:3, 3] + share * b[:3, 3])


class PosesFileConfig(PosesConfig, frozen=True, kw_only=True, tag="file"):
    """A table of stamped poses (CSV; docs/conventions.md), as the sink ``recording`` writes it."""

    target: ClassVar[str] = "path"

    path: Path

    def open(self) -> FilePoses:
        return FilePoses(self.path)


class FilePoses(CameraPoses):
    """``touches``: where the table says it, of each stamp (ns) whether the tip touches. Raises
    InputError: there is no such table, or it is damaged."""

    def __init__(self, path: Path) -> None:
        table = read_pose_table(path)
        self.frame_id, self.poses = table.frame_id, PoseBuffer()
        self.stamps_ns = table.stamps_ns
        stamps_ns = table.stamps_ns.tolist()
        for stamp_ns, pose in zip(stamps_ns, table.poses, strict=True):
            self.poses.add(stamp_ns, pose, len(stamps_ns))
        self.touches = list(zip(stamps_ns, table.touches, strict=False))

    def pose(self, seen: Observation) -> Affine:
        return self.poses.at(seen.stamp_ns)


def pose_row(stamp_ns: int, frame_id: str, pose: Affine) -> str:
    """A line of a table of poses."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    numbers = [*pose[:3, 3].tolist(), *turn.tolist()]
    return ",".join([str(stamp_ns), frame_id, *(f"{number:.9f}" for number in numbers)]) + "\n"
