"""NIfTI files through nibabel. NIfTI is RAS+; it becomes LPS here (and back in core.nifti)."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.nifti import write_nifti
from tumortrack.imaging.voxels import (
    RawVolume,
    check_affine,
    check_numbers,
    check_size,
    check_stored,
)

_MAX_OFFSET = 16 * 2**20  # bytes of header and extensions before the voxels


def read_nifti(path: Path) -> RawVolume:
    """Read .nii or .nii.gz. The sform places it, or the qform where there is no sform.

    Raises:
        InputError: damaged, not 3-D, too large, without or with contradictory orientation,
            not in millimetres.
    """
    import nibabel

    try:
        with _silent(nibabel.imageglobals.logger):
            image: Any = nibabel.load(path)
        header = image.header
        shape = tuple(int(n) for n in header.get_data_shape())
        dtype = header.get_data_dtype()
        units = header.get_xyzt_units()[0]
        offset = float(header["vox_offset"])
        magic = bytes(header["magic"].tobytes())
    except Exception as error:  # nibabel raises anything on a damaged file
        raise InputError(f"{path} cannot be read as NIfTI: {error}.") from error
    if magic[:3] not in (b"n+1", b"n+2"):
        raise InputError(
            f"{path}: its voxels lie in another file (magic {magic!r}); detached data are refused. "
            "Export one .nii or .nii.gz file."
        )
    if not (math.isfinite(offset) and 0 <= offset <= _MAX_OFFSET):
        raise InputError(f"{path}: the header puts the voxels at byte {offset:g}; it is damaged.")
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    check_size(path, shape, dtype.itemsize)
    check_numbers(path, dtype)
    compressed = path.suffix.lower() == ".gz"
    check_stored(path, math.prod(shape) * dtype.itemsize, compressed)
    if units not in ("mm", "unknown"):
        raise InputError(
            f"{path} states its unit as {units}; millimetres are needed. Export it in mm."
        )
    lps_from_index = _lps_from_index(path, header)
    check_affine(path, lps_from_index)
    try:
        array = np.asarray(image.dataobj).reshape(shape)
    except Exception as error:
        raise InputError(f"{path} is truncated or damaged: {error}.") from error
    return RawVolume(array, lps_from_index)


@contextmanager
def _silent(logger: logging.Logger) -> Iterator[None]:
    """nibabel mends some headers and says so; what is wrong with a file, we say ourselves."""
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _lps_from_index(path: Path, header: Any) -> Float[np.ndarray, "4 4"]:
    """The affine the header states; never a guess, since a guess may mirror the patient."""
    try:
        sform, sform_code = header.get_sform(coded=True)
        qform, qform_code = header.get_qform(coded=True)
    except Exception as error:
        raise InputError(f"{path}: its orientation cannot be read: {error}.") from error
    if not sform_code and not qform_code:
        raise InputError(
            f"{path} states no orientation (sform and qform codes are 0), so left and right are "
            "unknown. Export it again with its orientation."
        )
    if sform_code and qform_code:
        with np.errstate(all="ignore"):
            s, q = (a[:3, :3] / np.linalg.norm(a[:3, :3], axis=0) for a in (sform, qform))
            agree = bool((np.sum(s * q, axis=0) > math.cos(math.radians(2))).all())
        if not agree:
            raise InputError(
                f"{path}: its two orientations (sform and qform) disagree, so left and right are "
                "uncertain. Export it again from the DICOM series."
            )
    return RAS_FROM_LPS @ np.asarray(sform if sform_code else qform, np.float64)


def write_labels_nifti(
    path: Path,
    labels: UInt8[np.ndarray, "i j k"],
    frame_from_index: Float[np.ndarray, "4 4"],
    lps: bool,
) -> None:
    """Write labels as .nii.gz, units mm.

    Args:
        frame_from_index: index -> mm. Patient frame (``lps`` True): converted from LPS to NIfTI's
            RAS. Camera frame (``lps`` False): written as it is, voxel -> camera-frame mm.

    Raises:
        StorageError: the disk refused.
    """
    write_nifti(path, labels, frame_from_index, lps)


def write_volume_nifti(
    path: Path, hu: Num[np.ndarray, "i j k"], lps_from_index: Float[np.ndarray, "4 4"]
) -> None:
    """Write a CT as .nii.gz: 16-bit integers where that loses nothing, else float32.

    Raises:
        StorageError: the disk refused.
    """
    whole = np.clip(np.rint(hu), -32768, 32767).astype(np.int16)
    exact = whole if np.array_equal(whole, hu) else hu.astype(np.float32)
    write_nifti(path, exact, lps_from_index, lps=True)
