"""Results as plain files: a folder each, and one line each in index.jsonl. Camera frame, mm."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from tumortrack.core.errors import StorageError, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.mesh_files import write_mesh
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud
from tumortrack.live.recording.folders import CLOUD, DEPTH, FRAMES, INTRINSICS, MASK, REPORT
from tumortrack.live.values import Observation, RigidShape, TrackingResult, Workcell
from tumortrack.sense.files import DEPTH_UNIT_MM, depth_png, intrinsics_json
from tumortrack.sense.ply import cloud_ply

INDEX = "index.jsonl"
SHAPES, WORKCELL = "shapes", "workcell.json"
_ESTIMATE = "estimate"  # apart from what was seen: these surfaces are no truth


class FrameFolders:
    """``frames/00000012/``: depth.png and intrinsics.json (and mask.png), or cloud.ply;
    report.json; ``estimate/``: occupancy.ply, kidney.ply, tumor_1.ply, ...; with arms
    workcell.json: state, halted, joints (radians), lines and the places of shapes, in the
    published frame; each surface stands once in ``shapes/``, in the shape's own frame.

    Depths are rounded to 0.1 mm; those that 16 bits of it cannot hold (from 6553.5 mm) are left
    out. Files are not forced to the disk one by one, as that would take longer than a frame.

    Raises:
        StorageError: the disk refused; the frame's folder is taken away again.
    """

    def __init__(self, folder: Path, frames: bool) -> None:
        self._root, self._frames = folder / FRAMES, frames
        self._root.mkdir(parents=True)
        self._index = (folder / INDEX).open("ab", buffering=0)
        self._shapes = folder / SHAPES
        self._surfaces: dict[str, tuple[Mesh, str]] = {}  # by shape: the last, and its file
        self._written = 0

    def write(self, result: TrackingResult) -> None:
        folder = self._root / f"{result.sequence:08d}"
        try:
            folder.mkdir()
            if self._frames and result.observation is not None:
                _write_seen(folder, result.observation)
            if result.estimate is not None:
                _write_estimate(folder / _ESTIMATE, result.estimate)
            if result.workcell is not None:
                self._write_workcell(folder / WORKCELL, result.workcell)
            text = json.dumps(report(result), indent=1, allow_nan=False)
            (folder / REPORT).write_text(text + "\n", encoding="utf-8")
            line = json.dumps({**facts(result), "folder": folder.name}) + "\n"
            self._index.write(line.encode())
        except (OSError, StorageError) as error:
            shutil.rmtree(folder, ignore_errors=True)
            if isinstance(error, TumortrackError):
                raise
            raise StorageError(f"cannot write {folder}: {error.strerror or error}.") from error

    def close(self) -> None:
        self._index.close()

    def _write_workcell(self, path: Path, cell: Workcell) -> None:
        shapes = {
            shape.name: {
                "surface": f"{SHAPES}/{self._surface(shape)}",
                "published_from_shape": shape.published_from_shape.tolist(),
                "colour": shape.colour,
                "opacity": shape.opacity,
            }
            for shape in cell.shapes
        }
        lines = {
            line.name: {
                "points_mm": line.points_mm.tolist(),
                "colour": line.colour,
                "width_mm": line.width_mm,
            }
            for line in cell.lines
        }
        content = {
            "state": cell.state,
            "halted": cell.halted,
            "joints_rad": {name: float(angle) for name, angle in cell.joints_rad.items()},
            "shapes": shapes,
            "lines": lines,
        }
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")

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
    steps = np.rint(frame.depth_mm / DEPTH_UNIT_MM)
    held = np.where((steps >= 1) & (steps <= 65535), frame.depth_mm, np.nan)
    (folder / DEPTH).write_bytes(depth_png(replace(frame, depth_mm=held), compress_level=1))
    camera = json.dumps(intrinsics_json(frame.intrinsics), indent=1)
    (folder / INTRINSICS).write_text(camera + "\n", encoding="utf-8")
    if seen.mask is not None:
        from PIL import Image

        stream = io.BytesIO()
        Image.fromarray(seen.mask.astype(np.uint8) * np.uint8(255)).save(stream, format="PNG")
        (folder / MASK).write_bytes(stream.getvalue())


def _write_estimate(folder: Path, estimate: Estimate) -> None:
    folder.mkdir()
    cloud = estimate.cloud
    properties = {"label": cloud.labels, "probability": cloud.probability}
    points = cloud_ply(cloud.points_mm, properties)
    (folder / "occupancy.ply").write_bytes(points)
    for name, mesh in estimate.meshes.items():
        write_mesh(folder / f"{name}.ply", mesh)


def facts(result: TrackingResult) -> dict:
    """One line about a result (JSON types)."""
    seen = None
    if result.observation is not None:
        seen = "cloud" if isinstance(result.observation.content, SensorCloud) else "depth"
    return {
        "sequence": result.sequence,
        "stamp_ns": result.stamp_ns,
        "arrived_ns": None if result.observation is None else result.observation.arrived_ns,
        "seen": seen,
        "quality": result.quality,
        "reason": result.reason,
        "warning": result.warning,
        "latency_ms": result.latency_ms,
    }


def report(result: TrackingResult) -> dict:
    """Everything about a result: its facts, times of stages, and the estimate's own report, or
    null with the reason."""
    return {
        **facts(result),
        "organ_points": None if result.organ is None else len(result.organ.points_mm),
        "seconds": dict(result.seconds),
        "estimate": None if result.estimate is None else result.estimate.report,
    }
