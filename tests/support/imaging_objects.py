"""An asymmetric object and the files that hold it, for the imaging tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.types import LabelVolume

# Centres of four unequal blobs in LPS mm: no rotation or mirror maps them onto themselves.
BLOBS_LPS = np.array([[0.0, 0.0, 0.0], [11.0, 0.0, 0.0], [0.0, 8.0, 0.0], [0.0, 0.0, 14.0]])
BLOB_VALUES = (100, 300, 500, 700)


def blob_array(
    lps_from_index: np.ndarray, shape: tuple[int, int, int], dtype: type = np.int16
) -> np.ndarray:
    """Each voxel takes the value of the blob it lies in (radius 3 mm), else 0."""
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    lps = index @ lps_from_index[:3, :3].T + lps_from_index[:3, 3]
    out = np.zeros(len(index), dtype)
    for centre, value in zip(BLOBS_LPS, BLOB_VALUES, strict=True):
        out[np.linalg.norm(lps - centre, axis=1) < 3] = value
    return out.reshape(shape)


def blob_centres(array: np.ndarray, lps_from_index: np.ndarray) -> np.ndarray:
    """Where a reader says the blobs lie, LPS mm."""
    centres = [np.argwhere(array == value).mean(0) for value in BLOB_VALUES]
    return np.array(centres) @ lps_from_index[:3, :3].T + lps_from_index[:3, 3]


def affine_lps(axes: str, spacing: tuple[float, float, float], turn: np.ndarray) -> np.ndarray:
    """lps_from_index of a grid whose array axes run to the named sides (such as IPL), centred."""
    directions = {"L": 0, "P": 1, "S": 2, "R": 0, "A": 1, "I": 2}
    linear = np.zeros((3, 3))
    for axis, name in enumerate(axes):
        linear[directions[name], axis] = 1 if name in "LPS" else -1
    out = np.eye(4)
    out[:3, :3] = turn @ linear * spacing
    out[:3, 3] = np.array([5.0, 4.0, 7.0]) - out[:3, :3] @ (np.array(SHAPE) - 1) / 2
    return out


SHAPE = (41, 36, 39)
OBLIQUE = np.linalg.qr(np.array([[1.0, 0.2, -0.1], [-0.25, 1.0, 0.3], [0.15, -0.2, 1.0]]))[0]
OBLIQUE = OBLIQUE * np.sign(np.diag(OBLIQUE))


def write_nifti(path: Path, array: np.ndarray, lps_from_index: np.ndarray, form: str) -> None:
    """A NIfTI whose orientation stands in the sform only, the qform only, or both."""
    import nibabel

    image = nibabel.Nifti1Image(array, None)
    affine = RAS_FROM_LPS @ lps_from_index
    image.set_sform(affine, code=1 if form in ("sform", "both") else 0)
    image.set_qform(affine, code=1 if form in ("qform", "both") else 0)
    if form == "sform":
        image.header["qform_code"] = 0
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


def write_nrrd(path: Path, array: np.ndarray, lps_from_index: np.ndarray, gzip: bool) -> None:
    """A NRRD written by SimpleITK (LPS)."""
    import SimpleITK as sitk  # noqa: N813

    spacing = np.linalg.norm(lps_from_index[:3, :3], axis=0)
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps_from_index[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps_from_index[:3, 3].tolist())
    sitk.WriteImage(image, str(path), gzip)


def write_dicom(
    folder: Path,
    array: np.ndarray,
    lps_from_index: np.ndarray,
    *,
    seed: int = 0,
    uid: str = "1.2.3",
    modality: str = "CT",
) -> list[Path]:
    """One uncompressed slice file per k, in shuffled file names; returned in order of k."""
    import pydicom
    from pydicom.dataset import FileDataset, FileMetaDataset
    from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian

    folder.mkdir(parents=True, exist_ok=True)
    spacing = np.linalg.norm(lps_from_index[:3, :3], axis=0)
    row, column = (lps_from_index[:3, n] / spacing[n] for n in (0, 1))
    names = np.random.default_rng(seed).permutation(array.shape[2])
    paths = []
    for k, name in enumerate(names):
        meta = FileMetaDataset()
        meta.MediaStorageSOPClassUID = CTImageStorage
        meta.MediaStorageSOPInstanceUID = f"{uid}.{k + 1}"
        meta.TransferSyntaxUID = ExplicitVRLittleEndian
        path = folder / f"{uid}_{name:04d}"
        data = FileDataset(path, {}, file_meta=meta, preamble=b"\0" * 128)
        data.SOPClassUID, data.SOPInstanceUID = CTImageStorage, f"{uid}.{k + 1}"
        data.SeriesInstanceUID, data.StudyInstanceUID = uid, "1.2"
        data.Modality, data.SeriesDescription = modality, f"series {uid}"
        data.ImagePositionPatient = [
            f"{x:.9g}" for x in lps_from_index[:3, 3] + k * lps_from_index[:3, 2]
        ]
        data.ImageOrientationPatient = [f"{x:.9g}" for x in (*row, *column)]
        data.PixelSpacing = [f"{spacing[1]:.9g}", f"{spacing[0]:.9g}"]
        data.Rows, data.Columns = array.shape[1], array.shape[0]
        data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
        data.BitsAllocated, data.BitsStored, data.HighBit = 16, 16, 15
        data.PixelRepresentation, data.RescaleSlope, data.RescaleIntercept = 1, 1, -1024
        data.PixelData = (array[:, :, k].T.astype(np.int16) + 1024).tobytes()
        pydicom.dcmwrite(path, data)
        paths.append(path)
    return paths


def kidney_labels(
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0), tumor_radius_mm: float = 9.0
) -> LabelVolume:
    """An ellipsoid of 104 x 60 x 50 mm with one tumor half outside it and one inside."""
    counts = np.ceil(np.array([140.0, 100.0, 90.0]) / spacing).astype(int)
    axes = [(np.arange(n) - (n - 1) / 2) * s for n, s in zip(counts, spacing, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    labels = ((x / 52) ** 2 + (y / 30) ** 2 + (z / 25) ** 2 < 1).astype(np.uint8)
    labels[(x - 20) ** 2 + (y - 26) ** 2 + z**2 < tumor_radius_mm**2] = 2
    labels[(x + 20) ** 2 + y**2 + (z - 3) ** 2 < (0.8 * tumor_radius_mm) ** 2] = 3
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = [a[0] for a in axes]
    return LabelVolume(labels, affine)
