"""One scene on disk, measurement and truth, in files that other programs can make: cloud.ply,
depth.png with intrinsics.json, kidney.ply (or of the organ's name), tumor_1.ply, ..., targets.csv,
evidence.json and meta.json. docs/conventions.md defines them.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8

from tumortrack.core import store
from tumortrack.core.config import check_seed
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Evidence
from tumortrack.core.mesh_query import contains, labels_of
from tumortrack.core.organ import KIDNEY, Organ, is_tumor, organ_entry, organ_in
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy, DepthFrame, SensorCloud
from tumortrack.io.csv_tables import read_rows
from tumortrack.io.depth_files import depth_png, intrinsics_json, read_cloud, read_depth_png
from tumortrack.io.evidence_files import evidence_json, read_evidence
from tumortrack.io.mesh_files import read_anatomy, write_anatomy
from tumortrack.io.ply import write_cloud_ply

# Our own scenes state in meta.json that the organ's surface includes its tumors.
_UNITED = "organ_includes_tumors"
_STAMP = "stamp_ns"
_TARGETS, _EVIDENCE = "targets.csv", "evidence.json"
_LARGEST_TABLE = 64 * 2**20  # bytes
_STICKS_OUT = 0.02  # share of a tumor's volume; smoothing alone makes less stick out
_ORGAN_SIZE_MM = (5.0, 1000.0)
TARGETS = 200
_COLUMNS = ("label", *(f"{frame}_{axis}" for frame in ("ct", "camera") for axis in "xyz"))


@dataclass(frozen=True, eq=False)
class Targets:
    """Points in the undeformed CT (LPS, mm), their true places in the camera frame (mm), labels."""

    points_ct: Float64[np.ndarray, "n 3"]
    points_mm: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class InnerPoints:
    """Points inside the undeformed anatomy, CT frame (LPS), mm, with their labels."""

    points_ct: Float64[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]

    def at(self, points_mm: Float[np.ndarray, "n 3"]) -> Targets:
        """Targets of a scene in which these points lie at ``points_mm`` (camera frame)."""
        return Targets(self.points_ct, points_mm, self.labels)


@dataclass(frozen=True, eq=False)
class Scene:
    """An observed cloud and the truth, camera frame, mm. ``reference.parts[0]`` is the whole organ,
    tumors included; ``depth`` the cloud's image, if known; ``meta`` plain JSON (recipe, origin,
    ...); ``targets`` inner points with known positions in the CT; ``evidence`` what is known beside
    the cloud."""

    cloud: SensorCloud
    reference: Anatomy
    depth: DepthFrame | None = None
    meta: dict[str, Any] = field(default_factory=dict)
    targets: Targets | None = None
    evidence: tuple[Evidence, ...] = ()

    def write(self, folder: str | Path) -> None:
        """Write a scene folder, all or nothing. Raises InputError: the folder exists already;
        StorageError: the disk refused."""
        with store.new_folder(Path(folder)) as aside:
            write_scene_files(aside, self)


def write_scene_files(folder: Path, scene: Scene) -> None:
    """Write a scene's files into an existing folder. Raises StorageError."""
    write_cloud_ply(folder / "cloud.ply", scene.cloud.points_mm)
    if scene.depth is not None:
        store.write_atomically(folder / "depth.png", depth_png(scene.depth))
        store.write_json(folder / "intrinsics.json", intrinsics_json(scene.depth.intrinsics))
    write_anatomy(folder, scene.reference)
    if scene.targets is not None:
        points = scene.targets.points_ct, scene.targets.points_mm
        table, text = np.column_stack([scene.targets.labels, *points]), io.StringIO()
        numbers, head = ["%d", *["%.5f"] * 6], ",".join(_COLUMNS)  # to 0.01 micrometres
        np.savetxt(text, table, numbers, delimiter=",", header=head, comments="")
        store.write_atomically(folder / _TARGETS, text.getvalue().encode())
    if scene.evidence:
        store.write_atomically(folder / _EVIDENCE, evidence_json(scene.evidence))
    fixed = {"units": "mm", "frame": "camera", _STAMP: scene.cloud.stamp_ns, _UNITED: True}
    meta = {**scene.meta, **fixed, "organ": organ_entry(scene.reference.organ_kind)}
    store.write_json(folder / "meta.json", meta)


def read_scene(folder: Path) -> Scene:
    """Read a scene, ours or another program's.

    The organ is the one that meta.json names, else the one surface that is no tumor. Unless
    meta.json says that it includes the tumors, a tumor that sticks out of it by more than 2 % of
    its volume is united with it. Raises InputError: no such folder, no cloud or organ, a file
    that cannot be read, surfaces that are open or not in mm."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a scene folder (it does not exist).")
    meta = store.read_json(folder / "meta.json") if (folder / "meta.json").exists() else {}
    kind = organ_of_folder(folder, meta)
    for name in ("cloud.ply", f"{kind.name}.ply"):
        if not (folder / name).is_file():
            raise InputError(
                f"{folder} is not a scene: it lacks {name}. A scene holds cloud.ply, kidney.ply "
                "(or another organ's name), tumor_1.ply, ... in the camera frame, in mm."
            )
    reference = read_anatomy(folder, kind)
    _check_parts(folder, reference)
    if meta.get(_UNITED) is not True:
        reference = _united(folder, reference)
    stamp_ns = meta.get(_STAMP, 0)
    if not isinstance(stamp_ns, int):
        raise InputError(f"{folder / 'meta.json'}: {_STAMP} must be a whole number of ns.")
    depth, camera, table = (folder / name for name in ("depth.png", "intrinsics.json", _TARGETS))
    if depth.exists() and not camera.exists():
        raise InputError(f"{folder} has depth.png but lacks intrinsics.json, which explains it.")
    frame = read_depth_png(depth, camera) if depth.exists() else None
    error = None if frame is None else frame.depth_error
    points_mm = read_cloud(folder / "cloud.ply")[0].points_mm
    cloud = SensorCloud(points_mm, stamp_ns, depth_error=error)
    targets = read_targets(table) if table.exists() else None
    file = folder / _EVIDENCE
    evidence = read_evidence(file)[1] if file.exists() else ()
    return Scene(cloud, reference, frame, meta, targets, evidence)


def organ_of_folder(folder: Path, meta: dict[str, Any]) -> Organ:
    """The organ that a scene's ``meta`` names, else that of its one surface which is no tumor;
    where there is none, a kidney. Raises InputError: there are several."""
    if "organ" in meta:
        return organ_in(meta["organ"], str(folder / "meta.json"))
    surfaces = {path.stem for path in folder.glob("*.ply")} - {"cloud"}
    names = sorted(name for name in surfaces if not is_tumor(name))
    if len(names) > 1 and KIDNEY.name not in names:
        raise InputError(
            f"{folder} has {' and '.join(names[:3])}, which are no tumors. One surface is the "
            'organ; name it in meta.json: "organ": {"name": "liver"}.'
        )
    return Organ(name=names[0]) if len(names) == 1 else KIDNEY


def list_scenes(folder: Path) -> list[Path]:
    """The scene folders (those with a cloud.ply or a surface) in a folder, sorted by name. Raises
    InputError: there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder} does not exist or is not a folder.")
    visible = (path for path in folder.iterdir() if not path.name.startswith("."))
    scenes = sorted((path for path in visible if any(path.glob("*.ply"))), key=store.natural)
    if not scenes:
        raise InputError(f"{folder} holds no scenes. Make some: tumortrack simulate CASE DATASET.")
    return scenes


def _check_parts(folder: Path, anatomy: Anatomy) -> None:
    last = f"tumor_{len(anatomy.tumors)}"
    beyond = {path.stem for path in folder.glob("tumor_*.ply")} - set(anatomy.names)
    if beyond:
        stray = folder / f"{sorted(beyond)[0]}.ply"
        raise InputError(f"{stray} does not follow {last}.ply. Number them without a gap.")
    low, high = _ORGAN_SIZE_MM
    size_mm = anatomy.organ.longest_mm
    if not low <= size_mm <= high:
        path = folder / f"{anatomy.organ_kind.name}.ply"
        allowed = f"{low:g} to {high:g} mm"
        raise InputError(f"{path} is {size_mm:.3g} wide; an organ has {allowed}. Scale all to mm.")


def _united(folder: Path, anatomy: Anatomy) -> Anatomy:
    """The anatomy with every tumor that sticks out united with the organ's surface."""
    whole = organ = solid_of(anatomy.organ, str(folder / f"{anatomy.names[0]}.ply"))
    for name, mesh in zip(anatomy.names[1:], anatomy.tumors, strict=True):
        tumor = solid_of(mesh, str(folder / f"{name}.ply"))
        joined = organ + tumor
        if joined.volume() - organ.volume() > _STICKS_OUT * tumor.volume():
            organ = joined
    return anatomy if organ is whole else anatomy.with_parts((mesh_of(organ), *anatomy.tumors))


def draw_targets(anatomy_ct: Anatomy, seed: int) -> InnerPoints:
    """``TARGETS`` points, uniform inside each part: half of them in the parenchyma, the others
    shared by the tumors; without tumors all in the organ. Raises InputError: a tumor that others
    cover, or a seed out of range."""
    check_seed(seed)
    rng = np.random.default_rng([seed, 1000])
    n_tumors = len(anatomy_ct.tumors)
    in_parenchyma = TARGETS // 2 if n_tumors else TARGETS
    per_tumor = np.full(n_tumors, (TARGETS - in_parenchyma) // max(n_tumors, 1))
    per_tumor[: TARGETS - in_parenchyma - per_tumor.sum()] += 1
    points, counts = [], [in_parenchyma, *per_tumor.tolist()]
    for label, (part, count) in enumerate(zip(anatomy_ct.parts, counts, strict=True), start=1):
        accepted = np.zeros((0, 3))
        for _ in range(40):
            if len(accepted) >= count:
                break
            low, high = part.box_mm
            drawn = low + rng.random((4 * TARGETS, 3)) * (high - low)
            drawn = drawn[contains(part, drawn)]
            accepted = np.concatenate([accepted, drawn[labels_of(anatomy_ct, drawn) == label]])
        else:
            name = anatomy_ct.names[label - 1]
            raise InputError(f"{name} has no room for target points: other tumors cover it.")
        points.append(accepted[:count])
    labels = np.repeat(np.arange(1, len(counts) + 1, dtype=np.uint8), counts)
    return InnerPoints(np.concatenate(points), labels)


def read_targets(path: Path) -> Targets:
    """Read targets.csv, ours or another program's; further columns are ignored. Raises InputError:
    missing columns or rows, or values that are not finite numbers."""
    table = read_rows(store.read_file(path, _LARGEST_TABLE), str(path), _COLUMNS).numbers(_COLUMNS)
    labels = table[:, 0]
    if not np.isfinite(table).all() or not np.isin(labels, np.arange(1, 256)).all():
        raise InputError(
            f"{path} has a row that is no target: labels are 1 (organ), 2, 3, ... (tumors), and "
            "places finite."
        )
    return Targets(table[:, 1:4], table[:, 4:], labels.astype(np.uint8))
