"""The planner's input: an estimate or the folder that `locate` wrote; and the table's frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.core.assessment import Assessment
from tumortrack.core.config import findings_in
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import CAMERA
from tumortrack.core.geometry import rigid
from tumortrack.core.organ import KIDNEY, is_tumor, organ_first, organ_name
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.store import MANIFEST, read_json
from tumortrack.core.types import ORGAN, Mesh, OccupancyCloud
from tumortrack.io.mesh_files import read_mesh
from tumortrack.io.ply import parse_ply_properties
from tumortrack.io.run_folder import MARGIN, read_report
from tumortrack_resection.values import POOR_ESTIMATE, Located, name_of, organ_surface

STAND_MM = 120.0  # height of the organ's lowest point over the table, if unknown


def table_under(meshes: Mapping[str, Mesh], stand_mm: float) -> Float64[np.ndarray, "4 4"]:
    """``table_from_camera`` of a camera that looks straight down on the organ, whose lowest
    point is ``stand_mm`` above the table: x to the right of the image, y to its top, the origin
    below the organ's centre. NoPlan: there is no organ."""
    low, high = organ_surface(meshes).box_mm
    x, y, _ = (low + high) / 2
    return rigid(np.diag([1.0, -1.0, -1.0]), np.array([-x, y, high[2] + stand_mm]))


def of_estimate(estimate: Estimate) -> Located:
    """In the camera frame."""
    return Located(
        estimate.cloud.points_mm,
        estimate.cloud.labels,
        dict(estimate.meshes),
        _bounds_mm(estimate.assessment),
        stamp_ns=estimate.cloud.stamp_ns,
        patient=estimate.patient,
        structures=estimate.structures,
        doubt=estimate.reason,
    )


def _bounds_mm(assessment: Assessment) -> dict[str, float]:
    bounds = assessment.bounds.items()
    return {name: bound.error_bound95_mm for name, bound in bounds if is_tumor(name)}


def poor_estimate_notes(doubt: str, accept_poor: bool) -> tuple[str, ...]:
    """InputError: the estimate is poor, and was not accepted."""
    if not doubt:
        return ()
    if not accept_poor:
        raise InputError(
            f"the estimate is poor: {doubt}. Locate again with a better view; only for a plan that "
            "nobody carries out, accept it (--accept-poor, accept_poor=True)."
        )
    return (f"{POOR_ESTIMATE}: {doubt}.",)


class _Report(msgspec.Struct):
    """The part of a run's report.json that planning needs."""

    assessment: Assessment
    patient: Patient = NOBODY
    stamp_ns: int = 0
    structures: tuple[str, ...] = ()
    model: dict[str, Any] = {}


def read_run(folder: Path) -> Located:
    """A run's folder, camera frame. Raises ArtifactError: no such run, damaged, or without its
    cloud."""
    stored, manifest = read_report(folder), read_json(folder / MANIFEST)
    if (frame := manifest.get("frame", CAMERA)) != CAMERA:
        raise InputError(
            f"{folder} is in the frame {frame!r}, which no camera has; plans are made on runs in a "
            "camera's frame. Locate with an image or a cloud."
        )
    path = folder / "occupancy.ply"
    try:
        report = msgspec.convert(stored, _Report)
        doubt = report.assessment.reason
        weak = findings_in(report.model.get("warnings"), str(folder))
        columns = ("x", "y", "z", "label", "probability")
        table = parse_ply_properties(path.read_bytes(), str(path), columns)
    except (OSError, InputError, KeyError, msgspec.ValidationError) as error:
        reason = str(error).rstrip(".")
        raise ArtifactError(
            f"{folder} is not a run that can be planned on: {reason}. Locate again."
        ) from error
    cloud = OccupancyCloud(table[:, :3], table[:, 3], table[:, 4])
    surfaces = {Path(file).stem for file in manifest["files"] if file.endswith(".ply")}
    surfaces = {name for name in surfaces if not name.endswith(MARGIN)}
    meshes = {
        name: read_mesh(folder / f"{name}.ply") for name in organ_first(surfaces - {path.stem})
    }
    structures = {name: meshes.pop(name) for name in list(meshes) if name in report.structures}
    organ = organ_name(meshes) or KIDNEY.name
    parts = [
        organ if label == ORGAN else name_of(label) for label in np.unique(cloud.labels) if label
    ]
    lacking = [name for name in parts if name not in meshes]
    if lacking:
        raise ArtifactError(
            f"{folder} has points of {', '.join(lacking)} and no {lacking[0]}.ply; locate again."
        )
    return Located(
        cloud.points_mm,
        cloud.labels,
        meshes,
        _bounds_mm(report.assessment),
        stamp_ns=report.stamp_ns,
        patient=report.patient,
        structures=structures,
        doubt=doubt,
        weak=weak,
    )
