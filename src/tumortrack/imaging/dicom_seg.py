"""A case's labels as a DICOM segmentation of the CT that they were drawn on, through highdicom.

Standard: DICOM PS3.3 A.51 (Segmentation IOD). The segmentation stands on the CT's own slices, so
that every viewer lays it over them; which voxel that is follows from the two affines alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

import tumortrack
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import LabelVolume
from tumortrack.imaging.dicom import Series, find_series
from tumortrack.imaging.segmentation import KIDNEY, SIDES, Segment, Term

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

_OFF_GRID = 0.05  # of a voxel: rounding of positions in files, and nothing else
_SERIES_NUMBER = 900


def write_dicom_seg(
    path: Path,
    labels: LabelVolume,
    parts: Sequence[Segment],
    folder: Path,
    series: str | None = None,
) -> tuple[str, ...]:
    """Write ``labels`` as a binary segmentation that refers to the slices in ``folder``.

    Args:
        parts: as many as there are labels, in their order.
        folder, series: the CT, as for ``read_dicom``. It need not be what the labels were made
            from, but their voxels must coincide (axes may be turned or run the other way).

    Returns:
        Notes on what else was in the folder.

    Raises:
        InputError: no such series; another grid; slices that lack what a segmentation must repeat;
            highdicom is not installed.
        StorageError: the disk refused.
    """
    found = find_series(folder, series)
    pixels = labels_on(found, labels, str(folder))
    slices = [_tags(file) for file in found.files]
    dataset = _segmentation(slices, pixels, parts)
    try:
        dataset.save_as(path)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}.") from error
    return found.notes


def labels_on(series: Series, labels: LabelVolume, where: str) -> UInt8[np.ndarray, "k j i"]:
    """The labels on the series' voxels: (slice, row, column).

    Raises:
        InputError: voxels that do not coincide, or labels outside the series.
    """
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


def _tags(file: Path) -> Dataset:
    import pydicom

    return pydicom.dcmread(file, stop_before_pixels=True)


def _segmentation(
    slices: list[Dataset], pixels: UInt8[np.ndarray, "k j i"], parts: Sequence[Segment]
) -> Any:
    try:
        import highdicom as hd
    except ImportError as error:
        raise InputError("--dicom needs highdicom: pip install 'tumortrack[live]'.") from error
    from pydicom.uid import generate_uid

    digest = hashlib.sha256(pixels.tobytes())
    digest.update("".join(str(one.get("SOPInstanceUID")) for one in slices).encode())
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
            content_label="KIDNEY_TUMORS",
            series_description="Kidney and tumors (tumortrack)",
        )
    except AttributeError as error:  # highdicom's word for a tag that a slice lacks
        raise InputError(
            f"the CT's slices lack what a segmentation must repeat ({error}). Export the series "
            "again from the archive, anonymised if need be but with its tags."
        ) from error


def _description(part: Segment) -> Any:
    import highdicom as hd
    from pydicom.sr.codedict import codes

    def code(term: Term) -> Any:
        return hd.sr.CodedConcept(term.code, "SCT", term.meaning)

    described = hd.seg.SegmentDescription(
        segment_number=part.label,
        segment_label=part.name,
        segmented_property_category=code(part.category),
        segmented_property_type=code(part.kind),
        # Whoever drew them, `prepare` has chosen among the pieces and closed their cavities.
        algorithm_type=hd.seg.SegmentAlgorithmTypeValues.SEMIAUTOMATIC,
        algorithm_identification=hd.AlgorithmIdentificationSequence(
            "tumortrack prepare", codes.cid7162.MorphologicalOperations, tumortrack.__version__
        ),
        anatomic_regions=None if part.is_organ else [code(KIDNEY)],
        display_color=hd.color.CIELabColor.from_rgb(*part.rgb),
    )
    if part.side is not None and part.is_organ:
        kind = described.SegmentedPropertyTypeCodeSequence[0]
        kind.SegmentedPropertyTypeModifierCodeSequence = [code(SIDES[part.side])]
    elif part.side is not None:
        region = described.AnatomicRegionSequence[0]
        region.AnatomicRegionModifierSequence = [code(SIDES[part.side])]
    return described
