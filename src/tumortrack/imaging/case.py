"""A case: one patient's (or phantom's) anatomy, ready for simulation, as a folder."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.mesh_files import read_anatomy, read_mesh, write_anatomy, write_mesh
from tumortrack.core.organ import check_name, organ_entry, organ_in
from tumortrack.core.patient import NOBODY, Patient, patient_in
from tumortrack.core.types import Anatomy, LabelVolume, Volume
from tumortrack.imaging.nifti import write_nifti, write_volume_nifti
from tumortrack.imaging.volume import read_labels, read_volume

KIND = "case"


@dataclass(frozen=True, eq=False)
class Case:
    """Everything later steps need of a patient; all in LPS mm.

    Attributes:
        anatomy: organ (tumors included) and tumors as closed surfaces.
        labels: cropped round the organ with a margin.
        up_lps: unit vector, the patient direction that faces the camera.
        report: JSON types: volumes, smoothing, what was dropped, notes, source, options.
        ct: the CT on the labels' crop, where the input was one.
        patient: whose organ it is, as far as it is known.
    """

    anatomy: Anatomy
    labels: LabelVolume
    up_lps: tuple[float, float, float]
    report: dict[str, Any] = field(default_factory=dict)
    ct: Volume | None = None
    patient: Patient = NOBODY


def save_case(case: Case, folder: Path) -> None:
    """Write the case's files into an existing (aside) folder and seal it with its manifest.

    kidney.ply (or of the organ's name), tumor_1.ply, ..., a surface of each structure,
    labels.nii.gz, ct.nii.gz (of a CT) and manifest.json.

    Raises:
        StorageError: the disk refused.
    """
    write_anatomy(folder, case.anatomy)
    for name, mesh in case.anatomy.structures.items():
        write_mesh(folder / f"{name}.ply", mesh)
    labels = case.labels
    write_nifti(folder / "labels.nii.gz", labels.labels, labels.lps_from_index, lps=True)
    if case.ct is not None:
        write_volume_nifti(folder / "ct.nii.gz", case.ct.hu, case.ct.lps_from_index)
    content = {
        "organ": organ_entry(case.anatomy.kind),
        "structures": list(case.anatomy.structures),
        "parts": list(case.anatomy.names),
        "up_lps": [float(x) for x in case.up_lps],
        "patient": to_builtins(case.patient),
        "report": case.report,
    }
    store.seal(folder, KIND, content, frame="lps")


def load_case(folder: Path) -> Case:
    """Read a case folder, every file checked against its sha256.

    Raises:
        ArtifactError: not a case, of another schema, damaged or changed.
    """
    manifest = store.read_manifest(folder, KIND)
    parts, up, report = (manifest.get(key) for key in ("parts", "up_lps", "report"))
    is_direction = isinstance(up, list) and [type(x) for x in up] == [float] * 3
    if up is None or not is_direction or not isinstance(report, dict):
        raise ArtifactError(f"{folder / store.MANIFEST} is incomplete; run prepare again.")
    try:
        where = str(folder / store.MANIFEST)
        patient = patient_in(manifest.get("patient"), where)
        organ = organ_in(manifest.get("organ"), where)
        names = [str(name) for name in manifest.get("structures", [])]
        for name in names:
            check_name(name, "a structure", "--structure")
    except InputError as error:
        raise ArtifactError(f"{error} Run prepare again.") from error
    structures = {name: read_mesh(folder / f"{name}.ply") for name in names}
    anatomy = replace(read_anatomy(folder, organ), structures=structures)
    if list(anatomy.names) != parts:
        raise ArtifactError(f"{folder} lacks parts: {parts} expected, {list(anatomy.names)} found.")
    labels, ct = read_labels(folder / "labels.nii.gz"), folder / "ct.nii.gz"
    x, y, z = up
    volume = read_volume(ct) if ct.exists() else None
    return Case(anatomy, labels, (x, y, z), report, volume, patient)
