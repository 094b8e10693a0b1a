"""Pictures of a board from a folder, with depth images and stamps where there are; and the poses of
the robot that belong to them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import read_rigid
from tumortrack.core.store import read_file, read_json
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.poses import COLUMNS, FilePoses
from tumortrack.live.recording.folders import DEPTH, FRAMES, INTRINSICS, META
from tumortrack.live.values import Observation
from tumortrack.sense.files import read_depth_png

PICTURES = ("colour", "color", "infrared", "picture")  # names, .png or .jpg, in a frame's folder
_SUFFIXES = (".png", ".jpg", ".jpeg")
_LARGEST = 64 * 2**20  # bytes
_STAMP_DIGITS = 12  # a name with fewer digits is a number, no time in ns


class Shot(NamedTuple):
    """A picture, and the depth image of the same moment, read when ``depth`` is called."""

    name: str
    grey: UInt8[np.ndarray, "h w"]
    depth: Callable[[], DepthFrame] | None
    stamp_ns: int | None


def read_shots(folder: Path) -> list[Shot]:
    """The pictures in a folder, by name: loose ones, or folders of one each (colour.png or
    infrared.png, perhaps with depth.png and intrinsics.json). Raises InputError: there are none,
    one is damaged, or they differ in size."""
    root = folder / FRAMES if (folder / FRAMES).is_dir() else folder
    inside = sorted(p for p in root.iterdir() if p.name[0] != ".") if root.is_dir() else []
    names = [name + suffix for name in PICTURES for suffix in _SUFFIXES]
    files = [next((p / n for n in names if (p / n).is_file()), None) for p in inside if p.is_dir()]
    found = [file for file in files if file is not None]
    found = found or [p for p in inside if p.suffix.lower() in _SUFFIXES]
    if not found:
        raise InputError(
            f"{folder} holds no pictures. Allowed: .png and .jpg, or a folder for each with "
            f"{' or '.join(f'{name}.png' for name in PICTURES)} (and {DEPTH} with {INTRINSICS})."
        )
    shots = [_read_shot(file, "" if file.parent == root else file.parent.name) for file in found]
    sizes = {shot.grey.shape[::-1]: shot.name for shot in shots}
    if len(sizes) > 1:
        said = ", ".join(f"{name} {w} x {h}" for (w, h), name in sizes.items())
        raise InputError(f"{folder}: pictures differ in size ({said}); give those of one stream.")
    return shots


def _read_shot(file: Path, frame: str) -> Shot:
    content = np.frombuffer(read_file(file, _LARGEST), np.uint8)
    try:
        grey = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
    except cv2.error:  # of a header that claims too much
        grey = None
    if grey is None:
        raise InputError(f"{file} cannot be read as a picture.")
    folder, depth = file.parent, None
    if frame and (folder / DEPTH).is_file():
        depth = partial(read_depth_png, folder / DEPTH, folder / INTRINSICS)
    name = frame or file.stem
    meta = folder / META
    stamp = read_json(meta).get("stamp_ns") if frame and meta.is_file() else None
    if stamp is None and name.isdecimal() and name.isascii() and len(name) >= _STAMP_DIGITS:
        stamp = int(name)
    return Shot(name, grey, depth, stamp if isinstance(stamp, int) else None)


class RobotPoses(Config, frozen=True, kw_only=True):
    """Where the tool was for each picture, in their order: 4 x 4 rows that carry points of the tool
    into the robot's base; ``unit``: of the translations; ``frame_id``: the base's name."""

    base_from_tool: tuple[tuple[tuple[float, float, float, float], ...], ...]
    unit: Literal["mm", "m"]
    frame_id: str


def read_robot_poses(path: Path, shots: list[Shot]) -> tuple[str, Float64[np.ndarray, "n 4 4"]]:
    """``frame_id`` and ``base_from_tool`` for each picture, mm, from JSON (``RobotPoses``) or a
    table of stamped poses (CSV, as `track --moving` reads it: by stamps where all pictures have
    one, else row by row). Raises InputError: damaged, or not one for each picture."""
    if path.suffix.lower() != ".csv":
        file = from_builtins(read_json(path), RobotPoses, str(path))
        _check_count(path, len(file.base_from_tool), shots)
        where = f"{path}: base_from_tool"
        return file.frame_id, np.array(
            [
                read_rigid(rows, file.unit, f"{where} of {shot.name}")
                for rows, shot in zip(file.base_from_tool, shots, strict=True)
            ]
        )
    table = FilePoses(path)
    stamps_ns = [shot.stamp_ns for shot in shots]
    if None in stamps_ns:
        lines = read_file(path, _LARGEST, f"Give a row for each picture ({COLUMNS}).").split(b"\n")
        stamps_ns = [int(line.split(b",")[0]) for line in lines[1:] if line.strip()]
        _check_count(path, len(stamps_ns), shots)
    poses = []
    for stamp_ns, shot in zip(stamps_ns, shots, strict=True):
        at = Observation(SensorCloud(np.zeros((1, 3), np.float32), stamp_ns or 0), 0)
        try:
            poses.append(table.at(at))
        except NoEstimate as error:
            raise InputError(f"{path} has no pose for picture {shot.name}: {error}.") from error
    return table.frame_id, np.array(poses)


def _check_count(path: Path, count: int, shots: list[Shot]) -> None:
    if count != len(shots):
        raise InputError(
            f"{path} has {count} poses for {len(shots)} pictures; it must have one for each, in "
            "the order of their names."
        )
