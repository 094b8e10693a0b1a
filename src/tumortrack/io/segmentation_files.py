"""Label maps with names, colours and SNOMED CT terms: for 3D Slicer (.seg.nrrd), and as a DICOM
segmentation of their CT.

Formats: https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html,
https://teem.sourceforge.net/nrrd/format.html; DICOM PS3.3 A.51 (Segmentation IOD), by highdicom.
"""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

import tumortrack
from tumortrack.core.colours import part_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.grid import tight_box
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.packages import to_install
from tumortrack.core.patient import NOBODY, UNKNOWN, Patient, Side
from tumortrack.core.store import write_atomically, writing
from tumortrack.core.tables import read_table
from tumortrack.core.types import ORGAN, LabelVolume
from tumortrack.io.dicom import Series, find_series
from tumortrack.io.nifti import GZIP_LEVEL

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

_NRRD = read_table("tumortrack.io", "seg_nrrd.toml", dict[str, str])
_OFF_GRID = 0.05  # of a voxel: rounding of positions in files
_SERIES_NUMBER = 900


class Term(NamedTuple):
    """A concept of SNOMED CT."""

    code: str
    meaning: str

    def __str__(self) -> str:
        return f"SCT^{self.code}^{self.meaning}"


STRUCTURE = Term("123037004", "Anatomical Structure")
ALTERED = Term("49755003", "Morphologically Altered Structure")
MASS = Term("4147007", "Mass")
_SIDES: dict[Side, Term] = {"left": Term("7771000", "Left"), "right": Term("24028007", "Right")}


@dataclass(frozen=True)
class Segment:
    """One label of a map. Labels do not overlap: the organ's, 1, is the parenchyma."""

    label: int
    name: str
    side: Side = UNKNOWN
    organ: Organ = KIDNEY

    @property
    def is_organ(self) -> bool:
        return self.label == ORGAN

    @property
    def region(self) -> Term:
        """The organ that it is or lies in."""
        return Term(*self.organ.snomed)

    @property
    def terms(self) -> tuple[Term, Term]:
        return (STRUCTURE, self.region) if self.is_organ else (ALTERED, MASS)

    @property
    def rgb(self) -> tuple[int, int, int]:
        return part_colour(self.label)

    @property
    def terminology(self) -> str:
        """As Slicer writes it: category, type and its modifier; region and its modifier."""
        side = str(_SIDES.get(self.side, "^^"))
        modifier, region = (side, "^^~^^") if self.is_organ else ("^^", f"{self.region}~{side}")
        category, kind = self.terms
        return (
            f"Segmentation category and type - DICOM master list~{category}~{kind}~{modifier}"
            f"~Anatomic codes - DICOM master list~{region}"
        )


def segments(
    names: Iterable[str], side: Side = UNKNOWN, organ: Organ = KIDNEY
) -> tuple[Segment, ...]:
    """Segments with labels 1, 2, ... of the parts' ``names``."""
    return tuple(Segment(label, name, side, organ) for label, name in enumerate(names, ORGAN))


def write_seg_nrrd(
    path: Path,
    labels: UInt8[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    parts: Sequence[Segment],
) -> None:
    """Write labels as one layer of segments, gzip; the same arguments give the same bytes. Labels
    in the camera frame are written as if that were LPS, which is how Slicer then shows them. Raises
    StorageError: the disk refused; an older file is untouched."""
    columns = ["(" + ",".join(repr(float(n)) for n in c) + ")" for c in lps_from_index[:3].T]
    sizes, directions = " ".join(map(str, labels.shape)), " ".join(columns[:3])
    head = _NRRD["file"].format(sizes=sizes, directions=directions, origin=columns[3])
    for n, part in enumerate(parts):
        mask, extent = labels == part.label, "0 -1 0 -1 0 -1"
        if mask.any():  # first and last index along each axis
            extent = " ".join(f"{side.start} {side.stop - 1}" for side in tight_box(mask))
        color = " ".join(f"{c / 255:.6g}" for c in part.rgb)
        head += _NRRD["segment"].format(n=n, part=part, color=color, extent=extent)
    voxels = gzip.compress(labels.tobytes(order="F"), GZIP_LEVEL, mtime=0)
    write_atomically(path, f"{head}\n".encode("ascii") + voxels)


def write_dicom_seg(
    path: Path,
    labels: LabelVolume,
    parts: Sequence[Segment],
    folder: Path,
    series: str | None = None,
    patient: Patient = NOBODY,
) -> tuple[str, ...]:
    """Write ``labels``, one of ``parts`` each, as a binary segmentation of the CT that ``folder``
    and ``series`` name, whose voxels must coincide with theirs (axes may be permuted or flipped).
    Returns notes on what else was in the folder. Raises InputError: no such series; another
    patient's than ``patient``; another grid; slices that lack what a segmentation must repeat;
    highdicom is not installed; StorageError: the disk refused."""
    ct = find_series(folder, series)
    import pydicom

    if max(ct.frames):
        raise InputError(f"{folder} holds a multi-frame CT. --dicom needs one file for each slice.")
    if patient.differs(ct.patient):
        raise InputError(
            f"{folder} is of {ct.patient}, the labels are of {patient}. Give the CT of that "
            "patient; if the case has a pseudonym, say whom its CT names: --patient PATIENTID."
        )
    pixels = _resampled(labels, ct, folder)
    slices = [pydicom.dcmread(file, stop_before_pixels=True) for file in ct.files]
    dataset = _segmentation(slices, pixels, parts)
    with writing(path):
        dataset.save_as(path)
    return ct.notes


def _resampled(labels: LabelVolume, series: Series, folder: Path) -> UInt8[np.ndarray, "k j i"]:
    """The labels as (slice, row, column) of the series, whose voxels must coincide."""
    ct_from_index = np.linalg.inv(series.lps_from_index) @ labels.lps_from_index
    turn = np.rint(ct_from_index[:3, :3])
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(labels.labels.shape) - 1.0)
    corners = transform_points(ct_from_index, corners)
    off = np.abs(corners - np.rint(corners)).max()
    # If axes map to axes and every corner lies on a voxel, so does every voxel between them.
    if abs(abs(np.linalg.det(turn)) - 1) > 1e-6 or off > _OFF_GRID:
        raise InputError(
            f"{folder}: the case's voxels are not this CT's, so the segmentation cannot lie on its "
            "slices. Give the DICOM folder of which the case, or its label map, was made."
        )
    inside = np.argwhere(labels.labels > 0)
    index = np.rint(transform_points(ct_from_index, inside.astype(float))).astype(int)
    if (index < 0).any() or (index >= series.shape).any():
        raise InputError(f"{folder}: the labels reach beyond this CT. Give its whole series.")
    pixels = np.zeros(series.shape[::-1], np.uint8)
    pixels[tuple(index.T[::-1])] = labels.labels[tuple(inside.T)]
    return pixels


def _segmentation(
    slices: Sequence[Dataset], pixels: UInt8[np.ndarray, "k j i"], parts: Sequence[Segment]
) -> Any:
    try:
        import highdicom as hd
    except ImportError as error:
        how = to_install("tumortrack[dicom]")
        raise InputError(f"--dicom needs highdicom (Python up to 3.13): {how}.") from error
    from pydicom.uid import generate_uid

    digest = hashlib.sha256(pixels.tobytes())
    digest.update("".join(str(tags.get("SOPInstanceUID")) for tags in slices).encode())
    organ = parts[0].organ
    entropy = ["tumortrack", digest.hexdigest()]
    try:
        return hd.seg.Segmentation(
            source_images=slices,
            pixel_array=pixels,
            segmentation_type=hd.seg.SegmentationTypeValues.BINARY,
            segment_descriptions=[_description(part) for part in parts],
            series_instance_uid=generate_uid(entropy_srcs=[*entropy, "series"]),
            series_number=_SERIES_NUMBER,
            sop_instance_uid=generate_uid(entropy_srcs=[*entropy, "instance"]),
            instance_number=1,
            manufacturer="tumortrack",
            manufacturer_model_name="tumortrack",
            software_versions=tumortrack.__version__,
            device_serial_number="0",
            content_label=f"{organ.name[:9].upper()}_TUMORS",
            series_description=f"{organ.words.capitalize()} and tumors (tumortrack)",
        )
    except AttributeError as error:  # what highdicom raises for a missing tag
        raise InputError(
            f"the CT's slices lack what a segmentation must repeat ({error}). Export the series "
            "again from the archive, anonymised if need be but with its tags."
        ) from error


def _description(part: Segment) -> Any:
    import highdicom as hd
    from pydicom.sr.codedict import codes
    from pydicom.sr.coding import Code

    def code(term: Term) -> Any:
        return Code(term.code, "SCT", term.meaning)

    category, kind = map(code, part.terms)
    description = hd.seg.SegmentDescription(
        segment_number=part.label,
        segment_label=part.name,
        segmented_property_category=category,
        segmented_property_type=kind,
        # Whoever drew them, `prepare` selected pieces and filled holes.
        algorithm_type=hd.seg.SegmentAlgorithmTypeValues.SEMIAUTOMATIC,
        algorithm_identification=hd.AlgorithmIdentificationSequence(
            "tumortrack prepare", codes.cid7162.MorphologicalOperations, tumortrack.__version__
        ),
        anatomic_regions=None if part.is_organ else [code(part.region)],
        display_color=hd.color.CIELabColor.from_rgb(*part.rgb),
    )
    if part.side in _SIDES:
        side = [hd.sr.CodedConcept.from_code(code(_SIDES[part.side]))]
        if part.is_organ:
            item = description.SegmentedPropertyTypeCodeSequence[0]
            item.SegmentedPropertyTypeModifierCodeSequence = side
        else:
            description.AnatomicRegionSequence[0].AnatomicRegionModifierSequence = side
    return description
