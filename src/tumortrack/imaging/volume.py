"""Volumes from files: a DICOM folder, NIfTI or NRRD -> Volume or LabelVolume, LPS mm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.imaging.dicom import read_dicom
from tumortrack.imaging.grid import label_counts
from tumortrack.imaging.nifti import read_nifti, write_labels_nifti, write_volume_nifti
from tumortrack.imaging.nrrd import read_nrrd
from tumortrack.imaging.voxels import RawVolume

__all__ = [
    "is_label_map",
    "labels_of",
    "read_labels",
    "read_raw",
    "read_volume",
    "volume_of",
    "write_labels_nifti",
    "write_volume_nifti",
]

_DETACHED = (".nhdr", ".mhd", ".hdr", ".img")
_MOST_LABELS = 32  # distinct values that still look like a label map


def read_raw(path: Path, series: str | None = None) -> RawVolume:
    """Read the voxels of any supported volume in their stored type.

    Raises:
        InputError: missing, unknown type, detached, damaged, not a plausible patient volume.
    """
    name = path.name.lower()
    if path.is_dir():
        return read_dicom(path, series)
    if not path.is_file():
        raise InputError(f"{path} does not exist.")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes).")
    if name.endswith((".nii", ".nii.gz")):
        return read_nifti(path)
    if name.endswith(".nrrd"):
        return read_nrrd(path)
    if name.endswith(_DETACHED):
        raise InputError(
            f"{path} is a header whose voxels lie in another file; detached data are refused. "
            "Export one .nrrd, .nii or .nii.gz file."
        )
    raise InputError(
        f"{path} is no volume that can be read. Allowed: a folder of DICOM slices, .nii, .nii.gz, "
        ".nrrd."
    )


def read_volume(path: Path, series: str | None = None) -> Volume:
    """Read a CT volume (HU) from a DICOM folder, .nii, .nii.gz or .nrrd.

    Args:
        series: of several DICOM series, the wanted one's UID or number.

    Raises:
        InputError: see ``read_raw``; or the voxels hold NaN.
    """
    return volume_of(read_raw(path, series), path)


def read_labels(path: Path) -> LabelVolume:
    """Read a label map: whole numbers 0..255, in any number type.

    Raises:
        InputError: see ``read_raw``; or a value is no label.
    """
    return labels_of(read_raw(path), path)


def volume_of(raw: RawVolume, path: Path) -> Volume:
    """Raw voxels as a CT; ``path`` names them in errors."""
    hu = raw.array.astype(np.float32, copy=False)
    low, high = float(hu.min()), float(hu.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        raise InputError(f"{path} has NaN or infinite voxels. Export it again without them.")
    if max(-low, high) > 100_000:
        raise InputError(
            f"{path} has values from {low:g} to {high:g}; Hounsfield units are needed."
        )
    return Volume(hu, raw.lps_from_index)


def labels_of(raw: RawVolume, path: Path) -> LabelVolume:
    """Raw voxels as labels; ``path`` names them in errors."""
    array = raw.array
    low, high = float(array.min()), float(array.max())
    if not (low >= 0 and high <= 255):
        raise InputError(
            f"{path} is no label map: values from {low:g} to {high:g}; whole numbers from 0 to "
            "255 are allowed."
        )
    labels = array.astype(np.uint8)
    if array.dtype.kind == "f" and not np.array_equal(labels, array):
        raise InputError(f"{path} is no label map: it has fractions. Whole numbers are needed.")
    return LabelVolume(labels, raw.lps_from_index)


def is_label_map(raw: RawVolume) -> bool:
    """True for whole numbers within 0..255 of which at most 32 occur: no CT looks like that."""
    array = raw.array
    if not (array.min() >= 0 and array.max() <= 255):
        return False
    labels = array.astype(np.uint8)
    if array.dtype.kind == "f" and not np.array_equal(labels, array):
        return False
    return int(np.count_nonzero(label_counts(labels))) <= _MOST_LABELS
