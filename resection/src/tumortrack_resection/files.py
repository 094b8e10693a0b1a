"""The folder of a plan: JSON, strokes and surfaces as PLY, motions as safetensors and, for MoveIt,
moveit_msgs/RobotTrajectory. All in the table's frame, mm; ``plan.json`` has ``table_from_camera``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.errors import ArtifactError, InputError, NoPlan
from tumortrack.core.organ import is_tumor, organ_first
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.types import Mesh
from tumortrack.io.mesh_files import read_mesh, write_mesh
from tumortrack.io.ply import cloud_ply
from tumortrack.live.values import PublishedFrame
from tumortrack_resection.arms.config import CellConfig
from tumortrack_resection.budget import ErrorBudget
from tumortrack_resection.motions import JOINTS, Motions, MotionStage, Stage
from tumortrack_resection.values import Located, ResectionConfig, ResectionPlan

KIND = "plan"
_NAME, _STROKES, _MOTIONS = "plan.json", "strokes.ply", "motions.safetensors"
_PIECE = "piece"
INVENTED = "invented"  # a frame or cell that no file of the user's gave
_OVER = 1.01  # of speeds: their limits are kept at grid points only
_GAP_RAD = 1e-6
_LONGEST_S = 4 * 3600.0  # no resection takes so long


@dataclass(frozen=True, eq=False)
class PlanFolder:
    """The content of a plan's folder. ``frames``: in which a live run publishes. ``cell``: of the
    motions; both are None if no arms were planned. ``case_sha256``: of the case by which the organ
    was located; empty: unknown. ``frame_source``, ``cell_source``: sha256 of the user's file with
    the frame, with the bases; or ``INVENTED``."""

    plan: ResectionPlan
    config: ResectionConfig
    frames: PublishedFrame
    meshes: dict[str, Mesh]
    budgets: tuple[ErrorBudget, ...] = ()
    cell: CellConfig | None = None
    motions: Motions | None = None
    case_sha256: str = ""
    frame_source: str = INVENTED
    cell_source: str = INVENTED
    patient: Patient = NOBODY
    structures: dict[str, Mesh] = field(default_factory=dict)

    @property
    def located(self) -> Located:
        """What the plan was made on, without its cloud, for pictures and checks."""
        return Located(
            np.zeros((0, 3)), np.zeros(0, np.uint8), self.meshes, stamp_ns=self.plan.stamp_ns,
            patient=self.patient, structures=self.structures,
        )  # fmt: skip


class _Stored(msgspec.Struct, kw_only=True):
    """plan.json. ``plan``: as ``as_builtins`` has it."""

    frame_id: str
    table_from_camera: list[list[float]]
    config: ResectionConfig
    case_sha256: str
    patient: Patient
    frame_source: str
    cell_source: str
    camera_frame_id: str
    table_in_camera: tuple[float, float, float, float] | None
    plan: dict[str, Any]
    budgets: tuple[ErrorBudget, ...]
    structures: list[str]
    cell: CellConfig | None
    seconds: float | None


# Fields of both under their own names
_ALIKE = ("config", "budgets", "cell", "case_sha256", "frame_source", "cell_source", "patient")


def check_structures(names: Collection[str]) -> None:
    """InputError: one has the name of a file of the plan's own."""
    if taken := sorted({_PIECE, Path(_STROKES).stem} & set(names)):
        raise InputError(
            f"a structure is called {taken[0]}, as a file of the plan is. Prepare the case with "
            "another name for it."
        )


def write_plan(
    folder: Path, content: PlanFolder, inputs: dict[str, str], more: Callable[[Path], None],
    overwrite: bool = False,
) -> None:  # fmt: skip
    """All or nothing. ``inputs``: sha256 of what it was made from; ``more`` adds files to a folder.
    Raises InputError: the folder exists and ``overwrite`` is False; NoPlan: motions that would be
    refused when read; StorageError: the disk refused."""
    plan, motions, frames = content.plan, content.motions, content.frames
    if motions is not None:
        assert content.cell is not None
        for fault in _faults(motions, content.cell, plan.sweeps):
            raise NoPlan(f"the arms can't carry this out: {fault}.")
    data = _Stored(
        frame_id=frames.frame_id, table_from_camera=frames.published_from_camera.tolist(),
        camera_frame_id=frames.camera_frame_id, table_in_camera=frames.table_in_camera,
        plan=as_builtins(plan), structures=list(content.structures),
        seconds=None if motions is None else motions.seconds,
        **{name: getattr(content, name) for name in _ALIKE},
    )  # fmt: skip
    with store.new_folder(folder, overwrite) as aside:
        store.write_json(aside / _NAME, msgspec.to_builtins(data))
        store.write_atomically(aside / _STROKES, _strokes(plan))
        surfaces = {**content.meshes, **content.structures, _PIECE: plan.piece}
        for name, mesh in surfaces.items():
            write_mesh(aside / f"{name}.ply", mesh)
        if motions is not None:
            _write_motions(aside / _MOTIONS, motions)
            trajectories = ros_trajectories(motions, frames.frame_id)
            store.write_atomically(aside / "trajectories.json", trajectories)
        more(aside)
        store.seal(aside, KIND, {"inputs": inputs}, frame=frames.frame_id)


def read_plan(folder: Path) -> PlanFolder:
    """Raises ArtifactError: no plan, damaged, of another version, or with motions that the planner
    would not make."""
    manifest = store.read_manifest(folder, KIND)
    data, path = store.read_json(folder / _NAME), folder / _MOTIONS
    surfaces = {Path(file).stem for file in manifest["files"] if file.endswith(".ply")}
    meshes = {
        name: read_mesh(folder / f"{name}.ply") for name in organ_first(surfaces - {"strokes"})
    }
    piece = meshes.pop(_PIECE, None)
    motions = _read_motions(path) if path.is_file() else None
    try:
        read = msgspec.convert(data, _Stored)
        structures = {name: meshes.pop(name) for name in read.structures}
        plan, pose = from_plain(read.plan, piece), np.array(read.table_from_camera, float)
        frames = PublishedFrame(
            read.frame_id, pose, read.frame_source != INVENTED, read.camera_frame_id,
            read.table_in_camera,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, InputError, msgspec.ValidationError) as error:
        raise ArtifactError(f"{folder / _NAME} lacks or spoils {error}; plan again.") from error
    parts = [budget.part for budget in read.budgets]
    if parts[:1] != [plan.tumor] or {*parts} != {name for name in meshes if is_tumor(name)}:
        raise ArtifactError(f"{folder / _NAME} lacks a tumor's error budget; plan again.")
    if motions is not None:
        if read.cell is None:
            raise ArtifactError(f"{folder} has motions and no cell that they are for. Plan again.")
        for fault in _faults(motions, read.cell, plan.sweeps):
            raise ArtifactError(f"{path} can't be carried out: {fault}. Plan again.")
    alike = {name: getattr(read, name) for name in _ALIKE}
    return PlanFolder(
        plan=plan, frames=frames, meshes=meshes, motions=motions, structures=structures, **alike
    )


def as_builtins(plan: ResectionPlan) -> dict[str, Any]:
    """The plan as JSON holds it: without the piece, which is a surface of its own."""

    def plain(array: np.ndarray | np.floating[Any]) -> Any:
        return (array.round(4) if array.ndim == 2 else array).tolist()  # of lines: 0.1 micrometres

    values = {each.name: getattr(plan, each.name) for each in fields(plan) if each.name != _PIECE}
    data: dict[str, Any] = msgspec.to_builtins(values, enc_hook=plain)
    for cut, stored in zip(plan.cuts, data["cuts"], strict=True):
        stored |= {"closed": cut.closed, "length_mm": round(cut.length_mm, 1)}
    return {**data, "approach": [0.0, 0.0, -1.0]}


def from_plain(data: dict[str, Any], piece: Mesh | None) -> ResectionPlan:
    """The inverse of ``as_builtins``; raises KeyError, TypeError, ValueError, ValidationError."""
    if piece is None:
        raise KeyError(f"{_PIECE}.ply")
    kinds = get_type_hints(ResectionPlan)
    read = {
        name: msgspec.convert(data[name], kind, dec_hook=lambda _, value: np.array(value, float))
        for name, kind in kinds.items()
        if name not in (_PIECE, "facets")
    }
    read["facets"] = np.array(data["facets"], float).reshape(-1, 4)
    return ResectionPlan(piece=piece, **read)


def _strokes(plan: ResectionPlan) -> bytes:
    """The strokes' points in order, each with its sweep and its stroke; the grasp point last, with
    sweep 0."""
    points = [*(cut.path_mm for cut in plan.cuts), plan.grasp_mm[None]]
    rows = [(cut.sweep, n) for n, cut in enumerate(plan.cuts, start=1)]
    columns = np.repeat([*rows, (0, 0)], [len(each) for each in points], axis=0).T
    properties = {
        name: column.astype(np.int32)
        for name, column in zip(("sweep", "stroke"), columns, strict=True)
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
                raise ValueError("it is for other arms' joints")
            stages = tuple(
                MotionStage(
                    name,
                    tensors.get_tensor(f"{number}.times_s").astype(float),
                    tensors.get_tensor(f"{number}.joints_rad").astype(float),
                    tensors.get_tensor(f"{number}.cutting").astype(bool),
                )
                for number, name in enumerate(json.loads(named["stages"]))
            )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, InputError) as error:
        reason = str(error).rstrip(".")
        raise ArtifactError(f"{path} cannot be read: {reason}. Plan again.") from error
    return Motions(stages)


def ros_trajectories(motions: Motions, frame_id: str) -> bytes:
    """Motions for MoveIt as JSON, which ROS 2 reads as YAML, without stages in which none moves."""
    stages = [
        {"name": stage.name, "seconds": stage.seconds, "trajectory": _trajectory(stage, frame_id)}
        for stage in motions.stages
        if len(stage.times_s) > 1
    ]
    return json.dumps({"frame_id": frame_id, "stages": stages}).encode()


def _trajectory(stage: MotionStage, frame_id: str) -> dict[str, Any]:
    """At rest at both ends."""
    speeds = np.gradient(stage.joints_rad, stage.times_s, axis=0)
    speeds[[0, -1]] = 0
    points = []
    for time_s, joints, speed in zip(stage.times_s, stage.joints_rad, speeds, strict=True):
        seconds, nanoseconds = divmod(round(time_s * 1e9), 1_000_000_000)
        points.append(
            {
                "positions": np.round(joints, 7).tolist(),
                "velocities": np.round(speed, 6).tolist(),
                "time_from_start": {"sec": seconds, "nanosec": nanoseconds},
            }
        )
    about = {"header": {"frame_id": frame_id}, "joint_names": list(JOINTS), "points": points}
    return {"joint_trajectory": about}


def _faults(motions: Motions, cell: CellConfig, sweeps: int) -> Iterator[str]:
    """What the planner would not do."""
    names = [stage.name for stage in motions.stages]
    cuts = [f"sweep {n}" for n in range(1, sweeps + 1)]
    pull = [Stage.PULL, Stage.TAUT] if cell.pull_mm else []
    if names != ["approach", "grasp", Stage.HOLD, *pull, *cuts, Stage.LIFT, Stage.RELEASE, "home"]:
        yield f"its stages are {', '.join(names) or 'none'}"
    for stage in motions.stages:
        if not (np.isfinite(stage.times_s).all() and np.isfinite(stage.joints_rad).all()):
            yield f"{stage.name} has times or joints that are no numbers"
        if (over := np.abs(stage.joints_rad) - cell.limits_rad).max() > 0:
            joint = JOINTS[int(over.max(0).argmax())]
            yield f"{joint} turns beyond its limit in {stage.name}"
        speeds = np.abs(np.diff(stage.joints_rad, axis=0)) / np.diff(stage.times_s)[:, None]
        share = (speeds / cell.speeds_rad_s).max(0, initial=0)
        if not share.max() <= _OVER:
            yield (
                f"{JOINTS[int(share.argmax())]} turns {share.max():.3g} times as fast as planned "
                f"with in {stage.name}"
            )
    home_rad = np.array([cell.home_rad])
    joints = [home_rad, *(stage.joints_rad for stage in motions.stages), home_rad]
    for before, after, name in zip(joints[:-1], joints[1:], [*names, "its end"], strict=True):
        gap_rad = float(np.abs(after[0] - before[-1]).max())
        if not gap_rad <= _GAP_RAD:
            yield f"a joint jumps by {gap_rad:.2g} rad at {name}"
    if not motions.seconds <= _LONGEST_S:
        yield f"it takes {motions.seconds:.3g} s; allowed: {_LONGEST_S:.0f}"
