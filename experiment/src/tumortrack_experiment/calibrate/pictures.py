"""Pictures of a board, with depth images and the robot's poses where there are: from a folder, or
from what `tumortrack record` wrote."""

from __future__ import annotations

import io
import re
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import Affine, read_rigid
from tumortrack.core.store import natural, read_file, read_json
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.io.depth_files import read_depth_png
from tumortrack.live.poses import FilePoses
from tumortrack.live.values import Observation
from tumortrack_devices.recording.folders import ABOUT, DEPTH, INTRINSICS, META
from tumortrack_experiment.record.read import read_recorded

_NAMES = ("colour", "color", "infrared")  # .png or .jpg, in a frame's folder
_SUFFIXES = (".png", ".jpg", ".jpeg")
_MOST_PIXELS = 50_000_000
_LARGEST = 64 * 2**20  # bytes
_IS_STAMP = re.compile(
    r"[0-9]{12,19}"
)  # of fewer digits it is a number of a picture, no time in ns
_OF_A_STATE = 2  # moments: two tell the noise


class Shot(NamedTuple):
    """A picture, the depth image of the same moment and pixels, its stamp (0: unknown), and where
    the tool was in the robot's base, as far as they are known."""

    name: str
    grey: UInt8[np.ndarray, "h w"]
    depth: DepthFrame | None = None
    stamp_ns: int = 0
    base_from_tool: Affine | None = None


class RobotPoses(Config, frozen=True, kw_only=True):
    """Where the tool was for each picture, in their order: 4 x 4 rows that carry points of the tool
    into the robot's base; ``unit``: of the translations; ``frame_id``: the base's name."""

    base_from_tool: tuple[tuple[tuple[float, float, float, float], ...], ...]
    unit: Literal["mm", "m"]
    frame_id: str


def read_shots(folder: Path) -> list[Shot]:
    """The pictures in a folder, by name: loose ones; folders with colour.png or infrared.png each
    (and depth.png, intrinsics.json, meta.json); or a recording, whose states are a pose each.
    Raises InputError: there are none, one is damaged, or they differ in size."""
    listed = folder.iterdir() if folder.is_dir() else ()
    inside = sorted((p for p in listed if p.name[0] != "."), key=natural)
    names = [name + suffix for name in _NAMES for suffix in _SUFFIXES]
    files = [next((p / n for n in names if (p / n).is_file()), None) for p in inside if p.is_dir()]
    if any(p.suffix == ".mcap" for p in inside):
        shots = _recorded(folder)
    elif framed := [file for file in files if file is not None]:
        shots = [_framed(file) for file in framed]
    else:
        shots = [
            Shot(p.stem, _grey(p), stamp_ns=int(p.stem) if _IS_STAMP.fullmatch(p.stem) else 0)
            for p in inside
            if p.suffix.lower() in _SUFFIXES
        ]
    if not shots:
        raise InputError(
            f"{folder} holds no pictures. Allowed: .png and .jpg; a folder for each with "
            f"colour.png or infrared.png (and {DEPTH}, {INTRINSICS}); a recording with pictures."
        )
    sizes = {shot.grey.shape[::-1]: shot.name for shot in shots}
    if len(sizes) > 1:
        said = ", ".join(f"{name} {w} x {h}" for (w, h), name in sizes.items())
        raise InputError(f"{folder}: pictures differ in size ({said}); give those of one stream.")
    return shots


def _recorded(folder: Path) -> list[Shot]:
    recorded, shots = read_recorded(folder), []
    tool = "calibration.json" not in recorded.attachments  # by which poses are the camera's
    for state in recorded.states:
        for moment in islice(recorded.moments(state), _OF_A_STATE):
            if (seen := moment.picture) is not None:
                grey = cv2.cvtColor(seen, cv2.COLOR_RGB2GRAY) if seen.ndim == 3 else seen
                stamp_ns = moment.depth.stamp_ns
                pose = moment.fixed_from_camera if tool else None
                shots.append(Shot(state, grey, moment.depth, stamp_ns, pose))
    return shots


def _framed(file: Path) -> Shot:
    folder, depth = file.parent, None
    if (folder / DEPTH).is_file():
        depth = read_depth_png(folder / DEPTH, folder / INTRINSICS)
        if "depth_scale" in read_json(folder / INTRINSICS):
            raise InputError(
                f"{folder / INTRINSICS} corrects depth already; give the camera's own."
            )
    stamp_ns = read_json(folder / META).get("stamp_ns") if (folder / META).is_file() else 0
    grey = _grey(file)
    if depth is not None and depth.depth_mm.shape != grey.shape:
        raise InputError(
            f"{folder}: picture and depth image differ in size; align them, or take the infrared "
            "picture that the depth is of."
        )
    return Shot(folder.name, grey, depth, stamp_ns if isinstance(stamp_ns, int) else 0)


def _grey(file: Path) -> UInt8[np.ndarray, "h w"]:
    from PIL import Image

    content = io.BytesIO(read_file(file, _LARGEST))
    try:
        picture = Image.open(content, formats=["PNG", "JPEG"])
        width, height = picture.size  # from the header: nothing is decoded yet
        grey = np.asarray(picture.convert("L")) if width * height <= _MOST_PIXELS else None
    except Exception as error:  # Pillow raises anything on a damaged file
        raise InputError(f"{file} cannot be read as a picture: {error}.") from error
    if grey is None:
        raise InputError(f"{file} is {width} x {height}; at most 50 million pixels are read.")
    return grey


def with_poses(shots: list[Shot], path: Path) -> tuple[str, list[Shot]]:
    """``frame_id`` of the robot's base, and the pictures with their poses, from JSON
    (``RobotPoses``), a table of stamped poses (.csv, as for `track --moving`), or a recording.
    Raises InputError: damaged, or not one for each picture."""
    if path.is_dir():
        if lack := [shot.name for shot in shots if shot.base_from_tool is None]:
            raise InputError(
                f"{path} does not say where the tool was in {lack[0]}: give --poses, or record "
                "with --moving and without --frame."
            )
        return read_json(path / ABOUT)["frame_id"], shots
    if path.suffix.lower() == ".csv":
        table, poses = FilePoses(path), []
        for shot in shots:
            at = Observation(SensorCloud(np.zeros((1, 3), np.float32), shot.stamp_ns), 0)
            try:
                poses.append(table.at(at))
            except NoEstimate as error:
                raise InputError(f"{path}: of picture {shot.name}, {error}.") from error
        frame_id = table.frame_id
    else:
        file = from_builtins(read_json(path), RobotPoses, str(path))
        if len(file.base_from_tool) != len(shots):
            raise InputError(
                f"{path} has {len(file.base_from_tool)} poses for {len(shots)} pictures; it must "
                "have one for each, in the order of their names."
            )
        where, frame_id = f"{path}: base_from_tool of", file.frame_id
        poses = [
            read_rigid(rows, file.unit, f"{where} {shot.name}")
            for rows, shot in zip(file.base_from_tool, shots, strict=True)
        ]
    return frame_id, [
        shot._replace(base_from_tool=pose) for shot, pose in zip(shots, poses, strict=True)
    ]
