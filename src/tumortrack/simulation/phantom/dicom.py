"""Write a CT as a DICOM series."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.patient import UNKNOWN, Side
from tumortrack.core.store import new_folder
from tumortrack.core.tables import read_table
from tumortrack.core.types import Volume
from tumortrack.io.pydicom_library import load_pydicom

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

_INTERCEPT = -1024  # stored values are unsigned, as scanners write them
_HIGHEST_HU = 65535 + _INTERCEPT
_TAGS = read_table("tumortrack.simulation.phantom", "ct_tags.toml", dict[str, Any])


def write_dicom_series(
    volume: Volume,
    folder: Path,
    seed: int = 0,
    description: str = "Hydrogel kidney phantom",
    side: Side = UNKNOWN,
) -> None:
    """Write a CT Image Storage series, one uncompressed file per slice (third array axis), in
    random order of names. UIDs are derived from the volume and the seed. ``side`` is written as
    Laterality. Raises InputError: ``folder`` exists; HU not finite or outside -1024..64511; sheared
    voxels. Raises StorageError: writing failed; nothing is left behind."""
    load_pydicom()
    from pydicom import dcmwrite

    if not ((volume.hu >= _INTERCEPT) & (volume.hu <= _HIGHEST_HU)).all():
        raise InputError(f"HU must be finite and within {_INTERCEPT}..{_HIGHEST_HU} for DICOM.")
    directions = volume.lps_from_index[:3, :3] / spacing_mm(volume.lps_from_index)
    if not np.allclose(directions.T @ directions, np.eye(3), atol=1e-4):
        raise InputError("the volume's axes are not perpendicular. Resample it for DICOM.")
    digest = hashlib.sha256(volume.hu.tobytes() + volume.lps_from_index.tobytes()).hexdigest()
    entropy = [digest, str(seed), description]
    names = np.random.default_rng(seed).permutation(volume.hu.shape[2])
    with new_folder(Path(folder)) as aside:
        for k, name in enumerate(names):
            dataset = _slice(volume, k, entropy, description)
            if side != UNKNOWN:
                dataset.Laterality = side[0].upper()
            dcmwrite(aside / f"CT{name:05d}.dcm", dataset, enforce_file_format=True)


def _slice(volume: Volume, k: int, entropy: list[str], description: str) -> Dataset:
    """Slice k of the series. Rows run along array axis 1, columns along axis 0."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, generate_uid
    from pydicom.valuerep import format_number_as_ds

    def uid(what: str) -> str:
        return generate_uid(entropy_srcs=[*entropy, what])

    def decimal(values: np.ndarray) -> list[str]:
        return [format_number_as_ds(float(value)) for value in values]

    spacing = spacing_mm(volume.lps_from_index)
    directions = volume.lps_from_index[:3, :3] / spacing
    position = volume.lps_from_index @ [0, 0, k, 1]
    stored = (np.rint(volume.hu[:, :, k]) - _INTERCEPT).astype("<u2").T
    dataset = Dataset()
    dataset.file_meta = FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    tags: dict[str, Any] = {
        **_TAGS,
        "SOPClassUID": CTImageStorage,
        "SOPInstanceUID": uid(f"slice {k}"),
        "StudyInstanceUID": uid("study"),
        "SeriesInstanceUID": uid("series"),
        "FrameOfReferenceUID": uid("frame"),
        "SeriesDescription": description,
        "InstanceNumber": k + 1,
        "ImagePositionPatient": decimal(position[:3]),
        # Direction of increasing column number (axis 0), then of increasing row number (axis 1)
        "ImageOrientationPatient": decimal(directions[:, :2].T.ravel()),
        "PixelSpacing": decimal(spacing[[1, 0]]),  # between rows, then between columns
        "SliceThickness": decimal(spacing[2:])[0],
        "SliceLocation": decimal(directions[:, 2:].T @ position[:3])[0],
        **dict(zip(("Rows", "Columns"), stored.shape, strict=True)),
        "RescaleIntercept": _INTERCEPT,
        "PixelData": np.ascontiguousarray(stored).tobytes(),
    }
    for name, value in tags.items():
        setattr(dataset, name, value)
    dataset.file_meta.MediaStorageSOPClassUID = dataset.SOPClassUID
    dataset.file_meta.MediaStorageSOPInstanceUID = dataset.SOPInstanceUID
    return dataset
