"""One scene on disk: what the sensor saw and the truth, in files that other programs can make.

cloud.ply (camera frame, mm), depth.png (16 bit, steps of 0.1 mm) with intrinsics.json, kidney.ply,
tumor_1.ply, ... (the truth, camera frame, mm), targets.csv (inner points in both frames) and
meta.json. Depth, targets and meta.json may be absent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_files import read_anatomy, write_anatomy
from tumortrack.core.store import new_folder, read_json, write_atomically, write_json
from tumortrack.core.types import Anatomy, DepthFrame, SensorCloud
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.sense.files import depth_png, intrinsics_json, read_cloud, read_depth_png
from tumortrack.sense.ply import write_cloud_ply
from tumortrack.simulate.targets import Targets, read_targets, write_targets

# Our own scenes state in meta.json that kidney.ply is the whole organ, tumors included.
_UNITED = "organ_includes_tumors"
_STAMP = "stamp_ns"
_TARGETS = "targets.csv"
_STICKS_OUT = 0.02  # of a tumor's volume: smoothing alone lets it stick out by less
_ORGAN_SIZE_MM = (5.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """An observed cloud and the truth behind it, camera frame, mm.

    ``reference.parts[0]`` is the whole organ, tumors included. ``depth`` is the image that the
    cloud was taken from, where it is known; ``meta`` is plain JSON (recipe, origin, ...);
    ``targets`` are inner points with known positions in the CT.
    """

    cloud: SensorCloud
    reference: Anatomy
    depth: DepthFrame | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    targets: Targets | None = None

    def write(self, folder: str | Path) -> None:
        """See ``write_scene``."""
        write_scene(Path(folder), self)


def write_scene(folder: Path, scene: Scene) -> None:
    """Write a scene folder, all or nothing.

    Raises:
        InputError: the folder exists already.
        StorageError: the disk refused.
    """
    with new_folder(folder) as aside:
        write_scene_files(aside, scene)


def write_scene_files(folder: Path, scene: Scene) -> None:
    """A scene's files into a folder that is being filled aside.

    Raises:
        StorageError: the disk refused.
    """
    write_cloud_ply(folder / "cloud.ply", scene.cloud.points_mm)
    if scene.depth is not None:
        write_atomically(folder / "depth.png", depth_png(scene.depth))
        write_json(folder / "intrinsics.json", intrinsics_json(scene.depth.intrinsics))
    write_anatomy(folder, scene.reference)
    if scene.targets is not None:
        write_targets(folder / _TARGETS, scene.targets)
    meta = {**scene.meta, "units": "mm", "frame": "camera", _STAMP: scene.cloud.stamp_ns}
    write_json(folder / "meta.json", {**meta, _UNITED: True})


def read_scene(folder: Path) -> Scene:
    """Read a scene, ours or another program's.

    Unless meta.json says that the kidney includes the tumors, a tumor that sticks out of
    kidney.ply by more than 2 % of its volume is united with it.

    Raises:
        InputError: no such folder, no cloud or kidney, a file that cannot be read, surfaces that
            are open or not in mm.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no scene folder (it does not exist).")
    for name in ("cloud.ply", "kidney.ply"):
        if not (folder / name).is_file():
            raise InputError(
                f"{folder} is no scene: it lacks {name}. A scene holds cloud.ply, kidney.ply and "
                "tumor_1.ply, tumor_2.ply, ... in the camera frame, in mm."
            )
    meta = read_json(folder / "meta.json") if (folder / "meta.json").exists() else {}
    reference = read_anatomy(folder)
    _check_parts(folder, reference)
    if meta.get(_UNITED) is not True:
        reference = _united(folder, reference)
    stamp_ns = meta.get(_STAMP, 0)
    if not isinstance(stamp_ns, int):
        raise InputError(f"{folder / 'meta.json'}: {_STAMP} must be a whole number of ns.")
    cloud, _ = read_cloud(folder / "cloud.ply")
    targets = read_targets(folder / _TARGETS) if (folder / _TARGETS).exists() else None
    cloud = SensorCloud(cloud.points_mm, stamp_ns)
    return Scene(cloud, reference, _depth(folder), meta, targets)


def list_scenes(folder: Path) -> list[Path]:
    """The scene folders (those with a kidney.ply or cloud.ply) in a folder, by name.

    Raises:
        InputError: no such folder, or no scene in it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} does not exist or is no folder.")
    scenes = sorted(
        path
        for path in folder.iterdir()
        if not path.name.startswith(".")
        and ((path / "kidney.ply").is_file() or (path / "cloud.ply").is_file())
    )
    if not scenes:
        raise InputError(
            f"{folder} holds no scenes: none of its folders has a cloud.ply and a kidney.ply. "
            "Make some with: tumortrack simulate CASE DATASET."
        )
    return scenes


def _depth(folder: Path) -> DepthFrame | None:
    image, camera = folder / "depth.png", folder / "intrinsics.json"
    if not image.exists():
        return None
    if not camera.exists():
        raise InputError(f"{folder} has depth.png but lacks intrinsics.json, which explains it.")
    return read_depth_png(image, camera)


def _check_parts(folder: Path, anatomy: Anatomy) -> None:
    last = f"tumor_{len(anatomy.tumors)}"
    strays = {path.stem for path in folder.glob("tumor_*.ply")} - set(anatomy.names)
    if strays:
        raise InputError(
            f"{folder}: {sorted(strays)[0]}.ply does not follow {last}.ply. Number the tumors "
            "1, 2, 3, ... without a gap."
        )
    low, high = _ORGAN_SIZE_MM
    size_mm = float(np.ptp(anatomy.organ.box_mm, axis=0).max())
    if not low <= size_mm <= high:
        raise InputError(
            f"{folder / 'kidney.ply'} is {size_mm:.3g} wide; an organ has {low:g} to {high:g} mm. "
            "Scale the meshes and the cloud to mm."
        )


def _united(folder: Path, anatomy: Anatomy) -> Anatomy:
    """The same anatomy with every tumor that sticks out made part of the organ's surface."""
    whole = organ = solid_of(anatomy.organ, str(folder / "kidney.ply"))
    for name, mesh in zip(anatomy.names[1:], anatomy.tumors, strict=True):
        tumor = solid_of(mesh, str(folder / f"{name}.ply"))
        joined = organ + tumor
        if joined.volume() - organ.volume() > _STICKS_OUT * tumor.volume():
            organ = joined
    return anatomy if organ is whole else Anatomy((mesh_of(organ), *anatomy.tumors))
