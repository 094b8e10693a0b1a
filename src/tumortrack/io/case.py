"""A case: the anatomy of one patient or phantom, as a folder."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import msgspec

from tumortrack.core import store
from tumortrack.core.config import findings_in, to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.organ import Organ, check_name, organ_entry
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.report import Finding
from tumortrack.core.types import Anatomy, LabelVolume, Volume
from tumortrack.io.mesh_files import read_anatomy, read_mesh, write_anatomy, write_mesh
from tumortrack.io.nifti import write_nifti, write_volume_nifti
from tumortrack.io.volume import read_labels, read_volume

KIND = "case"


@dataclass(frozen=True, eq=False)
class Case:
    """All that later steps need of a patient, in LPS mm.

    Attributes:
        anatomy: organ (tumors included) and tumors as closed surfaces.
        labels: cropped to the organ with a margin.
        up_lps: unit vector, the patient direction that faces the camera.
        report: JSON types: volumes, smoothing, what was dropped, notes, source, options.
        ct: the CT on the labels' grid, where the input was one.
        rotations, tilt_degrees: possible poses: any (``full``), or turned about the line of sight
            and tilted by at most so much about each axis across it.
        sensor: the camera that will be used.
        warnings: what weakens it for good; every answer repeats it.
        folder, sha256: where it was read or written, and the digest of its manifest there.
    """

    MODEL: ClassVar[str] = "model"  # sub-folder

    anatomy: Anatomy
    labels: LabelVolume
    up_lps: tuple[float, float, float]
    report: dict[str, Any] = field(default_factory=dict)
    ct: Volume | None = None
    patient: Patient = NOBODY
    rotations: Literal["limited", "full"] = "limited"
    tilt_degrees: float = 30.0
    sensor: Literal["d405", "stereo"] = "d405"
    warnings: tuple[Finding, ...] = ()
    folder: Path | None = None
    sha256: str = ""


class _Manifest(msgspec.Struct):
    """What only a case's manifest has."""

    organ: Organ
    structures: list[str]
    parts: list[str]
    up_lps: tuple[float, float, float]
    patient: Patient
    rotations: Literal["limited", "full"]
    tilt_degrees: float
    sensor: Literal["d405", "stereo"]
    report: dict[str, Any]
    warnings: tuple[dict[str, Any], ...] = ()  # older cases have none


def save_case(case: Case, folder: Path) -> None:
    """Write the case's files and manifest into an existing folder. Raises StorageError."""
    write_anatomy(folder, case.anatomy)
    for name, mesh in case.anatomy.structures.items():
        write_mesh(folder / f"{name}.ply", mesh)
    labels = case.labels.labels
    write_nifti(folder / "labels.nii.gz", labels, case.labels.lps_from_index, lps=True)
    if case.ct is not None:
        write_volume_nifti(folder / "ct.nii.gz", case.ct.hu, case.ct.lps_from_index)
    content = {
        "organ": organ_entry(case.anatomy.organ_kind),
        "structures": list(case.anatomy.structures),
        "parts": list(case.anatomy.names),
        "up_lps": [float(x) for x in case.up_lps],
        "patient": to_builtins(case.patient),
        "rotations": case.rotations,
        "tilt_degrees": case.tilt_degrees,
        "sensor": case.sensor,
        "warnings": msgspec.to_builtins(case.warnings),
        "folders": [case.MODEL],
        "report": case.report,
    }
    store.seal(folder, KIND, content, frame="lps")


def holds_case(folder: Path) -> bool:
    path = folder / store.MANIFEST
    return path.is_file() and store.read_json(path).get("kind") == KIND


def load_case(folder: str | Path) -> Case:
    """Read a folder that ``prepare`` wrote, every file checked against its sha256. Raises
    ArtifactError: not a case, of another schema, damaged or changed since."""
    folder = Path(folder)
    content = store.read_manifest(folder, KIND)
    try:
        manifest = msgspec.convert(content, _Manifest)
        for name in manifest.structures:
            check_name(name, "a structure", "--structure")
        warnings = findings_in(manifest.warnings, str(folder))
    except (InputError, msgspec.ValidationError) as error:
        reason = f"{str(error).rstrip('.')}. Make one with `tumortrack prepare`."
        raise ArtifactError(f"{folder} is not a case folder: {reason}") from error
    structures = {name: read_mesh(folder / f"{name}.ply") for name in manifest.structures}
    anatomy = replace(read_anatomy(folder, manifest.organ), structures=structures)
    if (names := list(anatomy.names)) != manifest.parts:
        raise ArtifactError(f"{folder} lacks parts: {manifest.parts} expected, {names} found.")
    ct = folder / "ct.nii.gz"
    return Case(
        anatomy,
        read_labels(folder / "labels.nii.gz"),
        manifest.up_lps,
        manifest.report,
        read_volume(ct) if ct.exists() else None,
        manifest.patient,
        manifest.rotations,
        manifest.tilt_degrees,
        manifest.sensor,
        warnings,
        folder,
        store.sha256_of(folder / store.MANIFEST),
    )
