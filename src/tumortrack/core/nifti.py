"""NIfTI files out, through nibabel. NIfTI is RAS+, so patient volumes are turned from LPS here."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
from jaxtyping import Float, Num

from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.store import write_atomically

_GZIP_LEVEL = 4  # higher ones take several times longer and save little


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
        StorageError: the disk refused; an older file is untouched.
    """
    import nibabel

    affine = RAS_FROM_LPS @ frame_from_index if lps else frame_from_index
    image = nibabel.Nifti1Image(np.asarray(array), affine)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine, code="scanner")
    # A quaternion cannot hold shear; the sform alone is right for every affine.
    image.set_qform(affine, code="scanner" if _is_orthogonal(affine) else "unknown")
    content = image.to_bytes()
    if path.name.endswith(".gz"):
        content = gzip.compress(content, compresslevel=_GZIP_LEVEL, mtime=0)
    write_atomically(path, content)


def _is_orthogonal(affine: np.ndarray) -> bool:
    axes = affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0)
    return bool(np.allclose(axes.T @ axes, np.eye(3), atol=1e-4))
