"""A case from DICOM, a CT volume, a label map or meshes."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import direction_lps, spacing_mm
from tumortrack.core.mesh_files import SUFFIXES
from tumortrack.core.patient import UNKNOWN, Patient, Side
from tumortrack.core.types import FIRST_TUMOR, ORGAN, Anatomy, LabelVolume, Mesh, Volume
from tumortrack.imaging.case import Case
from tumortrack.imaging.grid import grown_box, voxel_ml
from tumortrack.imaging.hu_windows import segment_ct
from tumortrack.imaging.meshes import label_meshes, read_mesh_folder
from tumortrack.imaging.options import PrepareOptions, parse_structures
from tumortrack.imaging.select import select_labels
from tumortrack.imaging.structures import extent_report, read_structures, split_structures
from tumortrack.imaging.surface import surfaces
from tumortrack.imaging.symmetry import ambiguous, half_turns, warning
from tumortrack.imaging.volume import is_label_map, labels_of, read_raw, volume_of

# Options for one kind of input only.
_OF_CT, OF_LABELS = ("organ_hu", "tumor_hu"), ("labels", "organ", "tumor")
_LEAST_ORGAN_OUTSIDE = 0.02  # of the outer surface
_LARGEST_SHARE = 0.6  # of organ and tumors that one tumor may take without a note
_MOST_CHANGE_PERCENT = 1.0  # of a part's volume by smoothing, without a note


def prepare(input: Path, options: PrepareOptions | None = None) -> Case:
    """A case from any supported input; writes nothing. Raises InputError: unusable input."""
    options = options or PrepareOptions()
    try:
        if not input.exists():
            raise InputError(f"{input} does not exist.")
        paths = list(input.iterdir()) if input.is_dir() else []
        if input.is_dir() and not any(path.is_file() for path in paths):
            raise InputError(f"{input} holds no files. Give a folder of DICOM slices or of meshes.")
        is_meshes = any(path.suffix.lower() in SUFFIXES for path in paths)
        case = _from_meshes(input, options) if is_meshes else _from_volume(input, options)
        _check_organ_outside(case.labels)
        case.report["notes"].extend([*_large_tumors(case), *options.kind.doubts()])
        case = _with_structures(case, options)
        source_sha256 = store.sha256_of(input)
    except OSError as error:
        raise InputError(f"{input} cannot be read: {error.strerror or error}.") from error
    turns, notes = half_turns(case.anatomy), case.report["notes"]
    text = warning(ambiguous(turns))
    report = case.report | {
        "source": input.name,
        "source_sha256": source_sha256,
        "options": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(options).items()},
        "half_turn": {
            "warning": text,
            "turns": [{k: v for k, v in asdict(t).items() if k != "ct_from_ct"} for t in turns],
        },
        "notes": [*notes, text] if text else notes,
    }
    return replace(
        case,
        report=report,
        rotations=options.rotations,
        tilt_degrees=options.tilt,
        sensor=options.sensor,
    )


def _with_structures(case: Case, options: PrepareOptions) -> Case:
    """The case with structures from mesh files as well, and a report on all structures."""
    sources = parse_structures(options.structure, options.name)
    from_files, notes = read_structures(sources, options.unit)
    structures = {**case.anatomy.structures, **from_files}
    if missing := [name for name in sources if name not in structures]:
        raise InputError(
            f"--structure {missing[0]}={sources[missing[0]]}: a number is a label of a label map, "
            "and this is none. Give a mesh."
        )
    extents, more = extent_report(structures, case.anatomy, case.labels)
    report = {**case.report, "notes": [*case.report["notes"], *notes, *more]}
    anatomy = replace(case.anatomy, structures=structures)
    return replace(case, anatomy=anatomy, report={**report, "structures": extents})


def _check_organ_outside(labels: LabelVolume) -> None:
    """Refuse tumors that enclose the organ, which in reality keeps some surface of its own."""
    inside = labels.labels > 0
    outermost = labels.labels[inside & ~ndimage.binary_erosion(inside)]
    share = np.count_nonzero(outermost == ORGAN) / max(len(outermost), 1)
    if share < _LEAST_ORGAN_OUTSIDE:
        raise InputError(
            f"tumors make up {1 - share:.0%} of the outer surface: they enclose the organ. Check "
            "which part is the organ and which the tumor, and that all have one frame and unit."
        )


def _large_tumors(case: Case) -> list[str]:
    """Notes on tumors that fill most of the organ: the labels may be swapped."""
    voxels = np.bincount(case.labels.labels.reshape(-1))
    shares = voxels[FIRST_TUMOR:] / voxels[ORGAN:].sum()
    return [
        f"{name} takes {share:.0%} of organ and tumors together: are their labels swapped "
        "(--organ and --tumor, or the meshes' names)? Look at qc.png"
        for name, share in zip(case.anatomy.names[1:], shares, strict=True)
        if share > _LARGEST_SHARE
    ]


def refuse_unused(what: str, options: PrepareOptions, *unused: str) -> None:
    """Refuse options that this kind of input would ignore."""
    default = PrepareOptions()
    given = [name for name in unused if getattr(options, name) != getattr(default, name)]
    if given:
        names = ", ".join("--" + name.replace("_", "-") for name in given)
        raise InputError(f"{what}, where {names} means nothing. Leave it out.")


def _from_volume(path: Path, options: PrepareOptions) -> Case:
    if not path.is_dir():
        refuse_unused(f"{path} is one file", options, "series")
    raw = read_raw(path, options.series)
    as_labels = options.labels or (path.is_file() and is_label_map(raw))
    structures: dict[str, Mesh] = {}
    ct, notes = None, list(raw.notes)
    file_patient, side = raw.patient, options.stated_side
    if as_labels:
        refuse_unused(f"{path} is read as a label map", options, *_OF_CT, "unit")
        if not options.labels:
            notes.append("few distinct whole numbers: read as a label map, not as a CT")
        source = labels_of(raw, path)
        del raw  # the largest maps are gigabytes: one copy is enough
        sources = parse_structures(options.structure, options.name)
        source, structures = split_structures(source, sources, options.organ)
        selection = (options.organ, options.tumor, options.min_tumor_ml, options.kind)
        labels, more, side = select_labels(source, side, *selection)
    else:
        what = f"{path} is read as a CT (a label map needs --labels)"
        refuse_unused(what, options, *OF_LABELS, "unit")
        volume = volume_of(raw, path)
        del raw
        labels, more = segment_ct(
            volume, options.organ_hu, options.tumor_hu, options.min_tumor_ml, options.kind
        )
        ct = crop_ct(volume, labels)
    anatomy, surface = surfaces(labels, options.kind)
    anatomy = replace(anatomy, structures=structures)
    notes += more
    notes += [
        f"{name}: the surface's volume is {change:+.1f} % off its labels'; it is too thin or hangs "
        "together by too little for a smooth surface. Look at qc.png"
        for name, change in zip(surface["names"], surface["change_percent"], strict=True)
        if abs(change) > _MOST_CHANGE_PERCENT
    ]
    measured = _measured(labels, anatomy, surface)
    report = {"kind": "label map" if as_labels else "ct", "notes": notes, **measured}
    patient = patient_of(path, file_patient, options.patient, side)
    return Case(anatomy, labels, direction_lps(options.up), report, ct, patient)


def patient_of(path: Path, in_file: Patient, identifier: str | None, side: Side) -> Patient:
    """The patient as stated ``in_file``, with the user's ``identifier`` if given, and the selected
    ``side``. Raises InputError: the file at ``path`` states the other side."""
    if in_file.differs(Patient(side=side)):
        raise InputError(
            f"{path} states the {in_file.side} side (DICOM Laterality), and the {side} one was "
            "selected. Check --side, and that these are the right images."
        )
    return Patient(identifier or in_file.id, in_file.side if side == UNKNOWN else side)


def _from_meshes(folder: Path, options: PrepareOptions) -> Case:
    unused = (*_OF_CT, *OF_LABELS, "series", "min_tumor_ml")
    refuse_unused(f"{folder} holds meshes", options, *unused)
    anatomy, notes = read_mesh_folder(folder, options.unit, options.kind)
    labels = label_meshes(anatomy)
    mesh_ml = [part.volume_ml for part in anatomy.parts]
    measured = _measured(labels, anatomy, {"names": list(anatomy.names), "mesh_ml": mesh_ml})
    patient = Patient(options.patient or UNKNOWN, options.stated_side)
    report = {"kind": "meshes", "notes": notes, **measured}
    return Case(anatomy, labels, direction_lps(options.up), report, patient=patient)


def _measured(
    labels: LabelVolume, anatomy: Anatomy, surface: dict[str, list[Any]]
) -> dict[str, Any]:
    """For the report: volumes of the parts by their labels (the organ's includes its tumors),
    measures of the surfaces, and the spacing."""
    counts = np.bincount(labels.labels.ravel(), minlength=2) * voxel_ml(labels.lps_from_index)
    tumors = {f"tumor_{n - 1}": float(counts[n]) for n in range(2, len(counts))}
    return {
        "volumes_ml": {anatomy.kind.name: float(counts[1:].sum()), **tumors},
        "surface": surface,
        "spacing_mm": spacing_mm(labels.lps_from_index).tolist(),
    }


def crop_ct(volume: Volume, labels: LabelVolume) -> Volume:
    """The CT on the labels' grid, air beyond the scan's edge."""
    shape = labels.labels.shape
    index_from_lps = np.linalg.inv(volume.lps_from_index)
    start = np.rint((index_from_lps @ labels.lps_from_index)[:3, 3]).astype(int)
    inner = grown_box([slice(a, a + n) for a, n in zip(start, shape, strict=True)], volume.hu.shape)
    hu = np.full(shape, -1000.0, np.float32)
    target = tuple(slice(s.start - a, s.stop - a) for s, a in zip(inner, start, strict=True))
    hu[target] = volume.hu[inner]
    return Volume(hu, labels.lps_from_index)
