"""Where results are published: the camera's frame, or a robot's by a calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.store import read_json
from tumortrack.live.values import PublishedFrame

_LARGEST_MM, _LARGEST_DEG = 100.0, 10.0  # with more, it is no calibration
_NOT_RIGID = 1e-3  # largest deviation of a rotation from orthonormal: files have few digits

_MATRICES = ("camera_from_robot", "robot_from_camera", "camera_from_marker", "robot_from_marker")

Rows = tuple[tuple[float, float, float, float], ...]


class CalibrationFile(Config, frozen=True, kw_only=True):
    """A file that says where the camera is, in one of three ways, each by 4 x 4 rows:
    ``camera_from_robot`` or ``robot_from_camera``, of a hand-eye calibration, or
    ``camera_from_marker`` with ``robot_from_marker``: a marker that both know. ``unit``: of the
    translations, and of a plane's offset. ``frame_id``: the robot's frame, as ROS calls it;
    ``camera_frame_id``: the camera's optical frame, as the source's messages call it;
    ``table_in_camera``: the table's plane in the camera's frame, unit normal (3) and offset.
    ``error_mm`` and ``error_deg``: bounds of the calibration's error, at the camera and of its
    direction; without ``error_deg`` the first holds at the organ."""

    frame_id: str
    unit: Literal["mm", "m"]
    camera_from_robot: Rows | None = None
    robot_from_camera: Rows | None = None
    camera_from_marker: Rows | None = None
    robot_from_marker: Rows | None = None
    camera_frame_id: str = ""
    table_in_camera: tuple[float, float, float, float] | None = None
    error_mm: float | None = None
    error_deg: float = 0.0

    def __post_init__(self) -> None:
        if self.error_mm is None and self.error_deg:
            raise InputError("error_deg needs error_mm beside it: that of the translation.")
        if self.error_mm is not None and not 0 < self.error_mm <= _LARGEST_MM:
            raise InputError(f"error_mm is {self.error_mm:g}; allowed: over 0 to {_LARGEST_MM:g}.")
        if not 0 <= self.error_deg <= _LARGEST_DEG:
            raise InputError(f"error_deg is {self.error_deg:g}; allowed: 0 to {_LARGEST_DEG:g}.")


def read_frames(path: Path) -> PublishedFrame:
    """The robot's frame of a calibration file (JSON; keys as in ``CalibrationFile``). Raises
    InputError if it is missing, or has an unknown key, a matrix that is no rigid transform, or not
    exactly one of the three ways."""
    file = from_builtins(read_json(path), CalibrationFile, str(path))
    matrices = {
        name: _rigid(rows, file.unit, f"{path}: {name}")
        for name in _MATRICES
        if (rows := getattr(file, name)) is not None
    }
    match list(matrices.items()):
        case [("robot_from_camera", robot_from_camera)]:
            pass
        case [("camera_from_robot", camera_from_robot)]:
            robot_from_camera = np.linalg.inv(camera_from_robot)
        case [("camera_from_marker", camera_from_marker), ("robot_from_marker", robot_from_marker)]:
            robot_from_camera = robot_from_marker @ np.linalg.inv(camera_from_marker)
        case _:
            raise InputError(
                f"{path} must have camera_from_robot, or robot_from_camera, or camera_from_marker "
                f"and robot_from_marker; it has {', '.join(matrices) or 'none of them'}."
            )
    if not file.frame_id.strip():
        raise InputError(f"{path}: frame_id is empty; give the robot's frame, base_link say.")
    table, camera = file.table_in_camera, file.camera_frame_id.strip().removeprefix("/")
    if table is not None:
        if not abs(np.linalg.norm(table[:3]) - 1) < _NOT_RIGID or not np.isfinite(table[3]):
            raise InputError(
                f"{path}: table_in_camera must be a unit normal (3 numbers) and the plane's offset "
                f"in {file.unit}, camera frame, as a run's report says it."
            )
        unit = float(np.linalg.norm(table[:3]))  # but for the file's few digits
        x, y, z, offset = (number / unit for number in table)
        table = x, y, z, offset * (1000 if file.unit == "m" else 1)
    error = file.error_mm, file.error_deg
    return PublishedFrame(file.frame_id, robot_from_camera, True, camera, table, *error)


def _rigid(rows: Rows, unit: str, where: str) -> Float64[np.ndarray, "4 4"]:
    if len(rows) != 4:
        raise InputError(f"{where} has {len(rows)} rows; it must have 4 of 4 numbers.")
    b_from_a = np.array(rows, float)
    turn = b_from_a[:3, :3]
    good = (
        np.isfinite(b_from_a).all()
        and np.abs(turn @ turn.T - np.eye(3)).max() < _NOT_RIGID
        and np.linalg.det(turn) > 0
        and np.array_equal(b_from_a[3], [0, 0, 0, 1])
    )
    if not good:
        raise InputError(
            f"{where} is no rigid transform: its rotation must be orthonormal and right-handed, "
            "its last row 0 0 0 1."
        )
    if unit == "m":
        b_from_a[:3, 3] *= 1000
    return b_from_a
