"""Folders of frames as recordings: clouds, depth images, scenes."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.store import natural, read_json
from tumortrack.core.types import DepthFrame, SensorCloud
from tumortrack.io import depth_files as files
from tumortrack.io.mesh_files import read_anatomy
from tumortrack.io.scene_folder import organ_of_folder
from tumortrack.live.values import Observation

INTRINSICS, DEPTH, CLOUD, META = "intrinsics.json", "depth.png", "cloud.ply", "meta.json"
ABOUT = "recording.json"  # of the sink ``recording``
_OTHER_IMAGE = re.compile(r"(colou?r|rgb|mask|infra(red)?|ir)(?![a-z])", re.IGNORECASE)


class RecordedFrame(NamedTuple):
    """A frame that ``load`` reads, raising InputError if it is damaged. The observation must be
    given this stamp; its ``arrived_ns`` is 0."""

    stamp_ns: int
    load: Callable[[], Observation]


def folder_frames(path: Path, fps: float, unit: Literal["mm", "m"]) -> list[RecordedFrame]:
    """The frames in a folder, by name and number; none is read yet.

    Scene folders (with depth.png and intrinsics.json, or cloud.ply), depth images with one
    intrinsics.json, or clouds (in ``unit``). Stamps: ``stamp_ns`` of a scene's meta.json, or file
    names of at least 12 digits, in ns, us or ms, as their distance tells; else ``fps`` frames a
    second. Raises InputError if there are none of these.
    """
    listed = path.iterdir() if path.is_dir() else ()
    inside = sorted((p for p in listed if not p.name.startswith(".")), key=natural)
    scenes = [p for p in inside if (p / DEPTH).is_file() or (p / CLOUD).is_file()]
    images = [p for p in inside if p.suffix.lower() in files.DEPTH_SUFFIXES and p.is_file()]
    images = [p for p in images if not _OTHER_IMAGE.match(p.stem)]
    clouds = [p for p in inside if p.suffix.lower() in files.CLOUD_SUFFIXES and p.is_file()]
    camera, image, cloud = path / INTRINSICS, files.read_depth_png, files.read_cloud
    kinds: list[tuple[list[Path], Callable[[Path], Observation]]] = [
        (scenes, _read_scene),
        (images if camera.is_file() else [], lambda file: Observation(image(file, camera), 0)),
        (clouds, lambda file: Observation(cloud(file, unit)[0], 0)),
    ]
    frame_paths, read = next((kind for kind in kinds if kind[0]), ([], _read_scene))
    if not frame_paths:
        lack = f"; its depth images lack {INTRINSICS}" if images else ""
        raise InputError(
            f"{path} is no recording{lack}. Allowed: a folder of clouds "
            f"({', '.join(files.CLOUD_SUFFIXES)}), of depth images "
            f"({', '.join(files.DEPTH_SUFFIXES)}) with {INTRINSICS}, of scene folders, a rosbag2 "
            "folder, .mcap, .db3 or .bag."
        )
    named = all(re.fullmatch(r"[0-9]{12,}", p.stem) for p in frame_paths)  # fewer: a number
    unit_ns = _unit_ns([int(p.stem) for p in frame_paths]) if named else 1
    period_ns, last_ns, frames = round(1e9 / fps), 0, []
    for file in frame_paths:
        known_ns = _scene_stamp(file) if scenes else unit_ns * int(file.stem) if named else None
        last_ns = last_ns + period_ns if known_ns is None else known_ns
        frames.append(RecordedFrame(last_ns, partial(read, file)))
    return frames


def _unit_ns(stamps: list[int]) -> int:
    """Of stamps in ns, us or ms, of frames that are 1 ms to 1 s apart."""
    apart = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1e6
    return 1 if apart >= 1e6 else 1000 if apart >= 1000 else 10**6


def _scene_stamp(folder: Path) -> int | None:
    """None if there is none, or its file is damaged."""
    try:
        stamp_ns = _meta(folder).get("stamp_ns")
    except InputError:
        return None
    return stamp_ns if isinstance(stamp_ns, int) and stamp_ns > 0 else None


def _meta(folder: Path) -> dict[str, Any]:
    return read_json(folder / META) if (folder / META).is_file() else {}


def _read_scene(folder: Path) -> Observation:
    """The depth image (or the cloud) and the true surfaces of a scene."""
    if (folder / DEPTH).is_file():
        frame: DepthFrame | SensorCloud = files.read_depth_png(folder / DEPTH, folder / INTRINSICS)
    else:
        frame = files.read_cloud(folder / CLOUD)[0]
    kind = organ_of_folder(folder, _meta(folder))
    truth = read_anatomy(folder, kind) if (folder / f"{kind.name}.ply").is_file() else None
    return Observation(frame, 0, truth=truth)
