"""NIfTI files out. NIfTI is RAS+, so patient volumes are turned from LPS here.

Own code: a header is 352 bytes, and nibabel's import, which brings pydicom's, takes a tenth of the
time in which `tumortrack locate` answers. Format: https://nifti.nimh.nih.gov/nifti-1.
"""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from jaxtyping import Float, Num

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.store import write_atomically

_GZIP_LEVEL = 4  # higher ones take several times longer and save little
_HEADER = np.dtype(  # what is written of it; all else is 0
    {
        "names": ["sizeof_hdr", "dim", "datatype", "bitpix", "pixdim", "vox_offset"]
        + ["scl_slope", "xyzt_units", "qform_code", "sform_code", "quaternion", "offset"]
        + ["srow", "magic"],
        "formats": ["<i4", ("<i2", 8), "<i2", "<i2", ("<f4", 8), "<f4"]
        + ["<f4", "u1", "<i2", "<i2", ("<f4", 3), ("<f4", 3)]
        + [("<f4", (3, 4)), "S4"],
        "offsets": [0, 40, 70, 72, 76, 108, 112, 123, 252, 254, 256, 268, 280, 344],
        "itemsize": 352,  # with four bytes that say: no extension follows
    }
)
_TYPES = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768}
_MM, _SCANNER = 2, 1


def write_nifti(
    path: Path,
    array: Num[np.ndarray, "i j k"],
    frame_from_index: Float[np.ndarray, "4 4"],
    lps: bool,
) -> None:
    """Write an array in its own number type as .nii or .nii.gz, units mm.

    Args:
        frame_from_index: index -> mm. Patient frame (``lps`` True): converted from LPS to NIfTI's
            RAS. Camera frame (``lps`` False): written as it is.

    Raises:
        InputError: numbers of a type that NIfTI does not know, or more than 32,767 along an axis.
        StorageError: the disk refused; an older file is untouched.
    """
    kind = f"{array.dtype.kind}{array.dtype.itemsize}"
    if kind not in _TYPES or max(array.shape) > np.iinfo(np.int16).max:
        raise InputError(
            f"{path}: a volume of {array.dtype} of shape {array.shape} is no NIfTI. Allowed: "
            f"{', '.join(str(np.dtype(one)) for one in _TYPES)}; 32,767 voxels along an axis."
        )
    header = _header(array, RAS_FROM_LPS @ frame_from_index if lps else frame_from_index)
    header["datatype"], header["bitpix"] = _TYPES[kind], 8 * array.dtype.itemsize
    voxels = array.astype(array.dtype.newbyteorder("<"), copy=False)
    content = header.tobytes() + voxels.tobytes(order="F")
    if path.name.endswith(".gz"):
        content = gzip.compress(content, compresslevel=_GZIP_LEVEL, mtime=0)
    write_atomically(path, content)


def _header(array: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Everything but the numbers' type."""
    axes = affine[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    handed = 1.0 if np.linalg.det(axes) > 0 else -1.0
    header = np.zeros((), _HEADER)
    header["sizeof_hdr"], header["vox_offset"], header["magic"] = 348, 352, b"n+1"
    header["dim"] = [3, *array.shape, 1, 1, 1, 1]
    header["pixdim"] = [handed, *spacing, 1, 1, 1, 1]
    header["scl_slope"], header["xyzt_units"] = 1, _MM
    header["sform_code"], header["srow"] = _SCANNER, affine[:3]
    # A quaternion cannot hold shear; the sform alone is right for every affine.
    if np.allclose((axes / spacing).T @ (axes / spacing), np.eye(3), atol=1e-4):
        header["qform_code"], header["offset"] = _SCANNER, affine[:3, 3]
        header["quaternion"] = _quaternion(axes / spacing * [1, 1, handed])
    return header


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """b, c, d of a rotation; a >= 0 is left out."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(turn).as_quat(canonical=True)[:3]
