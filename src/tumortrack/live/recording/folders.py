"""Folders of clouds, of depth images or of frames' folders as recordings."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_files import read_anatomy
from tumortrack.core.store import read_json
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.recording import RecordedFrame
from tumortrack.live.values import Observation
from tumortrack.sense.files import CLOUD_SUFFIXES, read_cloud, read_depth_png

TIMES, INTRINSICS = "times.csv", "intrinsics.json"
FRAMES, DEPTH, CLOUD, MASK, REPORT, META = (
    "frames",
    "depth.png",
    "cloud.ply",
    "mask.png",
    "report.json",
    "meta.json",
)
_STAMP_DIGITS = 12  # a name with fewer digits is a number of a frame, no time in ns
_LARGEST_TABLE = 64 * 2**20  # bytes

Unit = Literal["mm", "m"]
Frame = DepthFrame | SensorCloud


@dataclass(frozen=True)
class FolderRecording:
    """Frames in files: nothing is read before its turn."""

    all_frames: tuple[RecordedFrame, ...]

    def frames(self) -> Iterator[RecordedFrame]:
        return iter(self.all_frames)

    def close(self) -> None:
        """Nothing is held open."""


def open_folder(path: Path, fps: float, unit: Unit) -> FolderRecording:
    """The frames in a folder, by name.

    Of: folders with depth.png and intrinsics.json, or cloud.ply (scenes, or what the sink
    ``recording`` wrote as files); depth images (.png) beside one intrinsics.json; clouds (.ply,
    .pcd, .npz; ``unit`` is theirs). Stamps: what meta.json or report.json says as ``stamp_ns``;
    for loose files times.csv (``file,stamp_ns``), or file names of at least 12 digits, which are
    nanoseconds; else ``fps`` frames a second.

    Raises:
        InputError: none of these; a times.csv that lacks a file.
    """
    root = path / FRAMES if (path / FRAMES).is_dir() else path
    listed = root.iterdir() if root.is_dir() else ()
    inside = sorted(p for p in listed if not p.name.startswith("."))
    folders = [p for p in inside if (p / DEPTH).is_file() or (p / CLOUD).is_file()]
    images = [p for p in inside if p.suffix.lower() == ".png" and p.is_file()]
    clouds = [p for p in inside if p.suffix.lower() in CLOUD_SUFFIXES and p.is_file()]
    if folders:
        return FolderRecording(
            _recorded([partial(_read_folder, f) for f in folders], _folder_stamps(folders), fps)
        )
    if images and (root / INTRINSICS).is_file():
        camera = root / INTRINSICS
        loads: list[Callable[[], Observation]] = [partial(_read_image, p, camera) for p in images]
        return FolderRecording(_recorded(loads, _file_stamps(root, images), fps))
    if clouds:
        loads = [partial(_read_points, p, unit) for p in clouds]
        return FolderRecording(_recorded(loads, _file_stamps(root, clouds), fps))
    lack = f"its .png need {INTRINSICS} beside them" if images else "it holds none of these"
    raise InputError(
        f"{path} is no recording: {lack}. Allowed: a folder of clouds "
        f"({', '.join(CLOUD_SUFFIXES)}), of depth images (.png) with {INTRINSICS}, of scene "
        "folders, a rosbag2 folder, .mcap, .db3 or .bag."
    )


def _recorded(
    loads: list[Callable[[], Observation]], stamps_ns: list[int | None], fps: float
) -> tuple[RecordedFrame, ...]:
    """Where a stamp is not known it is the one before and a period more."""
    period_ns, last_ns, frames = round(1e9 / fps), 0, []
    for load, known_ns in zip(loads, stamps_ns, strict=True):
        last_ns = last_ns + period_ns if known_ns is None else known_ns
        frames.append(RecordedFrame(last_ns, partial(_stamped, load, last_ns)))
    return tuple(frames)


def _stamped(load: Callable[[], Observation], stamp_ns: int) -> Observation:
    seen = load()
    return replace(seen, content=replace(seen.content, stamp_ns=stamp_ns))


def _folder_stamps(folders: list[Path]) -> list[int | None]:
    """The stamps in the folders' own JSON files; None where unknown."""
    return [_own_stamp(folder) for folder in folders]


def _own_stamp(folder: Path) -> int | None:
    """None where there is none, or where its file is damaged."""
    for name in (META, REPORT):
        if not (folder / name).is_file():
            continue
        try:
            stamp_ns = read_json(folder / name).get("stamp_ns")
        except InputError:
            return None
        return stamp_ns if isinstance(stamp_ns, int) and stamp_ns > 0 else None
    return None


def _file_stamps(root: Path, files: list[Path]) -> list[int | None]:
    if (root / TIMES).is_file():
        times = _read_times(root / TIMES)
        if missing := [p.name for p in files if p.name not in times]:
            raise InputError(
                f"{root / TIMES} lacks {missing[0]}. It must have the columns file,stamp_ns and a "
                "row for every frame."
            )
        return [times[p.name] for p in files]
    names = [p.stem for p in files]
    if all(n.isdecimal() and n.isascii() and len(n) >= _STAMP_DIGITS for n in names):
        return [int(n) for n in names]
    return [None] * len(files)


def _read_times(path: Path) -> dict[str, int]:
    if path.stat().st_size > _LARGEST_TABLE:
        raise InputError(f"{path} is larger than 64 MiB; this is no table of stamps.")
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        return {row["file"]: int(row["stamp_ns"]) for row in rows}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read: {error}. It must have the columns file,stamp_ns; stamps are "
            "whole numbers of nanoseconds."
        ) from error


def _read_points(path: Path, unit: Unit) -> Observation:
    return Observation(read_cloud(path, unit)[0], 0)


def _read_image(path: Path, camera: Path) -> Observation:
    return Observation(read_depth_png(path, camera), 0)


def _read_folder(folder: Path) -> Observation:
    """The depth image (else the cloud), the mask, and the true surfaces of a scene."""
    frame: Frame
    if (folder / DEPTH).is_file():
        frame = read_depth_png(folder / DEPTH, folder / INTRINSICS)
    else:
        frame = read_cloud(folder / CLOUD)[0]
    mask = _read_mask(folder / MASK, frame) if (folder / MASK).is_file() else None
    truth = read_anatomy(folder) if (folder / "kidney.ply").is_file() else None
    return Observation(frame, 0, mask, truth)


def _read_mask(path: Path, frame: Frame) -> np.ndarray:
    from PIL import Image

    if not isinstance(frame, DepthFrame):
        raise InputError(f"{path}: a mask needs depth.png beside it, to which it belongs.")
    try:
        with Image.open(path, formats=["PNG"]) as image:
            fits = image.size == (frame.intrinsics.width, frame.intrinsics.height)
            mask = np.asarray(image) > 0 if fits and image.mode in ("L", "1") else None
    except Exception as error:  # Pillow raises anything on a damaged file
        raise InputError(f"{path} cannot be read as a PNG image: {error}.") from error
    if mask is None:
        raise InputError(f"{path} must be 8-bit grey and as large as {DEPTH} beside it.")
    return mask
