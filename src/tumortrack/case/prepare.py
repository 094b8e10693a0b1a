"""A case from DICOM, a CT volume, a label map or meshes."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy import ndimage

from tumortrack.case.hu_windows import segment_ct
from tumortrack.case.meshes import LEAST_DROPPED_ML, label_meshes, read_meshes
from tumortrack.case.options import PrepareOptions, parse_structures
from tumortrack.case.select import among, neighbours, select_labels
from tumortrack.case.structures import extent_report, parts_of, read_structures, split_structures
from tumortrack.case.surface import surfaces
from tumortrack.case.symmetry import HalfTurn, ambiguous, half_turns, warning
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import direction_lps, spacing_mm
from tumortrack.core.grid import check_suffix, face_areas_mm2, grown_box, label_counts, voxel_ml
from tumortrack.core.organ import Organ
from tumortrack.core.patient import UNKNOWN, Patient, Side
from tumortrack.core.report import Finding, Kind, Note
from tumortrack.core.types import FIRST_TUMOR, ORGAN, Anatomy, LabelVolume, Mesh, Volume
from tumortrack.core.wording import for_caller
from tumortrack.io.case import Case
from tumortrack.io.mesh_files import SUFFIXES
from tumortrack.io.segments import Parts, is_tumor, other_organ
from tumortrack.io.volume import (
    MOST_LABELS,
    is_label_map,
    is_volume,
    label_map,
    read_files,
    read_raw,
    volume_of,
)

# Options for one kind of input only.
_OF_CT, OF_LABELS = ("organ_hu", "tumor_hu"), ("labels", "organ", "tumor", "ct")
_LEAST_ORGAN_OUTSIDE = 0.02  # of the outer surface
_LARGEST_SHARE = 0.6  # of organ and tumors that one tumor may take without a note
_OFF_GRID = 0.05  # of a voxel: rounding of affines in files
_THICK_MM = 2.0  # the phantom's tumor of 29 ml is 37 ml by slices of 3 mm, 54 by 5 mm
_SAME_DRAWN = 0.5  # of a slice's labels, that those beyond empty ones also have
_GAP_MM = 15.0  # of empty slices: the organs of a pair lie farther apart
_FLAT = 0.6  # of the largest cross-section; whole organs end with less even where slices are thick
_FEW = 8  # voxels on the image's border, as rounding and resampling leave them
_ENCLOSED = 0.4  # share of a label's surface on the organ that only a tumor or a cyst has
_USUAL_ML = {"kidney": (40.0, 800.0), "liver": (500.0, 3500.0), "prostate": (10.0, 300.0)}
_MOST_CHANGE_PERCENT = 1.0  # of a part's volume by smoothing, without a note


def prepare(
    input: Path | Sequence[Path],
    options: PrepareOptions | None = None,
    turns_of: Callable[[Anatomy], list[HalfTurn]] = half_turns,
) -> Case:
    """A case from any supported input: a folder or file, or several files of meshes or of labels,
    one structure each. ``turns_of``: how alike the organ looks after half a turn. Writes nothing.
    Raises InputError: unusable input."""
    options = options or PrepareOptions()
    paths = [input] if isinstance(input, Path) else list(input)
    try:
        if missing := [path for path in paths if not path.exists()]:
            raise InputError(f"{missing[0]} does not exist.")
        files = _files_in(paths)
        if len(files) == 1:
            paths = files
        is_meshes = any(path.suffix.lower() in SUFFIXES for path in files)
        if is_meshes and (volumes := [path.name for path in files if is_volume(path)]):
            raise InputError(
                f"{', '.join(volumes[:3])} lies beside meshes. Give all parts as meshes, or all as "
                "label files."
            )
        for path in files if is_meshes or len(paths) > 1 else []:
            check_suffix(path)
        case = _from_meshes(files, options) if is_meshes else _from_volume(paths, files, options)
        _check_organ_outside(case.labels)
        case = _noted(case, [*_large_tumors(case), *options.organ_kind.doubts()])
        case = _with_structures(case, options)
        if options.ct is not None:
            case = _with_ct(case, options.ct)
        source_sha256 = " ".join(map(store.sha256_of, paths))
    except OSError as error:
        where = error.filename or ", ".join(map(str, paths))
        raise InputError(f"{where} cannot be read: {error.strerror or error}.") from error
    turns, notes = turns_of(case.anatomy), case.report["notes"]
    text = warning(ambiguous(turns))
    report = case.report | {
        "source": ", ".join(path.name for path in paths),
        "source_sha256": source_sha256,
        "options": msgspec.to_builtins(asdict(options), enc_hook=str),
        "half_turn": {
            "warning": text,
            "turns": [{k: v for k, v in asdict(t).items() if k != "ct_from_ct"} for t in turns],
        },
        "notes": [for_caller(n) for n in (*notes, text) if n and isinstance(n, str)],
    }
    return replace(
        case,
        report=report,
        warnings=tuple(note for note in notes if isinstance(note, Finding)),
        rotations=options.rotations,
        tilt_degrees=options.tilt,
        sensor=options.sensor,
    )


def _files_in(paths: list[Path]) -> list[Path]:
    """The files that were given, or those of a folder, but hidden ones."""
    if len(paths) > 1 and (folders := [path for path in paths if path.is_dir()]):
        raise InputError(f"{folders[0]} is a folder. Give it alone, or several files.")
    files = [p for path in paths for p in (path.iterdir() if path.is_dir() else [path])]
    files = [path for path in files if path.is_file() and not path.name.startswith(".")]
    if not files and paths[0].is_dir():
        raise InputError(f"{paths[0]} holds no files. Give one of slices, meshes or label files.")
    return sorted(files, key=store.natural)


def _noted(case: Case, notes: Sequence[Note], **report: Any) -> Case:
    """The case with more notes, and with more in its report."""
    return replace(case, report={**case.report, **report, "notes": [*case.report["notes"], *notes]})


def _with_structures(case: Case, options: PrepareOptions) -> Case:
    """The case with structures from mesh files as well, and a report on all structures."""
    sources = parse_structures(options.structure, options.name)
    others = {k: v for k, v in sources.items() if k not in case.anatomy.structures}
    from_files, notes = read_structures(others, options.unit)
    structures = {**case.anatomy.structures, **from_files}
    if missing := [name for name in sources if name not in structures]:
        raise InputError(f"--structure {missing[0]}: without a label map it takes a mesh's file.")
    extents, more = extent_report(structures, case.anatomy, case.labels)
    case = replace(case, anatomy=replace(case.anatomy, structures=structures))
    return _noted(case, [*notes, *more], structures=extents)


def _check_organ_outside(labels: LabelVolume) -> None:
    """Refuse tumors that enclose the organ, which in reality keeps some surface of its own."""
    inside = labels.labels > 0
    outermost = labels.labels[inside & ~ndimage.binary_erosion(inside)]
    share = np.count_nonzero(outermost == ORGAN) / max(len(outermost), 1)
    if share < _LEAST_ORGAN_OUTSIDE:
        raise InputError(
            f"tumors make up {1 - share:.0%} of the outer surface. Check which part is the organ, "
            "and that all have one frame and unit."
        )


def _large_tumors(case: Case) -> list[str]:
    """Notes on tumors that fill most of the organ: the labels may be swapped."""
    voxels = np.bincount(case.labels.labels.reshape(-1))
    shares = voxels[FIRST_TUMOR:] / voxels[ORGAN:].sum()
    return [
        f"{name} takes {share:.0%} of organ and tumors together: are they swapped? Look at qc.png"
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


def _from_volume(paths: list[Path], files: list[Path], options: PrepareOptions) -> Case:
    path, organ_kind = paths[0], options.organ_kind
    if not path.is_dir():
        refuse_unused(f"{path} is one file", options, "series")
    raw = read_files(paths, files, options.series)
    stated = bool(options.organs) or options.tumors is not None
    most = 256 if stated else MOST_LABELS  # kinds of voxels
    is_labels = bool(raw.segments) or (path.is_file() and is_label_map(raw, most))
    as_labels = options.labels or is_labels
    structures: dict[str, Mesh] = {}
    ct, notes = None, list[Note](raw.notes)
    file_patient, side = raw.patient, options.stated_side
    shape, affine = raw.array.shape, raw.lps_from_index
    if as_labels:
        refuse_unused(f"{path} is read as a label map", options, *_OF_CT, "unit")
        if not (options.labels or stated or raw.segments):
            notes.append("few distinct whole numbers: read as a label map, not as a CT")
        parts = parts_of(raw, options, str(path))
        source = label_map(raw, parts, path)
        del raw  # the largest maps are gigabytes: one copy is enough
        labels, structures, more, side = _selected(source, parts, path, options)
        notes += more
    else:
        what = f"{path} is read as a CT (a label map needs --labels)"
        refuse_unused(what, options, *OF_LABELS, "unit")
        volume = volume_of(raw, path)
        del raw
        windows = options.organ_hu, options.tumor_hu
        labels, of_ct = segment_ct(volume, *windows, options.min_tumor_ml, organ_kind)
        ct, thickest_mm = crop_ct(volume, labels), float(spacing_mm(affine).max())
        notes += [*of_ct, *_where(thickest_mm > _THICK_MM, "thick", mm=thickest_mm)]
    notes += _cut(organ_kind.words, labels, shape, affine) or _flat(organ_kind.words, labels)
    anatomy, surface = surfaces(labels, organ_kind)
    anatomy = replace(anatomy, structures=structures)
    columns = (surface[name] for name in ("names", "dropped_ml", "change_percent"))
    for part, ml, change in zip(*columns, strict=True):
        notes += _where(ml > LEAST_DROPPED_ML, "dropped", what=part, ml=ml)
        if abs(change) > _MOST_CHANGE_PERCENT:
            notes.append(
                f"{part}: the surface's volume is {change:+.1f} % off its labels'; it is too thin "
                "or hangs together by too little for a smooth surface. Look at qc.png"
            )
    measured = _measured(labels, anatomy, surface)
    notes += _unusual(organ_kind, measured)
    report = {"kind": "label map" if as_labels else "ct", "notes": notes, **measured}
    patient = patient_of(path, file_patient, options.patient, side)
    return Case(anatomy, labels, direction_lps(options.up), report, ct, patient)


def _where(holds: bool, kind: Kind, **values: float | str) -> list[Finding]:
    return [Finding(kind, values)] if holds else []


def _selected(
    volume: LabelVolume, parts: Parts, path: Path, options: PrepareOptions
) -> tuple[LabelVolume, dict[str, Mesh], list[Note], Side]:
    """The organ and its tumors, structures, notes, and the organ's side."""
    counts, organ, tumors = label_counts(volume.labels), parts.organ[0], parts.tumors
    if tumors and options.tumors is None:  # tools also write segments that hold nothing
        tumors = tuple(n for n in tumors if counts[n])
    if np.count_nonzero(counts[1:]) == 1 and is_tumor(path.name.split(".")[0]):
        raise InputError(f"{path} is a tumor by its name. Give the organ's file as well.")
    if not (parts.names or options.organs) and (other := other_organ(path.name, options.name)):
        raise InputError(
            f"{path} is of a {other} by its name. Give --name {other}, or --organ NUMBER of the "
            f"{options.organ_kind.words}."
        )
    others = [n for n in np.flatnonzero(counts).tolist() if n >= FIRST_TUMOR]
    used = organ, *(others if tumors is None else tumors)
    _check_every_slice(among(volume.labels, used), volume.lps_from_index, path)
    source, structures = split_structures(volume, parts.structures, organ)
    selection = options.stated_side, organ, tumors, options.min_tumor_ml, options.organ_kind
    chosen, notes, side = select_labels(source, *selection)
    around = _on_grid(source.labels, source.lps_from_index, chosen, 0)
    shares = neighbours(around, chosen.labels, used)
    ml = counts * voxel_ml(volume.lps_from_index)
    for n, share in shares.items():
        if share > _ENCLOSED and n not in parts.names and options.tumors is None:
            raise InputError(
                f"{path}: the organ encloses label {n} ({ml[n]:.1f} ml), and nothing says what it "
                f"is. Give --tumor {n}, --organ {n} as well if it is part of the organ, or "
                "--tumor 0 if there is no tumor."
            )
        name = f" {parts.names[n]}" if n in parts.names else ""
        notes.append(Finding("beside", {"label": n, "name": name, "ml": float(ml[n])}))
    return chosen, structures, [parts.note, *notes] if parts.note else notes, side


def _cut(
    name: str, labels: LabelVolume, shape: tuple[int, ...], affine: np.ndarray
) -> list[Finding]:
    """A warning if the organ reaches the border of the image of this shape, which has the labels'
    grid."""
    counts = np.zeros(3)
    for axis, (first, n) in enumerate(zip(_start(affine, labels), shape, strict=True)):
        for index in (-first, n - 1 - first):
            if 0 <= index < labels.labels.shape[axis]:
                counts[axis] += np.count_nonzero(labels.labels.take(index, axis))
    voxels, area_cm2 = float(counts.sum()), float(counts @ face_areas_mm2(affine)) / 100
    return _where(voxels > _FEW, "cut", part=name, voxels=voxels, area_cm2=area_cm2)


def _check_every_slice(solid: np.ndarray, affine: np.ndarray, path: Path) -> None:
    """Refuse an organ with its tumors that was drawn in some slices alone: those between have
    nothing, and those on either side of them the same."""
    for axis, step_mm in enumerate(spacing_mm(affine).tolist()):
        slices = np.moveaxis(solid, axis, 0)
        drawn = np.flatnonzero(slices.any((1, 2))).tolist()
        for last, following in itertools.pairwise(drawn):
            if not 0 < (following - last - 1) * step_mm < _GAP_MM:
                continue
            same = np.count_nonzero(slices[last] & slices[following])
            if same > _SAME_DRAWN * np.count_nonzero(slices[last]):
                raise InputError(
                    f"{path}: from index {last + 1} on, slices between drawn ones are empty. Fill "
                    'them (3D Slicer: Segment Editor, "Fill between slices").'
                )


def _flat(name: str, labels: LabelVolume) -> list[Finding]:
    """A warning where the organ ends in a plane of the grid, with hardly less than its middle."""
    worst_mm2 = 0.0
    for axis, face_mm2 in enumerate(face_areas_mm2(labels.lps_from_index).tolist()):
        voxels = np.moveaxis(labels.labels > 0, axis, 0).sum((1, 2))
        end = voxels[np.flatnonzero(voxels)[[0, -1]]].max()
        if end > _FLAT * voxels.max():
            worst_mm2 = max(worst_mm2, face_mm2 * float(end))
    return _where(worst_mm2 > 0, "flat", part=name, area_cm2=worst_mm2 / 100)


def _unusual(organ_kind: Organ, measured: dict[str, Any]) -> list[Finding]:
    low, high = _USUAL_ML.get(organ_kind.name, (0.0, np.inf))
    ml = measured["volumes_ml"][organ_kind.name]
    return _where(not low <= ml <= high, "volume", part=organ_kind.words, ml=ml, low=low, high=high)


def patient_of(path: Path, in_file: Patient, identifier: str | None, side: Side) -> Patient:
    """The patient as stated ``in_file``, with the user's ``identifier`` if given, and the selected
    ``side``. Raises InputError: the file at ``path`` states the other side."""
    if in_file.differs(Patient(side=side)):
        raise InputError(
            f"{path} states the {in_file.side} side (DICOM), and the {side} one was selected. "
            "Check --side, and that these are the right images."
        )
    return Patient(identifier or in_file.id, in_file.side if side == UNKNOWN else side)


def _from_meshes(files: list[Path], options: PrepareOptions) -> Case:
    unused = (*_OF_CT, *OF_LABELS[:-1], "series")
    refuse_unused(f"{files[0]} is a mesh", options, *unused)
    anatomy, notes = read_meshes(files, options.unit, options.organ_kind, options.min_tumor_ml)
    labels = label_meshes(anatomy)
    mesh_ml = [part.volume_ml for part in anatomy.parts]
    measured = _measured(labels, anatomy, {"names": list(anatomy.names), "mesh_ml": mesh_ml})
    notes += [*_flat(options.organ_kind.words, labels), *_unusual(options.organ_kind, measured)]
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
        "volumes_ml": {anatomy.organ_kind.name: float(counts[1:].sum()), **tumors},
        "surface": surface,
        "spacing_mm": spacing_mm(labels.lps_from_index).tolist(),
    }


def _with_ct(case: Case, path: Path) -> Case:
    """The case with its CT, which must have the labels' steps, and a warning if the organ reaches
    its end. Raises InputError."""
    raw = read_raw(path)
    volume = _turned_as(volume_of(raw, path), case.labels.lps_from_index)
    steps = np.linalg.inv(volume.lps_from_index) @ case.labels.lps_from_index
    if np.abs(steps - np.rint(steps)).max() > _OFF_GRID or not np.allclose(
        steps[:3, :3], np.eye(3), atol=_OFF_GRID / max(case.labels.labels.shape)
    ):
        raise InputError(f"--ct {path}: its voxels are not the labels'. Resample one of the two.")
    if case.patient.differs(raw.patient):
        raise InputError(f"--ct {path} is of {raw.patient}, the labels of {case.patient}.")
    cut = _cut(case.anatomy.organ_kind.words, case.labels, volume.hu.shape, volume.lps_from_index)
    known = {note.kind for note in case.report["notes"] if isinstance(note, Finding)}
    case = replace(case, ct=crop_ct(volume, case.labels))
    return _noted(case, [] if "cut" in known else cut)


def _turned_as(volume: Volume, affine: np.ndarray) -> Volume:
    """The volume with its axes in the order and direction of those of ``affine``, where they are
    parallel: programs store a CT and its labels turned to either side."""
    from nibabel.orientations import apply_orientation, inv_ornt_aff, io_orientation

    turn = io_orientation(np.linalg.inv(affine) @ volume.lps_from_index)
    back = inv_ornt_aff(turn, volume.hu.shape)
    return Volume(apply_orientation(volume.hu, turn), volume.lps_from_index @ back)


def _start(affine: np.ndarray, labels: LabelVolume) -> list[int]:
    """The index, on a grid with the labels' steps, of the labels' first voxel."""
    return np.rint((np.linalg.inv(affine) @ labels.lps_from_index)[:3, 3]).astype(int).tolist()


def _on_grid(array: np.ndarray, affine: np.ndarray, labels: LabelVolume, fill: float) -> np.ndarray:
    """An array with the labels' steps on the labels' grid, ``fill`` beyond its edge."""
    shape, start = labels.labels.shape, _start(affine, labels)
    inner = grown_box([slice(a, a + n) for a, n in zip(start, shape, strict=True)], array.shape)
    out = np.full(shape, fill, array.dtype)
    target = tuple(slice(s.start - a, s.stop - a) for s, a in zip(inner, start, strict=True))
    out[target] = array[inner]
    return out


def crop_ct(volume: Volume, labels: LabelVolume) -> Volume:
    """The CT on the labels' grid, air beyond the scan's edge."""
    hu = _on_grid(volume.hu, volume.lps_from_index, labels, -1000.0)
    return Volume(hu, labels.lps_from_index)
