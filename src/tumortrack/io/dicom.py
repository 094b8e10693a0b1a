"""A DICOM series as a volume; ``dicom_pixels`` reads its pixels.

Slices are sorted by their position along the slice normal, and gaps are refused: other readers only
warn of a missing slice and stretch the patient.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.core.grid import GZIP_BEST, RawVolume, check_affine, check_size, check_suffix
from tumortrack.core.patient import NOBODY, UNKNOWN, Patient, Side
from tumortrack.io.dicom_pixels import read_pixels
from tumortrack.io.pydicom_library import load_pydicom

MIN_SLICES = 10
_MAX_FILES = 20_000
_NO_SLICE, _SEGMENTATION = "no DICOM slices", "DICOM segmentations (give one itself)"
# What may differ from slice to slice, as writers round: components of directions, relative pixel
# spacing, relative slope, and HU.
_SAME_DIRECTION, _SAME_SPACING, _SAME_SLOPE, _SAME_HU = 2e-3, 5e-4, 1e-4, 0.1
_CT = "1.2.840.10008.5.1.4.1.1.2"  # SOP class of CT images
_SEGMENTATIONS = "1.2.840.10008.5.1.4.1.1.66.4"  # and of binary segmentations
_UNDEFINED = 0xFFFFFFFF  # length of compressed pixels
_DEFLATED = "1.2.840.10008.1.2.1.99"  # transfer syntax; pydicom would unpack it unchecked
_AGAIN = "Export the series again."


class Plane(NamedTuple):
    """Of a frame: LPS place of its first pixel; directions (along a row, along a column); spacing
    between rows and columns; and slope and intercept that make stored numbers HU."""

    position_mm: tuple[float, ...]
    orientation: tuple[float, ...]
    spacing_mm: tuple[float, ...]
    scale: tuple[float, float]

    @property
    def normal(self) -> np.ndarray:
        return np.cross(self.orientation[:3], self.orientation[3:])

    @property
    def fault(self) -> str:
        if min(self.spacing_mm) <= 0:
            return f"PixelSpacing {self.spacing_mm} must be above 0"
        return f"RescaleSlope {self.scale[0]:g} must be above 0" if self.scale[0] <= 0 else ""

    def lps_from_index(self, step_mm: np.ndarray) -> Float[np.ndarray, "4 4"]:
        """Of a stack that begins here; index i runs along a row."""
        row, column = np.reshape(self.orientation, (2, 3))
        between_rows, between_columns = self.spacing_mm
        out = np.eye(4)
        axes = row * between_columns, column * between_rows, step_mm, self.position_mm
        out[:3] = np.stack(axes, axis=1)
        return out


class _Slice(NamedTuple):
    path: Path
    uid: str
    description: str
    modality: str
    patient_id: str
    laterality: str  # L, R or something else
    instance: str  # SOPInstanceUID
    shape: tuple[int, int]  # rows, columns
    classic: bool  # its file has no other frame
    fault: str  # why its pixels can't be HU; "": nothing
    plane: Plane
    frame: int  # of its file


class NoSeries(InputError):
    """The folder has no slices."""


@dataclass(frozen=True, eq=False)
class Series:
    """The slices of one series, in order along the slice normal: files and frames of them.
    ``shape``: columns, rows, slices; ``lps_from_index``: (column, row, slice) -> LPS mm; ``scale``:
    slope and intercept to HU."""

    files: tuple[Path, ...]
    frames: tuple[int, ...]
    shape: tuple[int, int, int]
    lps_from_index: Float[np.ndarray, "4 4"]
    scale: tuple[float, float]
    notes: tuple[str, ...] = ()
    patient: Patient = NOBODY


def find_series(folder: Path, series: str | None = None) -> Series:
    """Find one CT series in a folder (sub-folders not searched) without reading its pixels.
    ``series``: its UID, or its number in the error's list; None: the only one with modality CT and
    at least 10 slices of one size and orientation. Raises InputError: no series, several, a
    missing, double or stray slice; images of two patients."""
    groups, notes = _groups(folder)
    chosen = _choose(folder, groups, series)
    # With their places, as some anonymisers give all slices one UID.
    different = [*{(s.instance, s.frame, s.plane.position_mm): s for s in chosen}.values()]
    if copies := len(chosen) - len(different):
        notes += (f"{copies} slices are there twice (SOPInstanceUID): one of each is read",)
    first = different[0]
    _check_tags(folder, different)
    normal = first.plane.normal
    if not 0.99 < np.linalg.norm(normal) < 1.01:
        raise InputError(f"{first.path}: ImageOrientationPatient is not two unit directions.")
    slices = sorted(different, key=lambda s: float(np.dot(s.plane.position_mm, normal)))
    start = first.plane._replace(position_mm=slices[0].plane.position_mm)
    lps_from_index = start.lps_from_index(_slice_step(folder, slices, normal))
    shape = (first.shape[1], first.shape[0], len(slices))
    stored = sum(path.stat().st_size for path in {s.path for s in slices})
    check_size(folder, shape, 4, compressed=True, stored=stored)
    check_affine(folder, lps_from_index)
    others = [s.path.name for group in groups if group is not chosen for s in group]
    if others:  # perhaps a damaged slice is among them
        kinds = "other series, sizes, orientations or numbers of frames"
        notes += (f"{len(others)} images of {kinds} left out ({_named(others)})",)
    if not first.uid:
        notes += ("the slices have no SeriesInstanceUID: taken as one series",)
    files, frames = zip(*((s.path, s.frame) for s in slices), strict=True)
    patient = _patient(folder, groups, slices)
    return Series(files, frames, shape, lps_from_index, first.plane.scale, notes, patient)


def _named(names: list[str]) -> str:
    different = list(dict.fromkeys(names))
    return ", ".join(different[:3] + ["..."] * (len(different) > 3))


def read_dicom(folder: Path, series: str | None = None) -> RawVolume:
    """Read one CT series in HU, float32. Raises InputError: as ``find_series``; damaged pixels."""
    chosen = find_series(folder, series)
    array = read_pixels(chosen.files, chosen.shape, chosen.scale, chosen.frames)
    return RawVolume(array, chosen.lps_from_index, chosen.notes, chosen.patient)


def _patient(folder: Path, groups: list[list[_Slice]], slices: list[_Slice]) -> Patient:
    """The patient of the chosen slices. Raises InputError: the folder mixes patients."""
    ids = sorted({s.patient_id for group in groups for s in group} - {""})
    if len(ids) > 1:
        raise InputError(
            f"{folder} holds images of {len(ids)} patients (PatientID {_named(ids)}). Give a "
            "folder of one patient alone."
        )
    sides: dict[str, Side] = {"L": "left", "R": "right"}
    first, *others = {s.laterality for s in slices}
    side = UNKNOWN if others else sides.get(first, UNKNOWN)
    return Patient(ids[0] if ids else UNKNOWN, side)


def _check_tags(folder: Path, slices: list[_Slice]) -> None:
    """Refuse slices that cannot be Hounsfield units; positions are checked in ``_slice_step``."""
    scales = [s.plane.scale for s in slices]
    slope, intercept = np.ptp(scales, axis=0)
    if slope > _SAME_SLOPE * abs(scales[0][0]) or intercept > _SAME_HU:
        raise InputError(f"{folder}: its slices differ in RescaleSlope or Intercept. {_AGAIN}")
    for s in slices:
        if fault := s.plane.fault or s.fault:
            raise InputError(f"{s.path}: {fault}. {_AGAIN}")


def _groups(folder: Path) -> tuple[list[list[_Slice]], tuple[str, ...]]:
    """Slices by series, size and orientation, in a fixed order; and notes on other files."""
    inside = folder.iterdir() if folder.is_dir() else [folder]
    files = sorted(p for p in inside if p.is_file() and not p.name.startswith("."))
    if len(files) > _MAX_FILES:
        raise InputError(f"{folder} holds {len(files)} files; the limit is {_MAX_FILES}.")
    by_key: dict[tuple[Any, ...], list[_Slice]] = {}
    left_out: dict[str, list[Path]] = {_NO_SLICE: [], _SEGMENTATION: []}
    slices: list[_Slice] = []
    for file in files:
        found = _read_tags(file)
        if isinstance(found, str):
            left_out[found].append(file)
        else:
            slices += found
    for tags in slices:
        if not np.isfinite(np.concatenate(tags.plane)).all():
            raise InputError(
                f"{tags.path}: its position, orientation, spacing or scale is not finite. {_AGAIN}"
            )
        key = tags.uid, tags.shape, tags.classic, tags.plane.orientation
        same = (
            known
            for known in by_key
            if known[:3] == key[:3]
            and np.abs(np.subtract(known[3], key[3])).max() < _SAME_DIRECTION
        )
        by_key.setdefault(next(same, key), []).append(tags)
    if not by_key:
        for file in left_out[_NO_SLICE]:
            check_suffix(file)
        raise NoSeries(f"{folder} holds no DICOM image with a position. Give the slices' folder.")
    notes = tuple(
        f"{len(paths)} files are {what}: left out ({_named([p.name for p in paths])})"
        for what, paths in left_out.items()
        if paths
    )
    order = sorted(by_key, key=lambda key: (-len(by_key[key]), repr(key)))
    return [by_key[key] for key in order], notes


def _read_tags(path: Path) -> list[_Slice] | str:
    """The tags of a file's slices, or why it has none (``_NO_SLICE``, ``_SEGMENTATION``)."""
    load_pydicom()
    import pydicom
    from pydicom.filereader import read_dataset, read_file_meta_info
    from pydicom.valuerep import STANDARD_VR

    tags: Any = None
    with warnings.catch_warnings(), path.open("rb") as stream:
        warnings.simplefilter("ignore")  # damage is reported by our own errors
        head = stream.read(132)
        is_dicom = head[128:] == b"DICM"
        bare = head[:2] in (b"\2\0", b"\x08\0")  # old writers leave the preamble out
        stream.seek(0)
        try:
            meta: Any = read_file_meta_info(path) if is_dicom else {}
            if meta.get("TransferSyntaxUID") == _DEFLATED:
                tags = pydicom.FileDataset(path, {}, file_meta=meta)
                raise ValueError("deflated as a whole, which is not read")
            tags = pydicom.dcmread(stream, stop_before_pixels=True, force=bare)
            start = stream.tell()  # of the pixel data; long values from there on are not read
            implicit, little = tags.original_encoding
            rest = read_dataset(stream, implicit, little, defer_size=1024)
            stream.seek(start)
            parts = (tags.file_meta, tags, rest)
            types = {str(element.VR) for part in parts for element in part.values()}
            if strange := types - STANDARD_VR - {"None"}:  # GDCM would read gigabyte lengths
                raise ValueError(f"elements of the type {sorted(strange)[0]!r}")
            if tags.get("SOPClassUID") == _SEGMENTATIONS:
                return _SEGMENTATION
            uid, description, modality, patient_id = (
                "".join(c if c.isprintable() else "?" for c in str(tags.get(tag) or ""))
                for tag in ("SeriesInstanceUID", "SeriesDescription", "Modality", "PatientID")
            )
            patient_id = patient_id.strip()[:64].strip()  # as long as the standard allows
            laterality = str(tags.get("ImageLaterality") or tags.get("Laterality") or "")
            instance = str(tags.get("SOPInstanceUID") or path)
            words = path, uid, description, modality, patient_id, laterality, instance
            shape, count = (int(tags.Rows), int(tags.Columns)), int(tags.get("NumberOfFrames") or 1)
            pixels = shape, count == 1, _pixel_fault(tags, stream, count)
            return [
                _Slice(*words, *pixels, plane_of(group), frame)
                for frame, group in enumerate(frame_groups(tags, count))
            ]
        except Exception as error:  # pydicom raises anything on a foreign or damaged file
            kind = _CT  # unless it gets as far as to say another one
            with suppress(Exception):
                kind = tags.file_meta.get("MediaStorageSOPClassUID")
            if is_dicom and kind == _CT:
                raise InputError(f"{path} is cut short or damaged ({error}). {_AGAIN}") from error
            return _NO_SLICE


def is_segmentation(path: Path) -> bool:
    """Raises InputError: a damaged CT slice."""
    return _read_tags(path) == _SEGMENTATION


def frame_groups(tags: Any, count: int) -> Iterator[Callable[[str], Any]]:
    """For each frame, what returns the item of one of its functional groups (PS3.3 C.7.6.16); of a
    classic slice, which has none, the tags themselves."""
    shared = (tags.get("SharedFunctionalGroupsSequence") or [tags])[0]
    own = tags.get("PerFrameFunctionalGroupsSequence") or [tags] * count
    if len(own) != count or count > _MAX_FILES:
        raise ValueError(f"{count} frames, and {len(own)} groups of tags")

    def group(item: Any, name: str) -> Any:
        return (item.get(name) or shared.get(name) or [tags])[0]

    for item in own:
        yield partial(group, item)


def plane_of(group: Callable[[str], Any]) -> Plane:
    """From what ``frame_groups`` gives. Raises anything: a tag is missing or damaged."""

    def numbers(sequence: str, tag: str, count: int) -> tuple[float, ...]:
        values = tuple(map(float, getattr(group(sequence), tag)))
        if len(values) != count:
            raise ValueError(f"{tag} has {len(values)} numbers where {count} belong")
        return values

    rescale = group("PixelValueTransformationSequence")
    slope, intercept = rescale.get("RescaleSlope"), rescale.get("RescaleIntercept")
    return Plane(
        numbers("PlanePositionSequence", "ImagePositionPatient", 3),
        numbers("PlaneOrientationSequence", "ImageOrientationPatient", 6),
        numbers("PixelMeasuresSequence", "PixelSpacing", 2),
        (1.0 if slope is None else float(slope), 0.0 if intercept is None else float(intercept)),
    )


def _pixel_fault(tags: Any, stream: BinaryIO, frames: int) -> str:
    """What is wrong with the kind and length of the pixel data, at which the stream stands:
    decoders pad what is missing and allocate whatever is claimed."""
    samples = int(tags.get("SamplesPerPixel") or 1)
    if samples != 1:
        return f"{samples} samples a pixel are no CT's, which has 1"
    start, head = stream.tell(), stream.read(12)
    implicit, little = tags.original_encoding
    if head and not implicit and head[4:6] not in (b"OB", b"OW", b"OF", b"OD"):
        return "its pixels are of no known type"
    size = 8 if implicit else 12  # of the element's head, which ends with the length
    length = int.from_bytes(head[size - 4 : size], "little" if little else "big")
    stored = os.fstat(stream.fileno()).st_size - start - size
    bits = int(tags.get("BitsAllocated") or 16)
    needed = int(tags.Rows) * int(tags.Columns) * bits * frames // 8
    possible = stored * GZIP_BEST if length == _UNDEFINED else min(length, stored)
    if possible >= needed:
        return ""
    return f"it claims {tags.Columns} x {tags.Rows} pixels and holds {max(0, stored)} bytes of them"


def _choose(folder: Path, groups: list[list[_Slice]], series: str | None) -> list[_Slice]:
    if series is not None:
        fitting = [g for n, g in enumerate(groups, 1) if series in (g[0].uid, str(n))]
        what = f"fit {series!r}"
    else:
        fitting = [g for g in groups if g[0].modality == "CT" and len(g) >= MIN_SLICES]
        what = f"are CT with at least {MIN_SLICES} slices"
    if len(fitting) == 1:
        return fitting[0]
    listing = "\n".join(
        f"  {n}: {g[0].uid or '(no UID)'}, {g[0].description or '(no description)'}, "
        f"{g[0].modality}, {len(g)} slices of {g[0].shape[1]} x {g[0].shape[0]}"
        for n, g in enumerate(groups, 1)
    )
    raise InputError(
        f"{folder} holds these series and {len(fitting)} of them {what}; give --series with a UID "
        f"or number:\n{listing}"
    )


def _slice_step(folder: Path, slices: list[_Slice], normal: np.ndarray) -> np.ndarray:
    """The vector from one slice to the next, after checking that all slices follow it."""
    spacings = [s.plane.spacing_mm for s in slices]
    if np.ptp(spacings, axis=0).max() > _SAME_SPACING * max(spacings[0]):
        raise InputError(f"{folder}: its slices differ in pixel spacing.")
    if len(slices) < 2:
        raise InputError(f"{folder}: one slice is no volume.")
    positions = np.array([s.plane.position_mm for s in slices])
    along = positions @ normal
    usual = float(np.median(gaps := np.diff(along)))
    for n in np.flatnonzero(np.abs(gaps - usual) > max(0.02, 0.05 * abs(usual))):
        doubled = gaps[n] < 0.5 * usual or usual < 0.01
        kind = "two slices lie at" if doubled else "a slice is missing after"
        raise InputError(
            f"{folder}: {kind} position {along[n]:.2f} mm ({slices[n].path.name} to "
            f"{slices[n + 1].path.name}: {gaps[n]:.2f} mm, usually {usual:.2f} mm). {_AGAIN}"
        )
    step = (positions[-1] - positions[0]) / (len(slices) - 1)
    off_mm = np.linalg.norm(
        positions - positions[0] - np.outer(np.arange(len(slices)), step), axis=1
    )
    if off_mm.max() > max(0.1, 0.1 * abs(usual)):
        stray = slices[int(off_mm.argmax())].path
        raise InputError(f"{stray} lies {off_mm.max():.2f} mm off the others' line. {_AGAIN}")
    return step
