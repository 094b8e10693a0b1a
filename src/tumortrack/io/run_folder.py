"""An estimate as a folder: cloud, labelled volume, surfaces, report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

import tumortrack
from tumortrack.core import store
from tumortrack.core.assessment import Assessment, Quality
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import CAMERA
from tumortrack.core.geometry import RAS_FROM_LPS, largest_std_of, std_of
from tumortrack.core.mesh_query import exact_margin
from tumortrack.core.organ import is_tumor, organ_entry, organ_in
from tumortrack.core.patient import patient_in
from tumortrack.core.report import Finding, FitReport
from tumortrack.core.types import CameraLabels, OccupancyCloud
from tumortrack.io.mesh_files import read_mesh, write_mesh
from tumortrack.io.nifti import read_nifti, write_nifti
from tumortrack.io.ply import parse_ply_properties, write_cloud_ply
from tumortrack.io.points import PointTable, camera_table
from tumortrack.io.segmentation_files import segments, write_seg_nrrd

MARGIN = "_margin"  # suffix of the names of shells
MOTION = "motion.safetensors"  # of the preset elastic
CENTRES, CT = "tumors", "ct"  # names of the tumor centres and of the organ's pose in 3D Slicer


def write_estimate(
    folder: Path,
    estimate: Estimate,
    overwrite: bool = False,
    points: PointTable | None = None,
    add: Callable[[Path], None] = lambda folder: None,
    about: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Write a run's folder, all or nothing:

    - occupancy.ply: points with label, probability and, if known, their place in the CT
    - labels.nii.gz (voxel -> camera frame, mm), labels.seg.nrrd (the same for 3D Slicer)
    - kidney.ply (or the organ's name), tumor_1.ply, ..., and structures
    - tumor_1_margin.ply, ...: shells at the tumors' error bounds; of a good answer
    - points.csv: the given ``points`` of the CT and where they are now
    - report.json, with the further entries ``about``; and what ``add`` writes into the folder

    Raises InputError: the folder exists and ``overwrite`` is False; points without a motion; an
    estimate without a volume;
    NoEstimate: the motion has no answer for a point; StorageError: the disk refused."""
    cloud, volume = estimate.cloud, estimate.volume
    if volume is None:
        raise InputError(
            "this estimate is of a live frame and has no labelled volume to write; give one of "
            "`locate`, or keep live ones with the sink recording."
        )
    with store.new_folder(folder, overwrite) as new, ThreadPoolExecutor(1) as thread:
        added = thread.submit(add, new)  # takes about as long as the rest
        values = {"label": cloud.labels, "probability": cloud.probability}
        values |= _places_in_ct(estimate)
        write_cloud_ply(new / "occupancy.ply", cloud.points_mm, **values)
        labels, affine = volume.labels, volume.camera_from_index
        write_nifti(new / "labels.nii.gz", labels, affine, lps=False)
        parts = segments(estimate.report.parts, estimate.patient.side, estimate.organ)
        write_seg_nrrd(new / "labels.seg.nrrd", labels, affine, parts)
        for name, mesh in estimate.meshes.items():
            write_mesh(new / f"{name}.ply", mesh)
            if is_tumor(name) and (bound := estimate.assessment.shown.get(name)):
                shell = exact_margin(mesh, bound.error_bound95_mm)
                write_mesh(new / f"{name}{MARGIN}.ply", shell)
        for name, mesh in estimate.structures.items():
            write_mesh(new / f"{name}.ply", mesh)
        if points is not None:
            store.write_atomically(new / "points.csv", camera_table(points, estimate.motion))
        added.result()
        _seal(new, {**report_entry(estimate), **about}, estimate.quality)


def report_head(stamp_ns: int, frame: str = CAMERA) -> dict[str, Any]:
    """The first entries of every report."""
    about = {"tumortrack": tumortrack.__version__, "units": "mm", "frame": frame}
    return {**about, "stamp_ns": stamp_ns}


def report_entry(estimate: Estimate) -> dict[str, Any]:
    """The entries of report.json about an estimate, as JSON types."""
    check = "" if estimate.finding is None else estimate.finding.check
    quality = {"verdict": estimate.quality, "reason": estimate.reason, "check": check}
    return {
        **report_head(estimate.cloud.stamp_ns, estimate.frame),
        **{"seed": estimate.report.seed, "points": estimate.report.points},  # even if they are 0
        **msgspec.to_builtins(estimate.report),
        "quality": quality,
        "assessment": msgspec.to_builtins(estimate.assessment, enc_hook=float),
        "organ": organ_entry(estimate.organ),
        "patient": to_builtins(estimate.patient),
    }


def finding_entry(finding: Finding | None) -> dict[str, Any] | None:
    """A finding as JSON types: ``kind`` and ``values``."""
    return None if finding is None else msgspec.to_builtins(finding, enc_hook=float)


def write_no_estimate(
    folder: Path, report: dict[str, Any], overwrite: bool, add: Callable[[Path], None]
) -> None:
    """Write the folder of a run without an estimate: report.json, whose ``quality`` says why, and
    what ``add`` writes into it. Raises as ``write_estimate``."""
    with store.new_folder(folder, overwrite) as new:
        add(new)
        _seal(new, report, "none")


def _seal(folder: Path, report: dict[str, Any], verdict: Quality) -> None:
    store.write_json(folder / "report.json", report)
    content = {"report": "report.json", "verdict": verdict}
    store.seal(folder, "run", content, frame=report.get("frame", CAMERA))


def has_no_estimate(folder: Path) -> bool:
    """Whether the folder is of a run without an estimate, which the next run may replace."""
    path = folder / store.MANIFEST
    return path.is_file() and store.read_json(path).get("verdict") == "none"


def read_report(folder: Path) -> dict[str, Any]:
    """report.json of a run's folder. Raises ArtifactError: damaged, or without an estimate."""
    store.read_manifest(folder, "run")
    report = store.read_json(folder / "report.json")
    if has_no_estimate(folder):
        reason = str(report["quality"]["reason"]).rstrip(".")
        raise ArtifactError(f"{folder} has no estimate: {reason}. Locate again.")
    return report


def read_estimate(folder: Path) -> Estimate:
    """Read what ``write_estimate`` wrote; the motion, which needs the model, is not in it. Raises
    ArtifactError: no such folder, damaged, or without an estimate."""
    stored, path = read_report(folder), folder / "occupancy.ply"
    try:
        report = msgspec.convert(stored, FitReport)
        assessment = msgspec.convert(stored["assessment"], Assessment)
        _ = assessment.reason  # raises if a value is missing
        if assessment.quality != stored["quality"]["verdict"]:
            raise ArtifactError("its verdict and its finding contradict each other")
        names = [name for name, part in report.parts.items() if part.found]
        table = parse_ply_properties(
            path.read_bytes(), str(path), ("x", "y", "z", "label", "probability")
        )
        volume = read_nifti(folder / "labels.nii.gz")
        meshes = {name: read_mesh(folder / f"{name}.ply") for name in (*names, *report.structures)}
        return Estimate(
            OccupancyCloud(table[:, :3], table[:, 3], table[:, 4], stored["stamp_ns"]),
            CameraLabels(volume.array, RAS_FROM_LPS @ volume.lps_from_index),
            {name: meshes[name] for name in names},
            report,
            assessment=assessment,
            patient=patient_in(stored.get("patient"), str(folder)),
            organ=organ_in(stored.get("organ"), str(folder)),
            structures={name: meshes[name] for name in report.structures},
            frame=stored["frame"],
        )
    except (KeyError, TypeError, ValueError, OSError, InputError) as error:
        raise ArtifactError(f"{folder} is no whole run: {error}. Locate again.") from error


def _places_in_ct(estimate: Estimate) -> dict[str, np.ndarray]:
    """Columns ct_x, ct_y, ct_z (LPS, mm) of the cloud's points, and the standard deviations std_mm
    and largest_std_mm of their places; those that are known."""
    if estimate.motion is None:
        return {}
    points_ct = estimate.motion.inverse(estimate.cloud.points_mm.astype(np.float64))
    if points_ct is None:
        return {}
    places = {f"ct_{axis}": points_ct[:, n].astype(np.float32) for n, axis in enumerate("xyz")}
    if (covariance := estimate.motion.covariance_mm2(points_ct)) is not None:
        places["std_mm"] = std_of(covariance).astype(np.float32)
        places["largest_std_mm"] = largest_std_of(covariance).astype(np.float32)
    return places
