"""The folder of a plan: numbers as JSON, strokes and surfaces as PLY, motions as safetensors.

Everything in it is in the table's frame, mm; ``plan.json`` has ``table_from_camera``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.mesh_files import read_mesh, write_mesh
from tumortrack.core.types import Mesh
from tumortrack.plan.motions import JOINTS, Motions, MotionStage
from tumortrack.plan.values import Located, ResectionConfig, ResectionPlan
from tumortrack.sense.ply import cloud_ply

KIND = "plan"
_NAME, _STROKES, _MOTIONS = "plan.json", "strokes.ply", "motions.safetensors"


@dataclass(frozen=True, eq=False)
class PlanFolder:
    """What a plan's folder holds. ``cell``: the workcell's configuration that the motions are for,
    as JSON; motions and cell are None where no arms were planned. ``case_sha256``: of the case that
    the organ was located by; empty where unknown."""

    plan: ResectionPlan
    config: ResectionConfig
    table_from_camera: Float64[np.ndarray, "4 4"]
    frame_id: str
    meshes: dict[str, Mesh]
    cell: dict[str, Any] | None = None
    motions: Motions | None = None
    case_sha256: str = ""


def write_plan(
    folder: Path,
    content: PlanFolder,
    inputs: dict[str, str],
    more: Callable[[Path], None],
    overwrite: bool = False,
) -> None:
    """All or nothing. ``inputs``: sha256 of what it was made from; ``more`` adds files (pictures)
    to the folder given to it.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
        StorageError: the disk refused.
    """
    plan, motions = content.plan, content.motions
    data = {
        "frame_id": content.frame_id,
        "table_from_camera": content.table_from_camera.tolist(),
        "config": to_builtins(content.config),
        "case_sha256": content.case_sha256,
        "plan": as_builtins(plan),
        "cell": content.cell,
        "seconds": motions and motions.seconds,
    }
    with store.new_folder(folder, overwrite) as aside:
        store.write_json(aside / _NAME, data)
        store.write_atomically(aside / _STROKES, _strokes(plan))
        for name, mesh in content.meshes.items():
            write_mesh(aside / f"{name}.ply", mesh)
        if motions is not None:
            _write_motions(aside / _MOTIONS, motions)
        more(aside)
        store.seal(aside, KIND, {"inputs": inputs}, frame=content.frame_id)


def as_located(content: PlanFolder) -> Located:
    """What the plan was made on, without its cloud: for pictures."""
    points, labels = np.zeros((0, 3)), np.zeros(0, np.uint8)
    return Located(points, labels, content.meshes, stamp_ns=content.plan.stamp_ns)


def read_plan(folder: Path) -> PlanFolder:
    """
    Raises:
        ArtifactError: no plan, damaged, or of another version.
    """
    manifest = store.read_manifest(folder, KIND)
    data, path = store.read_json(folder / _NAME), folder / _MOTIONS
    surfaces = {Path(file).stem for file in manifest["files"] if file.endswith(".ply")}
    meshes = {name: read_mesh(folder / f"{name}.ply") for name in sorted(surfaces - {"strokes"})}
    motions = _read_motions(path) if path.is_file() else None
    try:
        return PlanFolder(
            plan=from_plain(data["plan"]),
            config=from_builtins(data["config"], ResectionConfig, str(folder / _NAME)),
            table_from_camera=np.array(data["table_from_camera"], float),
            frame_id=str(data["frame_id"]),
            meshes=meshes,
            cell=data["cell"],
            motions=motions,
            case_sha256=str(data["case_sha256"]),
        )
    except (KeyError, TypeError, ValueError, InputError, msgspec.ValidationError) as error:
        raise ArtifactError(f"{folder / _NAME} lacks or spoils {error}; plan again.") from error


def as_builtins(plan: ResectionPlan) -> dict[str, Any]:
    """The plan as JSON holds it; an infinite height is null."""
    return {
        "method": plan.method,
        "tumor": plan.tumor,
        "label": plan.label,
        "grasp_mm": plan.grasp_mm.tolist(),
        "approach": [0.0, 0.0, -1.0],
        "margin_mm": plan.margin_mm,
        "exophytic": plan.exophytic,
        "volumes_ml": plan.volumes_ml,
        "stamp_ns": plan.stamp_ns,
        "notes": list(plan.notes),
        "cuts": [
            {
                "sweep": cut.sweep,
                "kind": cut.kind,
                "closed": cut.closed,
                "length_mm": round(cut.length_mm, 1),
                "path_mm": cut.path_mm.round(4).tolist(),
            }
            for cut in plan.cuts
        ],
        "layers": [
            {
                "bottom_mm": layer.bottom_mm,
                "top_mm": layer.top_mm if np.isfinite(layer.top_mm) else None,
                "rings_mm": [ring.round(4).tolist() for ring in layer.rings_mm],
            }
            for layer in plan.layers
        ],
    }


def from_plain(data: dict[str, Any]) -> ResectionPlan:
    """The inverse of ``as_builtins``; raises KeyError, TypeError, ValueError or ValidationError for
    other data."""
    layers = [dict(layer) for layer in data["layers"]]
    for layer in layers:
        layer["top_mm"] = np.inf if layer["top_mm"] is None else layer["top_mm"]
    read = {**data, "layers": layers}
    return msgspec.convert(read, ResectionPlan, dec_hook=lambda _, value: np.array(value, float))


def _strokes(plan: ResectionPlan) -> bytes:
    """The strokes' points in their order, each with its sweep, its stroke and whether it is one of
    the floor; the grasp point last, with sweep 0."""
    points = [*(cut.path_mm for cut in plan.cuts), plan.grasp_mm[None]]
    rows = [(cut.sweep, n, cut.kind == "floor") for n, cut in enumerate(plan.cuts, start=1)]
    columns = np.repeat([*rows, (0, 0, 0)], [len(each) for each in points], axis=0).T
    kinds = {"sweep": np.int32, "stroke": np.int32, "floor": np.uint8}
    properties = {
        name: column.astype(kind)
        for (name, kind), column in zip(kinds.items(), columns, strict=True)
    }
    return cloud_ply(np.concatenate(points), properties, "table (z up)")


def _write_motions(path: Path, motions: Motions) -> None:
    from safetensors.numpy import save

    tensors: dict[str, np.ndarray] = {}
    for n, stage in enumerate(motions.stages):
        tensors |= {f"{n}.times_s": stage.times_s, f"{n}.joints_rad": stage.joints_rad}
        tensors[f"{n}.cutting"] = np.asarray(stage.cutting, np.uint8)
    names = {"stages": json.dumps([s.name for s in motions.stages]), "joints": json.dumps(JOINTS)}
    store.write_atomically(path, save(tensors, metadata=names))


def _read_motions(path: Path) -> Motions:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as tensors:
            named = tensors.metadata() or {}
            if json.loads(named.get("joints", "[]")) != list(JOINTS):
                raise ArtifactError(f"{path} is for other arms' joints; plan again.")
            stages = tuple(
                MotionStage(
                    name,
                    tensors.get_tensor(f"{number}.times_s"),
                    tensors.get_tensor(f"{number}.joints_rad"),
                    tensors.get_tensor(f"{number}.cutting").astype(bool),
                )
                for number, name in enumerate(json.loads(named["stages"]))
            )
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise ArtifactError(f"{path} cannot be read: {error}. Plan again.") from error
    return Motions(stages)
