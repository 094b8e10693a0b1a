"""Calibration files: the robot's frame, in which results are then published."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import read_rigid, rigid
from tumortrack.core.store import json_object, read_file, read_json
from tumortrack.io.csv_tables import number_in, text_of
from tumortrack.live.values import PublishedFrame

_LARGEST_MM, _LARGEST_DEG = 100.0, 10.0  # with more, it is no calibration
_NOT_UNIT = 1e-3  # tolerance of a normal's length: files have few digits
_TOOL = "tool_from_camera"

_YAML = (".yaml", ".yml", ".calib")
_LARGEST_YAML = 2**16  # bytes
_PAIR = re.compile(r"(\w+)[ \t]*:[ \t]*([^\s{},#]*)")
_PLACE, _TURN = ("x", "y", "z"), ("qx", "qy", "qz", "qw")

# Names of dvrk_camera_registration's files, which alone say whose base and which axes they mean.
_DVRK = re.compile(r"(\w+)-registration-(open-cv|dVRK)\.json", re.ASCII)
_LARGEST_DVRK = 2**16  # bytes
_UNNAMED = "camera"  # written where the camera's messages name no frame

Rows = tuple[tuple[float, float, float, float], ...]


class CalibrationFile(Config, frozen=True, kw_only=True):
    """The camera's pose, in one of three ways, each as 4 x 4 rows: ``camera_from_robot``,
    ``robot_from_camera``, or ``camera_from_marker`` with ``robot_from_marker``. For a camera that a
    robot moves: ``tool_from_camera``. ``unit``: of translations, and of the plane's offset.
    ``frame_id``: the robot's frame in ROS; the others as in ``PublishedFrame``."""

    frame_id: str
    unit: Literal["mm", "m"]
    camera_from_robot: Rows | None = None
    robot_from_camera: Rows | None = None
    camera_from_marker: Rows | None = None
    robot_from_marker: Rows | None = None
    tool_from_camera: Rows | None = None
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


class _BaseFrame(Config, frozen=True, kw_only=True, rename="kebab"):
    reference_frame: str
    transform: Rows


class _DvrkFile(Config, frozen=True, kw_only=True, rename="kebab"):
    base_frame: _BaseFrame


def read_frames(path: Path, moves: bool = False) -> PublishedFrame:
    """The robot's frame from JSON with keys of ``CalibrationFile``, YAML of easy_handeye (ROS
    1 and 2), or JSON of dvrk_camera_registration. ``moves``: for a camera on a tool. Raises
    InputError: it is missing, has an unknown key, no rigid transform, or not exactly one way of
    giving the pose."""
    file = from_builtins(calibration_keys(path), CalibrationFile, str(path))
    matrices = {
        name: read_rigid(rows, file.unit, f"{path}: {name}")
        for name in file.__struct_fields__
        if "_from_" in name and (rows := getattr(file, name)) is not None
    }
    if moves != (_TOOL in matrices):
        raise InputError(f"{path}: {_TOOL} is of a camera that moves, and `track --moving` of it.")
    match list(matrices.items()):
        case [("robot_from_camera" | "tool_from_camera", robot_from_camera)]:
            pass
        case [("camera_from_robot", camera_from_robot)]:
            robot_from_camera = np.linalg.inv(camera_from_robot)
        case [("camera_from_marker", camera_from_marker), ("robot_from_marker", robot_from_marker)]:
            robot_from_camera = robot_from_marker @ np.linalg.inv(camera_from_marker)
        case _:
            raise InputError(
                f"{path} must have camera_from_robot, or robot_from_camera, or camera_from_marker "
                f"and robot_from_marker; it has {', '.join(matrices) or 'none'}."
            )
    if not file.frame_id.strip():
        raise InputError(f"{path}: frame_id is empty; give the robot's frame, base_link say.")
    table, camera = file.table_in_camera, file.camera_frame_id.strip().removeprefix("/")
    if table is not None:
        length = float(np.linalg.norm(table[:3]))
        if moves or not abs(length - 1) < _NOT_UNIT or not np.isfinite(table[3]):
            raise InputError(
                f"{path}: table_in_camera must be a unit normal (3 numbers) and the plane's offset "
                f"in {file.unit}, in the frame of a camera that stands still."
            )
        x, y, z, offset = (number / length for number in table)
        table = x, y, z, offset * (1000 if file.unit == "m" else 1)
    error = file.error_mm, file.error_deg
    return PublishedFrame(file.frame_id, robot_from_camera, True, camera, table, *error, moves)


def calibration_keys(path: Path) -> dict[str, Any]:
    """What a file says, by keys of ``CalibrationFile``, unchecked where it is JSON."""
    if path.suffix.lower() in _YAML:
        return _easy_handeye(path)
    if (named := _DVRK.fullmatch(path.name)) is not None:
        return _dvrk_registration(path, *named.groups())
    if "base-frame" in (given := read_json(path)):
        raise InputError(
            f"{path} is of dvrk_camera_registration, but only the name that it gave the file says "
            "whose base and which axes: PSM1-registration-open-cv.json, say."
        )
    return given


def _easy_handeye(path: Path) -> dict[str, Any]:
    """The keys of a ``CalibrationFile`` from what easy_handeye writes, which is in metres."""
    found, within = dict[str, str](), ""
    text = re.sub(r"(?m)(^|\s)#.*$", "", text_of(read_file(path, _LARGEST_YAML), str(path)))
    for key, value in _PAIR.findall(text):
        within = key if not value else within
        name = f"q{key}" if within == "rotation" and key in "xyzw" else key
        if value and found.setdefault(name, value.strip("\"'")) != value.strip("\"'"):
            raise InputError(f"{path} has {name!r} twice; easy_handeye writes it once.")
    on_hand = found.get("eye_on_hand") or found.get("calibration_type")
    needed = *_PLACE, *_TURN, "robot_base_frame", "tracking_base_frame"
    if on_hand is None or (missing := [name for name in needed if name not in found]):
        lack = "eye_on_hand" if on_hand is None else ", ".join(missing)
        raise InputError(f"{path} lacks {lack}, which easy_handeye writes. Allowed: also JSON.")
    metres, turn = (
        [number_in(found[name], f"{path}: {name}") for name in names] for names in (_PLACE, _TURN)
    )
    if not abs(np.linalg.norm(turn) - 1) < _NOT_UNIT:
        raise InputError(f"{path}: {', '.join(_TURN)} must have length 1.")
    moves = on_hand.lower() in ("true", "eye_in_hand", "eye_on_hand")
    from scipy.spatial.transform import Rotation  # slow to import

    pose = rigid(Rotation.from_quat(turn).as_matrix(), np.array(metres)).tolist()
    frames = {"frame_id": found[needed[-2]], "camera_frame_id": found[needed[-1]]}
    return {"unit": "m", _TOOL if moves else "robot_from_camera": pose, **frames}


def _dvrk_registration(path: Path, robot: str, axes: str) -> dict[str, Any]:
    """The keys of a ``CalibrationFile`` from what dvrk_camera_registration writes, in metres: where
    the arm's own base (``PSM1_base``, that of ``local/measured_cp``) is before the camera. dVRK's
    axes of the camera are OpenCV's turned by half about its axis, and come without braces."""
    content = read_file(path, _LARGEST_DVRK).strip()
    data = json_object(b"{%s}" % content if content.startswith(b'"') else content, path)
    if "measured_cp" in data:
        raise InputError(
            f"{path} is of a camera that an ECM holds, and where that was is not in it. Give "
            f"{robot}-registration-open-cv.json, which was written beside it."
        )
    base = from_builtins(data, _DvrkFile, str(path)).base_frame
    camera_from_base = read_rigid(base.transform, "m", f"{path}: transform")
    if axes == "dVRK":
        camera_from_base[:2] *= -1
    name = "" if base.reference_frame == _UNNAMED else base.reference_frame
    pose = {"unit": "mm", "camera_from_robot": camera_from_base.tolist()}
    return {**pose, "frame_id": f"{robot}_base", "camera_frame_id": name}
