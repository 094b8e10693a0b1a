"""Folders of frames as recordings: clouds, depth images, scenes."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_files import read_anatomy
from tumortrack.core.store import read_json
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.live.values import Observation
from tumortrack.sense import files
from tumortrack.simulate.scene_folder import organ_of_folder

TIMES, INTRINSICS = "times.csv", "intrinsics.json"
FRAMES, DEPTH, CLOUD, MASK = "frames", "depth.png", "cloud.ply", "mask.png"
REPORT, META = "report.json", "meta.json"
ABOUT = "recording.json"  # beside what the sink ``recording`` wrote
_STAMP_DIGITS = 12  # a name with fewer digits is a number of a frame, no time in ns
_LARGEST_TABLE = 64 * 2**20  # bytes


class RecordedFrame(NamedTuple):
    """A frame that is read when ``load`` is called, which raises InputError if it is damaged. The
    observation is to get this stamp; its ``arrived_ns`` is 0."""

    stamp_ns: int
    load: Callable[[], Observation]


def folder_frames(path: Path, fps: float, unit: Literal["mm", "m"]) -> list[RecordedFrame]:
    """The frames in a folder, by name; none is read before its turn.

    Of: folders with depth.png and intrinsics.json, or cloud.ply (scenes, or recordings as files of
    tumortrack 0.1); depth images (.png) beside one intrinsics.json; clouds (.ply, .pcd, .npz;
    ``unit`` is theirs). Stamps: what meta.json or report.json says as ``stamp_ns``;
    for loose files times.csv (``file,stamp_ns``), or file names of at least 12 digits, which are
    nanoseconds; else ``fps`` frames a second. Raises InputError where there are none of these.
    """
    root = path / FRAMES if (path / FRAMES).is_dir() else path
    listed = root.iterdir() if root.is_dir() else ()
    inside = sorted(p for p in listed if not p.name.startswith("."))
    folders = [p for p in inside if (p / DEPTH).is_file() or (p / CLOUD).is_file()]
    images = [p for p in inside if p.suffix.lower() == ".png" and p.is_file()]
    clouds = [p for p in inside if p.suffix.lower() in files.CLOUD_SUFFIXES and p.is_file()]
    camera, image, cloud = root / INTRINSICS, files.read_depth_png, files.read_cloud
    kinds: list[tuple[list[Path], Callable[[Path], Observation]]] = [
        (folders, _read_folder),
        (images if camera.is_file() else [], lambda file: Observation(image(file, camera), 0)),
        (clouds, lambda file: Observation(cloud(file, unit)[0], 0)),
    ]
    found, read = next((kind for kind in kinds if kind[0]), ([], _read_folder))
    if not found:
        lack = f"its .png need {INTRINSICS} beside them" if images else "it holds none of these"
        raise InputError(
            f"{path} is no recording: {lack}. Allowed: a folder of clouds "
            f"({', '.join(files.CLOUD_SUFFIXES)}), of depth images (.png) with {INTRINSICS}, of "
            "scene folders, a rosbag2 folder, .mcap, .db3 or .bag."
        )
    stamps_ns = [_own_stamp(f) for f in folders] if folders else _file_stamps(root, found)
    period_ns, last_ns, frames = round(1e9 / fps), 0, []
    for file, known_ns in zip(found, stamps_ns, strict=True):
        last_ns = last_ns + period_ns if known_ns is None else known_ns
        frames.append(RecordedFrame(last_ns, partial(read, file)))
    return frames


def _own_stamp(folder: Path) -> int | None:
    """None where there is none, or where its file is damaged."""
    found = [folder / name for name in (META, REPORT) if (folder / name).is_file()]
    try:
        stamp_ns = read_json(found[0]).get("stamp_ns") if found else None
    except InputError:
        return None
    return stamp_ns if isinstance(stamp_ns, int) and stamp_ns > 0 else None


def _file_stamps(root: Path, found: list[Path]) -> list[int | None]:
    names = [p.stem for p in found]
    if (root / TIMES).is_file():
        times = _read_times(root / TIMES)
        if missing := [p.name for p in found if p.name not in times]:
            raise InputError(
                f"{root / TIMES} lacks {missing[0]}. It must have the columns file,stamp_ns and a "
                "row for every frame."
            )
        return [times[p.name] for p in found]
    if all(n.isdecimal() and n.isascii() and len(n) >= _STAMP_DIGITS for n in names):
        return [int(n) for n in names]
    return [None] * len(found)


def _read_times(path: Path) -> dict[str, int]:
    if path.stat().st_size > _LARGEST_TABLE:
        raise InputError(f"{path} is larger than 64 MiB; this is no table of stamps.")
    try:
        rows = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
        return {row["file"]: int(row["stamp_ns"]) for row in rows}
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise InputError(
            f"{path} cannot be read: {error}. It must have the columns file,stamp_ns; stamps are "
            "whole numbers of nanoseconds."
        ) from error


def _read_folder(folder: Path) -> Observation:
    """The depth image (else the cloud), the mask, and the true surfaces of a scene."""
    if (folder / DEPTH).is_file():
        frame: DepthFrame | SensorCloud = files.read_depth_png(folder / DEPTH, folder / INTRINSICS)
    else:
        frame = files.read_cloud(folder / CLOUD)[0]
    mask = _read_mask(folder / MASK, frame) if (folder / MASK).is_file() else None
    meta = read_json(folder / "meta.json") if (folder / "meta.json").is_file() else {}
    kind = organ_of_folder(folder, meta)
    truth = read_anatomy(folder, kind) if (folder / f"{kind.name}.ply").is_file() else None
    return Observation(frame, 0, mask, truth)


def _read_mask(path: Path, frame: DepthFrame | SensorCloud) -> np.ndarray:
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
