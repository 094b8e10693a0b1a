"""NIfTI files, converted between NIfTI's RAS+ and our LPS. Read with nibabel; written by own code,
as `tumortrack locate` would wait for nibabel's import (docs/decisions/004-nifti-writer.md).

Format: https://nifti.nimh.nih.gov/nifti-1.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from tumortrack.core import grid
from tumortrack.core.errors import InputError, readable
from tumortrack.core.geometry import RAS_FROM_LPS, spacing_mm
from tumortrack.core.store import write_atomically
from tumortrack.io.pydicom_library import load_pydicom

GZIP_LEVEL = 4  # higher ones take several times longer and save little
_FIELDS: dict[str, tuple[Any, int]] = {  # types and offsets of what is written; all others are 0
    "sizeof_hdr": ("<i4", 0), "dim": (("<i2", 8), 40), "datatype": ("<i2", 70),
    "bitpix": ("<i2", 72), "pixdim": (("<f4", 8), 76), "vox_offset": ("<f4", 108),
    "scl_slope": ("<f4", 112), "xyzt_units": ("u1", 123), "qform_code": ("<i2", 252),
    "sform_code": ("<i2", 254), "quaternion": (("<f4", 3), 256), "offset": (("<f4", 3), 268),
    "srow": (("<f4", (3, 4)), 280), "magic": ("S8", 344),  # and that no extension follows
}  # fmt: skip
_FORMATS, _OFFSETS = zip(*_FIELDS.values(), strict=True)
_HEADER = np.dtype({"names": [*_FIELDS], "formats": _FORMATS, "offsets": _OFFSETS})
_TYPES = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768}
_MM, _SCANNER = 2, 1
_EQUAL_STEPS = 0.01  # of sform and qform, relatively
_SAME_TURN = math.radians(2)  # likewise
_LONGEST_HEADER = 540  # bytes: NIfTI-2's
_MAX_OFFSET = 16 * 2**20  # bytes of header and extensions before the voxels
_NO_GEOMETRY = (
    "the affine is the identity, as programs write it that lost the geometry: voxels of 1 mm, the "
    "first axis to the patient's right. Check size and side in qc.png, or export it again"
)
_SILENT = logging.Logger("nibabel", logging.CRITICAL)  # nibabel logs each repair of a header


def read_nifti(path: Path) -> grid.RawVolume:
    """Read .nii or .nii.gz. The sform is used, or the qform without one. Raises InputError:
    damaged, not 3-D, too large, without or with contradictory orientation, not in millimetres.

    ``nibabel.load`` would trust the stated length of extensions and skip the checksum."""
    compressed = path.suffix.lower() == ".gz"
    with grid.volume_stream(path, compressed) as stream:
        return _read(path, stream, compressed)


def _read(path: Path, stream: BufferedIOBase, compressed: bool) -> grid.RawVolume:
    load_pydicom()
    import nibabel
    from nibabel.volumeutils import apply_read_scaling

    head = stream.read(_LONGEST_HEADER)
    kinds = {348: nibabel.Nifti1Header, 540: nibabel.Nifti2Header}
    sizes = [struct.unpack(order + "i", head[:4].ljust(4, b"\0"))[0] for order in "<>"]
    size = next((size for size in sizes if size in kinds), None)
    if size is None:
        raise InputError(f"{path} is no NIfTI file (its header has {sizes[0]} bytes, not 348).")
    with readable(path, "cannot be read as NIfTI"):
        header = kinds[size](head[:size], check=False)
        header.check_fix(logger=_SILENT)
        shape = tuple(int(n) for n in header.get_data_shape())
        dtype = header.get_data_dtype()
        units = header.get_xyzt_units()[0]
        offset = float(header["vox_offset"]) or size + 4.0
        stored_scale = [header["scl_slope"], header["scl_inter"]]
        magic = bytes(header["magic"].tobytes())
        slope, intercept = header.get_slope_inter()
    if magic[:3] not in (b"n+1", b"n+2"):
        raise InputError(f"{path}: its voxels lie in another file. Export one .nii or .nii.gz.")
    if not (math.isfinite(offset) and size <= offset <= _MAX_OFFSET):
        raise InputError(f"{path}: the header puts the voxels at byte {offset:g}; it is damaged.")
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    grid.check_size(path, shape, dtype.itemsize, compressed)
    if dtype.kind not in "iuf":
        raise InputError(f"{path}: voxels are {dtype}; plain numbers are needed.")
    if units not in ("mm", "unknown"):
        raise InputError(f"{path} states its unit as {units}. Export it in mm.")
    lps_from_index = _lps_from_index(path, header)
    grid.check_affine(path, lps_from_index)
    # Both NaN means unscaled: so nibabel keeps the header of an image that it has scaled.
    if not (np.isfinite(stored_scale).all() or np.isnan(stored_scale).all()):
        raise InputError(f"{path}: its numbers' slope or intercept is not finite. Export it again.")
    stream.seek(int(offset))
    array = grid.read_voxels(path, stream, shape, dtype, compressed)
    scale = np.float64(slope or 1.0), np.float64(intercept or 0.0)
    notes = (_NO_GEOMETRY,) if np.array_equal(lps_from_index, RAS_FROM_LPS) else ()
    return grid.RawVolume(apply_read_scaling(array, *scale), lps_from_index, notes)


def _lps_from_index(path: Path, header: Any) -> Float[np.ndarray, "4 4"]:
    """The affine that the header states; never a guess, which might mirror the patient."""
    with readable(path, "has an orientation that cannot be read"):
        sform, sform_code = header.get_sform(coded=True)
        qform, qform_code = header.get_qform(coded=True)
    if not sform_code and not qform_code:
        raise InputError(f"{path} states no orientation (sform, qform). Export it again with it.")
    if sform_code and qform_code:
        with np.errstate(all="ignore"):
            steps = [np.linalg.norm(a[:3, :3], axis=0) for a in (sform, qform)]
            s, q = (a[:3, :3] / step for a, step in zip((sform, qform), steps, strict=True))
            forms = [s, *_without_shear(s)] if np.isfinite(s).all() else [s]
            agree = any((np.sum(s * q, axis=0) > math.cos(_SAME_TURN)).all() for s in forms)
            equal = np.allclose(steps[0], steps[1], rtol=_EQUAL_STEPS, atol=0)
            distance_mm = np.linalg.norm(sform[:3, 3] - qform[:3, 3])
        if not (agree and equal and distance_mm <= max(steps[0])):
            voxels = " and ".join(" x ".join(f"{mm:.4g}" for mm in step) for step in steps)
            what = "affines" if agree else "orientations"
            raise InputError(
                f"{path}: its two {what} (sform, qform) disagree: voxels of {voxels} mm, origins "
                f"{distance_mm:.4g} mm apart. Export it again from the DICOM series."
            )
    return RAS_FROM_LPS @ np.asarray(sform if sform_code else qform, np.float64)


def _without_shear(axes: Float[np.ndarray, "3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """What a quaternion, which holds no shear, can say of unit axes: the nearest rotation, as
    nibabel writes it, and that which keeps the first axis and the first two's plane."""
    u, _, vt = np.linalg.svd(axes)
    q, r = np.linalg.qr(axes)
    return u @ vt, q * np.sign(np.diag(r))


def write_nifti(
    path: Path,
    array: Num[np.ndarray, "i j k"],
    frame_from_index: Float[np.ndarray, "4 4"],
    lps: bool,
) -> None:
    """Write an array in its own number type as .nii or .nii.gz, units mm. ``lps``: the frame is the
    patient's, converted to RAS; False: the camera's, written as it is. Raises InputError: a number
    type that NIfTI does not know, or more than 32,767 voxels along an axis; StorageError: the disk
    refused; an older file is untouched."""
    kind = f"{array.dtype.kind}{array.dtype.itemsize}"
    if kind not in _TYPES or max(array.shape) > np.iinfo(np.int16).max:
        raise InputError(
            f"{path}: a volume of {array.dtype} of shape {array.shape} is no NIfTI. Allowed: "
            f"{', '.join(str(np.dtype(name)) for name in _TYPES)}; 32,767 voxels along an axis."
        )
    affine = RAS_FROM_LPS @ frame_from_index if lps else frame_from_index
    spacing = spacing_mm(affine)
    axes = affine[:3, :3] / spacing
    handedness = 1.0 if np.linalg.det(affine[:3, :3]) > 0 else -1.0
    header = np.zeros((), _HEADER)
    header["sizeof_hdr"], header["vox_offset"], header["magic"] = 348, 352, b"n+1"
    header["datatype"], header["bitpix"] = _TYPES[kind], 8 * array.dtype.itemsize
    header["dim"] = [3, *array.shape, 1, 1, 1, 1]
    header["pixdim"] = [handedness, *spacing, 1, 1, 1, 1]
    header["scl_slope"], header["xyzt_units"] = 1, _MM
    header["sform_code"], header["srow"] = _SCANNER, affine[:3]
    # A quaternion cannot hold shear; the sform alone is right for every affine.
    if np.allclose(axes.T @ axes, np.eye(3), atol=1e-4):
        header["qform_code"], header["offset"] = _SCANNER, affine[:3, 3]
        header["quaternion"] = _quaternion(axes * [1, 1, handedness])
    voxels = array.astype(array.dtype.newbyteorder("<"), copy=False)
    content = header.tobytes() + voxels.tobytes(order="F")
    if path.name.endswith(".gz"):
        content = gzip.compress(content, compresslevel=GZIP_LEVEL, mtime=0)
    write_atomically(path, content)


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
    """b, c and d of a rotation's quaternion with a >= 0 (Bar-Itzhack 2000, doi 10.2514/2.4654: the
    eigenvector of the largest eigenvalue). SciPy's takes 0.2 s to import."""
    whole = np.zeros((4, 4))
    whole[:3, :3] = rotation + rotation.T - np.trace(rotation) * np.eye(3)
    b, c, d = rotation[2, 1], rotation[0, 2], rotation[1, 0]
    whole[3] = whole[:, 3] = [b - rotation[1, 2], c - rotation[2, 0], d - rotation[0, 1], 0]
    whole[3, 3] = np.trace(rotation)
    bcda = np.linalg.eigh(whole)[1][:, -1]
    return bcda[:3] if bcda[3] >= 0 else -bcda[:3]


def write_volume_nifti(
    path: Path, hu: Num[np.ndarray, "i j k"], lps_from_index: Float[np.ndarray, "4 4"]
) -> None:
    """Write a CT (see ``write_nifti``): 16-bit integers where that loses nothing, else float32."""
    whole = np.clip(np.rint(hu), -32768, 32767).astype(np.int16)
    exact = whole if np.array_equal(whole, hu) else hu.astype(np.float32)
    write_nifti(path, exact, lps_from_index, lps=True)
