"""A CT as scanners store it: a DICOM series."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.store import new_folder
from tumortrack.core.types import Volume

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

_INTERCEPT = -1024  # stored values are unsigned, as scanners write them
_HIGHEST_HU = 65535 + _INTERCEPT
_DATE, _TIME = "20250101", "120000"  # fixed, so that the same volume gives the same files


def write_dicom_series(
    volume: Volume, folder: Path, seed: int = 0, description: str = "Hydrogel kidney phantom"
) -> None:
    """Write a CT Image Storage series, one uncompressed file a slice (the third array axis).

    UIDs follow from the volume and the seed. File names are in random order, so that a reader
    must sort by ImagePositionPatient. Exposure as in the paper (90 kV, 13.6 mA).

    Raises:
        InputError: ``folder`` exists; HU not finite or outside -1024..64511; sheared voxels.
        StorageError: the disk refused; no part of the folder is left behind.
    """
    from pydicom import dcmwrite

    _check(volume)
    digest = hashlib.sha256(volume.hu.tobytes() + volume.lps_from_index.tobytes()).hexdigest()
    entropy = [digest, str(seed), description]
    names = np.random.default_rng(seed).permutation(volume.hu.shape[2])
    with new_folder(Path(folder)) as aside:
        for k, name in enumerate(names):
            dataset = _header(entropy, description)
            _put_slice(dataset, volume, k, entropy)
            dcmwrite(aside / f"CT{name:05d}.dcm", dataset, enforce_file_format=True)


def _check(volume: Volume) -> None:
    if not ((volume.hu >= _INTERCEPT) & (volume.hu <= _HIGHEST_HU)).all():
        raise InputError(f"HU must be finite and within {_INTERCEPT}..{_HIGHEST_HU} for DICOM.")
    directions = volume.lps_from_index[:3, :3] / spacing_mm(volume.lps_from_index)
    if not np.allclose(directions.T @ directions, np.eye(3), atol=1e-4):
        raise InputError(
            "the volume's axes are not perpendicular; a DICOM series cannot hold that. Resample "
            "it first."
        )


def _header(entropy: list[str], description: str) -> Dataset:
    """What all slices share: patient, study, series, equipment and acquisition."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid

    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    dataset.SOPClassUID = CTImageStorage
    dataset.ImageType = ["ORIGINAL", "PRIMARY", "AXIAL"]
    dataset.StudyDate = dataset.SeriesDate = dataset.AcquisitionDate = dataset.ContentDate = _DATE
    dataset.StudyTime = dataset.SeriesTime = dataset.AcquisitionTime = dataset.ContentTime = _TIME
    dataset.AccessionNumber = ""
    dataset.Modality = "CT"
    dataset.Manufacturer = "tumortrack"
    dataset.ManufacturerModelName = "Virtual CT scanner"
    dataset.ReferringPhysicianName = ""
    dataset.StudyDescription = "Phantom, not a patient"
    dataset.SeriesDescription = description
    dataset.PatientName = "PHANTOM^TUMORTRACK"
    dataset.PatientID = "PHANTOM"
    dataset.PatientBirthDate = ""
    dataset.PatientSex = "O"
    dataset.BodyPartExamined = "KIDNEY"
    dataset.KVP = 90
    dataset.XRayTubeCurrent = 14  # a whole number by the standard; the next tag is exact
    dataset.XRayTubeCurrentInuA = 13600
    dataset.PatientPosition = "HFS"
    dataset.StudyInstanceUID = generate_uid(entropy_srcs=[*entropy, "study"])
    dataset.SeriesInstanceUID = generate_uid(entropy_srcs=[*entropy, "series"])
    dataset.FrameOfReferenceUID = generate_uid(entropy_srcs=[*entropy, "frame"])
    dataset.StudyID = "1"
    dataset.SeriesNumber = 1
    dataset.AcquisitionNumber = 1
    dataset.PositionReferenceIndicator = ""
    return dataset


def _put_slice(dataset: Dataset, volume: Volume, k: int, entropy: list[str]) -> None:
    """Pixels and geometry of slice k. Rows run along array axis 1, columns along axis 0."""
    from pydicom.uid import generate_uid
    from pydicom.valuerep import format_number_as_ds

    spacing = spacing_mm(volume.lps_from_index)
    directions = volume.lps_from_index[:3, :3] / spacing
    position = volume.lps_from_index @ [0, 0, k, 1]

    def decimal(values: np.ndarray) -> list[str]:
        return [format_number_as_ds(float(value)) for value in values]

    dataset.SOPInstanceUID = generate_uid(entropy_srcs=[*entropy, f"slice {k}"])
    dataset.file_meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    dataset.InstanceNumber = k + 1
    dataset.ImagePositionPatient = decimal(position[:3])
    # First the direction in which the column number grows (axis 0), then the row number (axis 1).
    dataset.ImageOrientationPatient = decimal(directions[:, :2].T.ravel())
    dataset.PixelSpacing = decimal(spacing[[1, 0]])  # between rows, then between columns
    dataset.SliceThickness = decimal(spacing[2:])[0]
    dataset.SliceLocation = decimal(directions[:, 2:].T @ position[:3])[0]
    dataset.SamplesPerPixel = 1
    dataset.PhotometricInterpretation = "MONOCHROME2"
    stored = (np.rint(volume.hu[:, :, k]) - _INTERCEPT).astype("<u2").T
    dataset.Rows, dataset.Columns = stored.shape
    dataset.BitsAllocated, dataset.BitsStored, dataset.HighBit = 16, 16, 15
    dataset.PixelRepresentation = 0
    dataset.RescaleIntercept = _INTERCEPT
    dataset.RescaleSlope = 1
    dataset.RescaleType = "HU"
    dataset.WindowCenter, dataset.WindowWidth = 100, 1600
    dataset.PixelData = np.ascontiguousarray(stored).tobytes()
