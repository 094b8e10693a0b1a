"""An estimate as a folder: cloud, labelled volume, surfaces, report."""

from __future__ import annotations

from pathlib import Path

from tumortrack.core import store
from tumortrack.core.mesh_files import write_mesh
from tumortrack.imaging.volume import write_labels_nifti
from tumortrack.sense.ply import write_cloud_ply
from tumortrack.track.estimate import Estimate


def write_estimate(folder: Path, estimate: Estimate, overwrite: bool = False) -> None:
    """occupancy.ply (points with label and probability), labels.nii.gz (voxel -> camera frame,
    mm), kidney.ply, tumor_1.ply, ... and report.json; all or nothing.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
        StorageError: the disk refused.
    """
    with store.new_folder(folder, overwrite) as aside:
        cloud = estimate.cloud
        write_cloud_ply(
            aside / "occupancy.ply",
            cloud.points_mm,
            label=cloud.labels,
            probability=cloud.probability,
        )
        volume = estimate.volume
        write_labels_nifti(
            aside / "labels.nii.gz", volume.labels, volume.camera_from_index, lps=False
        )
        for name, mesh in estimate.meshes.items():
            write_mesh(aside / f"{name}.ply", mesh)
        store.write_json(aside / "report.json", estimate.report)
        store.seal(aside, "run", {"report": "report.json"}, frame="camera")
