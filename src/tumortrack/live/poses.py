"""Where a camera that moves is at a frame's stamp: stamped poses from a file, interpolated."""

from __future__ import annotations

import csv
import io
import threading
from abc import abstractmethod
from bisect import bisect_left
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.store import read_file
from tumortrack.live.display import wxyz_of
from tumortrack.live.values import Observation

# Between two poses an arm that speeds up by 1 m/s2 is off the straight way by at most a t^2 / 8 =
# 1.3 mm, about what is allowed for a camera's place (``sense.noise.CAMERA_STD``).
_GAP_NS = 100_000_000
_KEPT = 2000  # poses of a live source: 4 s at 500 Hz
_NOT_UNIT = 1e-3  # of a quaternion's length: files have few digits
_UNKNOWN = "where the camera was is unknown"
_LARGEST_TABLE = 256 * 2**20  # bytes
COLUMNS = ("stamp_ns", "frame_id", "x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz")


@runtime_checkable
class CameraPoses(Protocol):
    """Where a camera is. One thread calls ``at``; ``frame_id`` names the fixed frame."""

    frame_id: str

    def at(self, seen: Observation) -> Affine:
        """Fixed frame from the camera, or from the tool that holds it, at the observation's stamp.
        Raises NoEstimate: no pose is known then."""
        ...

    def close(self) -> None: ...


class PosesConfig(Config, frozen=True, kw_only=True, tag_field="kind"):
    """Base of what says where a moving camera is; as ``live.values.SourceConfig``."""

    target: ClassVar[str] = ""

    @abstractmethod
    def open(self) -> CameraPoses:
        """Raises InputError if it can never work."""


class ToolPoses:
    """Of a camera on a tool, whose poses are known."""

    def __init__(self, poses: CameraPoses, tool_from_camera: Affine) -> None:
        self._poses, self._tool_from_camera = poses, tool_from_camera
        self.frame_id = poses.frame_id

    def at(self, seen: Observation) -> Affine:
        return self._poses.at(seen) @ self._tool_from_camera

    def close(self) -> None:
        self._poses.close()


class PoseBuffer:
    """Stamped poses of one thing, in the order of their stamps. One thread may add while another
    asks."""

    def __init__(self, kept: int | None = _KEPT) -> None:
        self._stamps_ns: list[int] = []
        self._poses: list[Affine] = []
        self._kept = kept
        self._lock = threading.Condition()

    def add(self, stamp_ns: int, pose: Affine) -> None:
        """A pose whose stamp goes back begins anew: the clock was set back."""
        with self._lock:
            if self._stamps_ns and stamp_ns <= self._stamps_ns[-1]:
                if stamp_ns == self._stamps_ns[-1]:
                    return
                self._stamps_ns, self._poses = [], []
            self._stamps_ns.append(stamp_ns)
            self._poses.append(pose)
            if self._kept is not None:
                del self._stamps_ns[: -self._kept], self._poses[: -self._kept]
            self._lock.notify_all()

    def reaches(self, stamp_ns: int) -> bool:
        """Whether a pose of then, or later, has come."""
        return bool(self._stamps_ns) and self._stamps_ns[-1] >= stamp_ns

    def at(self, stamp_ns: int, wait_s: float = 0.0) -> Affine:
        """The pose then: between its neighbours, shifted linearly and turned at a constant rate
        (slerp). ``wait_s``: for the later one. Raises NoEstimate: there is none, or the neighbours
        are too far apart."""
        with self._lock:
            self._lock.wait_for(lambda: self.reaches(stamp_ns), wait_s)
            stamps_ns, poses = self._stamps_ns, self._poses
            if not stamps_ns:
                raise NoEstimate(f"{_UNKNOWN}: no pose has come")
            place = bisect_left(stamps_ns, stamp_ns)
            if place < len(stamps_ns) and stamps_ns[place] == stamp_ns:
                return poses[place]
            if place in (0, len(stamps_ns)):
                late_s = (stamp_ns - stamps_ns[place and -1]) * 1e-9
                which = "last pose is older" if place else "first pose is newer"
                raise NoEstimate(f"{_UNKNOWN}: its {which} than the frame by {abs(late_s):.2f} s")
            before_ns, after_ns = stamps_ns[place - 1 : place + 1]
            a, b = poses[place - 1 : place + 1]
        if after_ns - before_ns > _GAP_NS:
            raise NoEstimate(
                f"{_UNKNOWN}: its poses before and after the frame are "
                f"{(after_ns - before_ns) * 1e-9:.2f} s apart; allowed: {_GAP_NS * 1e-9:g} s"
            )
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        turns = Slerp([0, 1], Rotation.from_matrix([a[:3, :3], b[:3, :3]]))([share])
        return rigid(turns.as_matrix()[0], (1 - share) * a[:3, 3] + share * b[:3, 3])


class PosesFileConfig(PosesConfig, frozen=True, kw_only=True, tag="file"):
    """A table of stamped poses (CSV; docs/conventions.md), as the sink ``recording`` writes it."""

    target: ClassVar[str] = "path"

    path: Path

    def open(self) -> FilePoses:
        return FilePoses(self.path)


class FilePoses:
    """See ``CameraPoses``. Raises InputError: no such table, or one that is damaged."""

    def __init__(self, path: Path) -> None:
        self._poses, self.frame_id = PoseBuffer(None), ""
        last_ns = -1
        try:
            text = read_file(path, _LARGEST_TABLE).decode("utf-8")
            for number, row in enumerate(csv.DictReader(io.StringIO(text)), start=2):
                stamp_ns, frame_id = int(row["stamp_ns"]), row["frame_id"].strip()
                shift, turn = (np.array([float(row[n]) for n in names]) for names in _NUMBERS)
                faults = {
                    "its stamp must be later than the one before": stamp_ns > last_ns,
                    "frame_id must be one name, in every row": frame_id
                    and self.frame_id in ("", frame_id),
                    "x_mm, y_mm, z_mm must be finite": np.isfinite(shift).all(),
                    "qw, qx, qy, qz must have length 1": abs(np.linalg.norm(turn) - 1) < _NOT_UNIT,
                }
                if wrong := [what for what, met in faults.items() if not met]:
                    raise InputError(f"{path}, line {number}: {wrong[0]}.")
                last_ns, self.frame_id = stamp_ns, frame_id
                way = rigid(Rotation.from_quat(turn, scalar_first=True).as_matrix(), shift)
                self._poses.add(stamp_ns, way)
        except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
            raise InputError(
                f"{path} cannot be read as a table of poses: {error}. It must have the columns "
                f"{','.join(COLUMNS)}."
            ) from error
        if last_ns < 0:
            raise InputError(f"{path} has no poses.")

    def at(self, seen: Observation) -> Affine:
        return self._poses.at(seen.stamp_ns)

    def close(self) -> None:
        pass


_NUMBERS = COLUMNS[2:5], COLUMNS[5:]


def pose_row(stamp_ns: int, frame_id: str, pose: Affine) -> str:
    """A line of such a table."""
    turn, shift = wxyz_of(pose[:3, :3]), pose[:3, 3]
    numbers = [f"{n:.6f}" for n in shift.tolist()] + [f"{n:.9f}" for n in turn.tolist()]
    return ",".join([str(stamp_ns), frame_id, *numbers]) + "\n"
