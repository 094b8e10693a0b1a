"""An estimate as a folder: cloud, labelled volume, surfaces, report."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.mesh_files import write_mesh
from tumortrack.core.organ import is_tumor
from tumortrack.imaging.nifti import write_nifti
from tumortrack.imaging.segmentation_files import segments, write_seg_nrrd
from tumortrack.models.margins import stated_radius
from tumortrack.sense.ply import write_cloud_ply
from tumortrack.tracking.points import PointTable, camera_table
from tumortrack.tracking.shells import exact_margin

MARGIN = "_margin"  # ends the names of shells


def write_estimate(
    folder: Path, estimate: Estimate, overwrite: bool = False, points: PointTable | None = None
) -> None:
    """occupancy.ply (points with label and probability and, where the estimate knows the way back,
    their place in the CT), labels.nii.gz (voxel -> camera frame, mm), labels.seg.nrrd (the same for
    3D Slicer), kidney.ply (or of the organ's name), tumor_1.ply, ..., structures and report.json;
    tumor_1_margin.ply, ..., the shells of the highest confidence, where margins are stated;
    points.csv, the given ``points`` of the CT and where they are now; all or nothing.

    Raises InputError: the folder exists and ``overwrite`` is False; points without a motion; an
    estimate without a volume;
    NoEstimate: the motion has no answer for a point; StorageError: the disk refused."""
    cloud, volume = estimate.cloud, estimate.volume
    if volume is None:
        raise InputError(
            "this estimate is of a live frame and has no labelled volume to write; give one of "
            "`locate`, or keep live ones with the sink recording."
        )
    with store.new_folder(folder, overwrite) as aside:
        values = {"label": cloud.labels, "probability": cloud.probability}
        values |= _places_in_ct(estimate)
        write_cloud_ply(aside / "occupancy.ply", cloud.points_mm, **values)
        labels, way = volume.labels, volume.camera_from_index
        write_nifti(aside / "labels.nii.gz", labels, way, lps=False)
        parts = segments(estimate.report["parts"], estimate.patient.side, estimate.organ)
        write_seg_nrrd(aside / "labels.seg.nrrd", labels, way, parts)
        for name, mesh in estimate.meshes.items():
            write_mesh(aside / f"{name}.ply", mesh)
            margin = stated_radius(estimate.report.get("margin"), name)
            if margin is not None and is_tumor(name):
                write_mesh(aside / f"{name}{MARGIN}.ply", exact_margin(mesh, margin.mm))
        for name, mesh in estimate.structures.items():
            write_mesh(aside / f"{name}.ply", mesh)
        if points is not None:
            table = camera_table(points, estimate.motion)
            store.write_atomically(aside / "points.csv", table)
        store.write_json(aside / "report.json", estimate.report)
        store.seal(aside, "run", {"report": "report.json"}, frame="camera")


def _places_in_ct(estimate: Estimate) -> dict[str, np.ndarray]:
    """ct_x, ct_y, ct_z (LPS, mm) of the cloud's points and how unsure their places are, std_mm
    and largest_std_mm; empty where that is not known."""
    if estimate.motion is None:
        return {}
    points_ct = estimate.motion.back(estimate.cloud.points_mm.astype(np.float64))
    if points_ct is None:
        return {}
    places = {f"ct_{axis}": points_ct[:, n].astype(np.float32) for n, axis in enumerate("xyz")}
    for name in ("std_mm", "largest_std_mm"):
        if (deviations := getattr(estimate.motion, name)(points_ct)) is not None:
            places[name] = deviations.astype(np.float32)
    return places
