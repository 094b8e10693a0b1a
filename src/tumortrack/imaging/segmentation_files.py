"""Label maps with names, colours and standard terms: for 3D Slicer (.seg.nrrd), and as a DICOM
segmentation of the CT that they were drawn on.

Formats: https://slicer.readthedocs.io/en/latest/developer_guide/modules/segmentations.html,
https://teem.sourceforge.net/nrrd/format.html; DICOM PS3.3 A.51 (Segmentation IOD), through
highdicom. Terms are SNOMED CT's.
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
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.patient import NOBODY, UNKNOWN, Patient, Side
from tumortrack.core.store import write_atomically, writing
from tumortrack.core.types import ORGAN, LabelVolume
from tumortrack.imaging.dicom import Series, find_series
from tumortrack.imaging.grid import tight_box
from tumortrack.imaging.nifti import GZIP_LEVEL

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

_OFF_GRID = 0.05  # of a voxel: rounding of positions in files, and nothing else
_SERIES_NUMBER = 900


class Term(NamedTuple):
    """A code and what it means, as pydicom and highdicom take it."""

    code: str
    scheme: str
    meaning: str

    def __str__(self) -> str:
        return "^".join((self.scheme, self.code, self.meaning))


STRUCTURE = Term("123037004", "SCT", "Anatomical Structure")
ALTERED = Term("49755003", "SCT", "Morphologically Altered Structure")
MASS = Term("4147007", "SCT", "Mass")
_SIDES: dict[Side, Term] = {
    "left": Term("7771000", "SCT", "Left"),
    "right": Term("24028007", "SCT", "Right"),
}


@dataclass(frozen=True)
class Segment:
    """One label of a map: the part's name, what it is, and its colour (red, green, blue: 0..255).

    Labels do not overlap: the organ's segment, label 1, is the parenchyma.
    """

    label: int
    name: str
    side: Side = UNKNOWN
    organ: Organ = KIDNEY

    @property
    def is_organ(self) -> bool:
        return self.label == ORGAN

    @property
    def region(self) -> Term:
        """The organ that it is, or lies in."""
        code, meaning = self.organ.snomed
        return Term(code, "SCT", meaning)

    @property
    def terms(self) -> tuple[Term, Term]:
        """Category and type."""
        return (STRUCTURE, self.region) if self.is_organ else (ALTERED, MASS)

    @property
    def rgb(self) -> tuple[int, int, int]:
        return part_colour(self.label)

    @property
    def terminology(self) -> str:
        """As Slicer writes it: category, type and its modifier; region and its modifier."""
        side = str(_SIDES.get(self.side, "^^"))
        where, region = (side, "^^~^^") if self.is_organ else ("^^", f"{self.region}~{side}")
        category, kind = self.terms
        return (
            f"Segmentation category and type - DICOM master list~{category}~{kind}~{where}"
            f"~Anatomic codes - DICOM master list~{region}"
        )


def segments(
    names: Iterable[str], side: Side = UNKNOWN, organ: Organ = KIDNEY
) -> tuple[Segment, ...]:
    """The segments of parts (the organ's name, tumor_1, ...), labelled 1, 2, ..."""
    return tuple(Segment(label, name, side, organ) for label, name in enumerate(names, ORGAN))


def write_seg_nrrd(
    path: Path,
    labels: UInt8[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    parts: Sequence[Segment],
) -> None:
    """Write labels as one layer of segments, gzip; all bytes follow from the arguments. Raises
    StorageError: the disk refused; an older file is untouched.

    Args:
        lps_from_index: index -> LPS mm. Labels before the camera: their camera frame, which Slicer
            then shows as if it were the patient's.
    """
    columns = ["(" + ",".join(repr(float(n)) for n in c) + ")" for c in lps_from_index[:3].T]
    lines = [
        "NRRD0004",
        "type: unsigned char",
        "dimension: 3",
        "space: left-posterior-superior",
        "sizes: " + " ".join(str(n) for n in labels.shape),
        "space directions: " + " ".join(columns[:3]),
        "kinds: domain domain domain",
        "encoding: gzip",
        f"space origin: {columns[3]}",
        "Segmentation_ContainedRepresentationNames:=Binary labelmap|Closed surface|",
        "Segmentation_MasterRepresentation:=Binary labelmap",  # Slicer before 5.2
        "Segmentation_SourceRepresentation:=Binary labelmap",
        "Segmentation_ReferenceImageExtentOffset:=0 0 0",
    ]
    for n, part in enumerate(parts):
        mask, extent = labels == part.label, "0 -1 0 -1 0 -1"
        if mask.any():  # first and last index along each axis
            extent = " ".join(f"{side.start} {side.stop - 1}" for side in tight_box(mask))
        fields = {
            "ID": part.name,
            "Name": part.name,
            "NameAutoGenerated": "0",
            "Color": " ".join(f"{c / 255:.6g}" for c in part.rgb),
            "ColorAutoGenerated": "0",
            "LabelValue": str(part.label),
            "Layer": "0",
            "Extent": extent,
            "Tags": f"TerminologyEntry:{part.terminology}|",
        }
        lines += [f"Segment{n}_{key}:={value}" for key, value in fields.items()]
    voxels = gzip.compress(labels.tobytes(order="F"), GZIP_LEVEL, mtime=0)
    write_atomically(path, "\n".join([*lines, "", ""]).encode("ascii") + voxels)


def write_dicom_seg(
    path: Path,
    labels: LabelVolume,
    parts: Sequence[Segment],
    folder: Path,
    series: str | None = None,
    patient: Patient = NOBODY,
) -> tuple[str, ...]:
    """Write ``labels`` as a binary segmentation on the slices in ``folder``: viewers overlay it.
    Returns notes on what else was in the folder.
    Raises InputError: no such series; another patient's; another grid; slices that lack what a
    segmentation must repeat; highdicom is not installed; StorageError: the disk refused.

    Args:
        parts: as many as there are labels, in their order.
        folder, series: the CT, as for ``read_dicom``. It need not be what the labels were made
            from, but their voxels must coincide (axes may be turned or run the other way).
        patient: whose labels these are.
    """
    found = find_series(folder, series)
    import pydicom

    if patient.differs(found.patient):
        raise InputError(
            f"{folder} is of {found.patient}, the labels are of {patient}. Give the CT of that "
            "patient; if the case has a pseudonym, say whom its CT names: --patient PATIENTID."
        )
    pixels = _labels_on(found, labels, str(folder))
    slices = [pydicom.dcmread(file, stop_before_pixels=True) for file in found.files]
    dataset = _segmentation(slices, pixels, parts)
    with writing(path):
        dataset.save_as(path)
    return found.notes


def _labels_on(series: Series, labels: LabelVolume, where: str) -> UInt8[np.ndarray, "k j i"]:
    """The labels on the series' voxels, which must coincide: (slice, row, column)."""
    ct_from_index = np.linalg.inv(series.lps_from_index) @ labels.lps_from_index
    turn = np.rint(ct_from_index[:3, :3])
    corners = np.indices((2, 2, 2)).reshape(3, -1).T * (np.array(labels.labels.shape) - 1.0)
    there = transform_points(ct_from_index, corners)
    off = np.abs(there - np.rint(there)).max()
    # A turn by right angles, and every corner on a voxel: then so is every voxel between them.
    if abs(abs(np.linalg.det(turn)) - 1) > 1e-6 or off > _OFF_GRID:
        raise InputError(
            f"{where}: the case's voxels are not this CT's, so the segmentation cannot lie on its "
            "slices. Give the DICOM folder of which the case, or its label map, was made."
        )
    inside = np.argwhere(labels.labels > 0)
    index = np.rint(transform_points(ct_from_index, inside.astype(float))).astype(int)
    if (index < 0).any() or (index >= series.shape).any():
        raise InputError(f"{where}: the case's labels reach beyond this CT. Give its whole series.")
    pixels = np.zeros(series.shape[::-1], np.uint8)
    pixels[tuple(index.T[::-1])] = labels.labels[tuple(inside.T)]
    return pixels


def _segmentation(
    slices: Sequence[Dataset], pixels: UInt8[np.ndarray, "k j i"], parts: Sequence[Segment]
) -> Any:
    try:
        import highdicom as hd
    except ImportError as error:
        raise InputError(
            "--dicom needs highdicom: pip install 'tumortrack[live]' (Python up to 3.13)."
        ) from error
    from pydicom.uid import generate_uid

    digest = hashlib.sha256(pixels.tobytes())
    digest.update("".join(str(one.get("SOPInstanceUID")) for one in slices).encode())
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
    except AttributeError as error:  # highdicom's word for a tag that a slice lacks
        raise InputError(
            f"the CT's slices lack what a segmentation must repeat ({error}). Export the series "
            "again from the archive, anonymised if need be but with its tags."
        ) from error


def _description(part: Segment) -> Any:
    import highdicom as hd
    from pydicom.sr.codedict import codes
    from pydicom.sr.coding import Code

    category, kind = (Code(*term) for term in part.terms)
    described = hd.seg.SegmentDescription(
        segment_number=part.label,
        segment_label=part.name,
        segmented_property_category=category,
        segmented_property_type=kind,
        # Whoever drew them, `prepare` has chosen among the pieces and closed their cavities.
        algorithm_type=hd.seg.SegmentAlgorithmTypeValues.SEMIAUTOMATIC,
        algorithm_identification=hd.AlgorithmIdentificationSequence(
            "tumortrack prepare", codes.cid7162.MorphologicalOperations, tumortrack.__version__
        ),
        anatomic_regions=None if part.is_organ else [Code(*part.region)],
        display_color=hd.color.CIELabColor.from_rgb(*part.rgb),
    )
    if part.side in _SIDES:
        side = [hd.sr.CodedConcept(*_SIDES[part.side])]
        if part.is_organ:
            what = described.SegmentedPropertyTypeCodeSequence[0]
            what.SegmentedPropertyTypeModifierCodeSequence = side
        else:
            described.AnatomicRegionSequence[0].AnatomicRegionModifierSequence = side
    return described
