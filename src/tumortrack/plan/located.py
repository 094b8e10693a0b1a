"""What the planner sees: an estimate, or the folder that `locate` wrote, in the table's frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from tumortrack.core.errors import ArtifactError, InputError, NoPlan
from tumortrack.core.estimate import Motion
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_files import read_mesh
from tumortrack.core.organ import KIDNEY, is_tumor, organ_first, organ_name
from tumortrack.core.patient import NOBODY, Patient, patient_in
from tumortrack.core.store import read_json, read_manifest
from tumortrack.core.types import ORGAN, Mesh, OccupancyCloud
from tumortrack.plan.values import Located, name_of
from tumortrack.sense.ply import parse_ply_properties
from tumortrack.tracking.files import MARGIN

STAND_MM = 120.0  # the organ's lowest point over the table, where it is not known
POOR_ESTIMATE = "PLANNED ON A POOR ESTIMATE"


def table_under(meshes: Mapping[str, Mesh], stand_mm: float) -> Float64[np.ndarray, "4 4"]:
    """``table_from_camera`` of a camera that looks straight down on the organ (its surface in the
    camera's frame), whose lowest point stands ``stand_mm`` over the table.

    x goes to the right in the picture, y to its top, z towards the camera; the origin lies on the
    table below the organ's middle. NoPlan: there is no organ.
    """
    if (organ := organ_name(meshes)) is None:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    low, high = meshes[organ].box_mm
    x, y, _ = (low + high) / 2
    return rigid(np.diag([1.0, -1.0, -1.0]), np.array([-x, y, high[2] + stand_mm]))


def located(
    cloud: OccupancyCloud,
    meshes: Mapping[str, Mesh],
    motion: Motion | None,
    table_from_camera: Float[np.ndarray, "4 4"],
    structures: Mapping[str, Mesh] | None = None,
) -> Located:
    """An estimate's parts (camera frame) in the table's frame, with the tumors' uncertainty."""
    deviations, moved = {}, {}
    for name, mesh in meshes.items():
        moved[name] = mesh.moved(transform_points(table_from_camera, mesh.vertices_mm))
        places = None if motion is None or not is_tumor(name) else motion.back(mesh.vertices_mm)
        std_mm = None if motion is None or places is None else motion.largest_std_mm(places)
        if std_mm is not None:
            deviations[name] = std_mm
    points_mm = transform_points(table_from_camera, cloud.points_mm)
    carried = {
        name: mesh.moved(transform_points(table_from_camera, mesh.vertices_mm))
        for name, mesh in (structures or {}).items()
    }
    stamp_ns = cloud.stamp_ns
    return Located(points_mm, cloud.labels, moved, deviations, stamp_ns, structures=carried)


@dataclass(frozen=True, eq=False)
class LocatedRun:
    """What `locate` wrote, camera frame, mm. ``std_mm``: of the cloud's points along the axis that
    is least sure, if it is known."""

    cloud: OccupancyCloud
    meshes: dict[str, Mesh]
    std_mm: Float64[np.ndarray, " n"] | None
    doubt: str = ""  # why it is poor; empty: it is good
    patient: Patient = NOBODY
    margin: dict[str, Any] | None = None  # as in its report
    structures: Mapping[str, Mesh] = field(default_factory=dict)

    def located(self, table_from_camera: Float[np.ndarray, "4 4"]) -> Located:
        """In the table's frame; a surface's uncertainty is that of the nearest points."""
        found = located(self.cloud, self.meshes, None, table_from_camera, self.structures)
        found = replace(found, patient=self.patient, margin=self.margin)
        if self.std_mm is None:
            return found
        nearest = cKDTree(found.points_mm)
        deviations = {
            name: self.std_mm[nearest.query(mesh.vertices_mm)[1]]
            for name, mesh in found.meshes.items()
            if is_tumor(name)
        }
        return replace(found, std_mm=deviations)


def notes_of_doubt(doubt: str, accept_poor: bool) -> tuple[str, ...]:
    """What a plan says of the estimate it is made on. InputError: that is poor, and nobody said
    that it is to be planned on all the same."""
    if not doubt:
        return ()
    if not accept_poor:
        raise InputError(
            f"the estimate is poor: {doubt}. Locate again with a better view; only for a plan that "
            "nobody carries out, accept it (--accept-poor, accept_poor=True)."
        )
    return (f"{POOR_ESTIMATE}: {doubt}.",)


def read_run(folder: Path) -> LocatedRun:
    """Raises ArtifactError: not a run of `locate`, damaged, or without its cloud."""
    manifest = read_manifest(folder, "run")
    path = folder / "occupancy.ply"
    try:
        content = path.read_bytes()
        table = parse_ply_properties(content, str(path), ("x", "y", "z", "label", "probability"))
    except (OSError, InputError) as error:
        raise ArtifactError(f"{folder} is no run that can be planned on: {error}") from error
    report = read_json(folder / "report.json")
    quality = report.get("quality")
    if not isinstance(quality, dict):
        quality = {"reason": "an older version located it, which did not judge"}
    doubt = "" if quality.get("verdict") == "good" else str(quality.get("reason") or "unknown")
    try:
        patient = patient_in(report.get("patient"), str(folder / "report.json"))
    except InputError as error:
        raise ArtifactError(f"{error} Locate again.") from error
    stamp_ns = report.get("stamp_ns", 0)
    stamp_ns = stamp_ns if isinstance(stamp_ns, int) else 0
    cloud = OccupancyCloud(table[:, :3], table[:, 3], table[:, 4], stamp_ns)
    surfaces = {Path(file).stem for file in manifest["files"] if file.endswith(".ply")}
    surfaces = {name for name in surfaces if not name.endswith(MARGIN)}
    meshes = {
        name: read_mesh(folder / f"{name}.ply") for name in organ_first(surfaces - {path.stem})
    }
    carried = report.get("structures", [])
    structures = {name: meshes.pop(name) for name in list(meshes) if name in carried}
    organ = organ_name(meshes) or KIDNEY.name
    found = [
        organ if label == ORGAN else name_of(label) for label in np.unique(cloud.labels) if label
    ]
    lacking = [name for name in found if name not in meshes]
    if lacking:
        raise ArtifactError(
            f"{folder} has points of {', '.join(lacking)} and no {lacking[0]}.ply; locate again."
        )
    try:
        std_mm = parse_ply_properties(content, str(path), ("largest_std_mm",))[:, 0]
    except InputError:  # a method, or an older version, without it
        std_mm = None
    return LocatedRun(cloud, meshes, std_mm, doubt, patient, report.get("margin"), structures)
