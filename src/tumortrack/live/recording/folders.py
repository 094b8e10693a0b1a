"""Folders of frames as recordings: clouds, depth images, scenes, what ``FrameFolders`` writes."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from tumortrack.core.errors import InputError, StorageError, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.mesh_files import read_anatomy, write_mesh
from tumortrack.core.store import read_json
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud
from tumortrack.live.values import Observation, RigidShape, TrackingResult, Workcell
from tumortrack.sense import files
from tumortrack.sense.ply import cloud_ply

TIMES, INTRINSICS = "times.csv", "intrinsics.json"
VIEW = "view_"  # a folder of frames by each further camera
FRAMES, DEPTH, CLOUD, MASK = "frames", "depth.png", "cloud.ply", "mask.png"
REPORT, META = "report.json", "meta.json"
ABOUT = "recording.json"  # of what the sink wrote, frames or bag
INDEX, SHAPES, WORKCELL = "index.jsonl", "shapes", "workcell.json"
_ESTIMATE = "estimate"  # apart from what was seen: these surfaces are no truth
_STAMP_DIGITS = 12  # a name with fewer digits is a number of a frame, no time in ns
_LARGEST_TABLE = 64 * 2**20  # bytes


class RecordedFrame(NamedTuple):
    """A frame that is read when ``load`` is called, which raises InputError if it is damaged. The
    observation is to get this stamp; its ``arrived_ns`` is 0."""

    stamp_ns: int
    load: Callable[[], Observation]


def folder_frames(path: Path, fps: float, unit: Literal["mm", "m"]) -> list[RecordedFrame]:
    """The frames in a folder, by name; none is read before its turn.

    Of: folders with depth.png and intrinsics.json, or cloud.ply (scenes, or what the sink
    ``recording`` wrote as files); depth images (.png) beside one intrinsics.json; clouds (.ply,
    .pcd, .npz; ``unit`` is theirs). Stamps: what meta.json or report.json says as ``stamp_ns``;
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
    truth = read_anatomy(folder) if (folder / "kidney.ply").is_file() else None
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


class FrameFolders:
    """``frames/00000012/``: depth.png and intrinsics.json (and mask.png), or cloud.ply;
    report.json; ``estimate/``: occupancy.ply, kidney.ply, tumor_1.ply, ...; with arms
    workcell.json: state, halted, joints (radians), lines and the places of shapes, in the
    published frame; each surface stands once in ``shapes/``, in the shape's own frame. What
    further cameras saw lies in ``view_2/frames/00000012/``, with its stamp in meta.json.

    Depths are rounded to 0.1 mm; those that 16 bits of it cannot hold (from 6553.5 mm) are left
    out. Files are not forced to the disk one by one, as that would take longer than a frame.
    Where the disk refuses, the frame's folder is taken away again, and the next frame is tried.
    """

    def __init__(self, folder: Path, frames: bool) -> None:
        self._root, self._frames = folder / FRAMES, frames
        self._root.mkdir(parents=True)
        self._index = (folder / INDEX).open("ab", buffering=0)
        self._shapes = folder / SHAPES
        self._surfaces: dict[str, tuple[Mesh, str]] = {}  # by shape: the last, and its file
        self._written = 0

    def publish(self, result: TrackingResult) -> None:
        folder = self._root / f"{result.sequence:08d}"
        try:
            folder.mkdir()
            if self._frames and result.observation is not None:
                views = {view.number: view.seen for view in result.views}
                self._write_views(folder, views or {1: result.observation})
            if result.estimate is not None:
                _write_estimate(folder / _ESTIMATE, result.estimate)
            if result.workcell is not None:
                _write_json(folder / WORKCELL, self._workcell(result.workcell))
            _write_json(folder / REPORT, report(result))
            line = json.dumps({**facts(result), "folder": folder.name}) + "\n"
            self._index.write(line.encode())
        except (OSError, StorageError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, TumortrackError):
                raise
            raise StorageError(f"cannot write {folder}: {error.strerror or error}.") from error

    def close(self) -> None:
        self._index.close()

    def _write_views(self, folder: Path, views: dict[int, Observation]) -> None:
        for number, seen in views.items():
            there = folder
            if number > 1:
                there = self._root.parent / f"{VIEW}{number}" / FRAMES / folder.name
                there.mkdir(parents=True)
                _write_json(there / META, {"stamp_ns": seen.stamp_ns})
            _write_seen(there, seen)

    def _workcell(self, cell: Workcell) -> dict[str, Any]:
        return {
            "state": cell.state,
            "halted": cell.halted,
            "joints_rad": {name: float(angle) for name, angle in cell.joints_rad.items()},
            "shapes": {
                shape.name: {
                    "surface": f"{SHAPES}/{self._surface(shape)}",
                    "published_from_shape": shape.published_from_shape.tolist(),
                    "colour": shape.colour,
                    "opacity": shape.opacity,
                }
                for shape in cell.shapes
            },
            "lines": {
                line.name: {
                    "points_mm": line.points_mm.tolist(),
                    "colour": line.colour,
                    "width_mm": line.width_mm,
                }
                for line in cell.lines
            },
        }

    def _surface(self, shape: RigidShape) -> str:
        """The name of the file with a shape's surface, written when it comes first."""
        mesh, name = self._surfaces.get(shape.name, (None, ""))
        if mesh is not shape.mesh:
            self._shapes.mkdir(exist_ok=True)
            name = f"{self._written:05d}.ply"
            write_mesh(self._shapes / name, shape.mesh)
            self._surfaces[shape.name] = shape.mesh, name
            self._written += 1
        return name


def _write_seen(folder: Path, seen: Observation) -> None:
    frame = seen.content
    if not isinstance(frame, DepthFrame):
        (folder / CLOUD).write_bytes(cloud_ply(frame.points_mm, {}))
        return
    steps = np.rint(frame.depth_mm / files.DEPTH_UNIT_MM)
    held = np.where((steps >= 1) & (steps <= 65535), frame.depth_mm, np.nan)
    (folder / DEPTH).write_bytes(files.depth_png(replace(frame, depth_mm=held), compress_level=1))
    _write_json(folder / INTRINSICS, files.intrinsics_json(frame.intrinsics))
    if seen.mask is not None:
        from PIL import Image

        grey = Image.fromarray(seen.mask.astype(np.uint8) * np.uint8(255))
        grey.save(folder / MASK, format="PNG")


def _write_estimate(folder: Path, estimate: Estimate) -> None:
    folder.mkdir()
    cloud = estimate.cloud
    properties = {"label": cloud.labels, "probability": cloud.probability}
    (folder / "occupancy.ply").write_bytes(cloud_ply(cloud.points_mm, properties))
    for name, mesh in estimate.meshes.items():
        write_mesh(folder / f"{name}.ply", mesh)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def facts(result: TrackingResult) -> dict[str, Any]:
    """One line about a result (JSON types)."""
    seen = result.observation
    kind = None if seen is None else "cloud" if isinstance(seen.content, SensorCloud) else "depth"
    same = ("quality", "reason", "warning", "latency_ms", "cameras")
    return {
        "sequence": result.sequence,
        "stamp_ns": result.stamp_ns,
        "arrived_ns": None if seen is None else seen.arrived_ns,
        "seen": kind,
        **{name: getattr(result, name) for name in same},
    }


def report(result: TrackingResult) -> dict[str, Any]:
    """Everything about a result: its facts, times of stages, and the estimate's own report, or
    null with the reason."""
    return {
        **facts(result),
        "organ_points": None if result.organ is None else len(result.organ.points_mm),
        "seconds": dict(result.seconds),
        "estimate": None if result.estimate is None else result.estimate.report,
    }
