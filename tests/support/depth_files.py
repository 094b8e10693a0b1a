"""Depth images and their cameras to files."""

from __future__ import annotations

from pathlib import Path

from tumortrack.core.store import write_json
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.io.depth_files import DEPTH_UNIT_MM, depth_png, intrinsics_json


def write_depth_png(path: Path, frame: DepthFrame) -> None:
    path.write_bytes(depth_png(frame))


def write_frame_folder(folder: Path, frame: DepthFrame) -> None:
    """A frame in a folder of its own, as in scenes."""
    folder.mkdir(parents=True)
    write_depth_png(folder / "depth.png", frame)
    write_intrinsics(folder / "intrinsics.json", frame.intrinsics)


def write_intrinsics(path: Path, camera: Intrinsics, depth_unit_mm: float = DEPTH_UNIT_MM) -> None:
    write_json(path, intrinsics_json(camera) | {"depth_unit_mm": depth_unit_mm})
