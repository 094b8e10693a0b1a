"""Volumes from files: a DICOM folder, NIfTI or NRRD -> Volume or LabelVolume, LPS mm.

NRRD is read here (https://teem.sourceforge.net/nrrd/format.html), so that its header is checked
before it is trusted.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.tables import read_table
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.imaging import grid
from tumortrack.imaging.dicom import read_dicom
from tumortrack.imaging.nifti import read_nifti

_DETACHED = (".nhdr", ".mhd", ".hdr", ".img")
_MOST_LABELS = 32  # distinct values that still look like a label map
_MAX_HEADER = 2**20
_IS_GZIP = {"raw": False, "gzip": True, "gz": True}
_NAMES = read_table("tumortrack.imaging", "nrrd_types.toml", dict[str, list[str]])
_TYPES = {name: dtype for dtype, names in _NAMES.items() for name in names}
_LPS_FROM_SPACE = {
    **dict.fromkeys(("lps", "left-posterior-superior"), (1.0, 1.0, 1.0)),
    **dict.fromkeys(("ras", "right-anterior-superior"), (-1.0, -1.0, 1.0)),
    **dict.fromkeys(("las", "left-anterior-superior"), (1.0, -1.0, 1.0)),
}


def read_raw(path: Path, series: str | None = None) -> grid.RawVolume:
    """Read any supported volume in its stored number type; of several DICOM series, ``series`` is
    the wanted one's UID or number. Raises InputError: missing, unknown type, detached, damaged, not
    a plausible patient volume."""
    name = path.name.lower()
    if path.is_dir():
        return read_dicom(path, series)
    if not path.is_file():
        raise InputError(f"{path} does not exist or is no file (but a pipe or a device).")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes).")
    if name.endswith((".nii", ".nii.gz")):
        return read_nifti(path)
    if name.endswith(".nrrd"):
        return _read_nrrd(path)
    if name.endswith(_DETACHED):
        raise InputError(
            f"{path} is a header whose voxels lie in another file; detached data are refused. "
            "Export one .nrrd, .nii or .nii.gz file."
        )
    raise InputError(
        f"{path} is no volume. Allowed: a folder of DICOM slices, .nii, .nii.gz, .nrrd."
    )


def read_volume(path: Path, series: str | None = None) -> Volume:
    """Read a CT volume (HU); errors as ``read_raw`` and ``volume_of``."""
    return volume_of(read_raw(path, series), path)


def read_labels(path: Path) -> LabelVolume:
    """Read a label map; errors as ``read_raw`` and ``labels_of``."""
    return labels_of(read_raw(path), path)


def volume_of(raw: grid.RawVolume, path: Path) -> Volume:
    """Raw voxels as a CT. Raises InputError, which names ``path``: not plausibly HU."""
    hu = raw.array.astype(np.float32, copy=False)
    low, high = float(hu.min()), float(hu.max())
    if not (np.isfinite(low) and np.isfinite(high)):
        raise InputError(f"{path} has NaN or infinite voxels. Export it again without them.")
    if max(-low, high) > 100_000:
        raise InputError(
            f"{path} has values from {low:g} to {high:g}; Hounsfield units are needed."
        )
    return Volume(hu, raw.lps_from_index)


def labels_of(raw: grid.RawVolume, path: Path) -> LabelVolume:
    """Raw voxels as labels. Raises InputError: not whole numbers in 0..255, of any type."""
    low, high = float(raw.array.min()), float(raw.array.max())
    if not (low >= 0 and high <= 255):
        raise InputError(
            f"{path} is no label map: values from {low:g} to {high:g}; whole numbers from 0 to "
            "255 are allowed."
        )
    labels = raw.array.astype(np.uint8)
    if raw.array.dtype.kind == "f" and not np.array_equal(labels, raw.array):
        raise InputError(f"{path} is no label map: it has fractions. Whole numbers are needed.")
    return LabelVolume(labels, raw.lps_from_index)


def is_label_map(raw: grid.RawVolume) -> bool:
    """Whether there are only whole numbers in 0..255, at most 32 different ones: no CT is so."""
    if not (raw.array.min() >= 0 and raw.array.max() <= 255):
        return False
    labels = raw.array.astype(np.uint8)
    different = np.count_nonzero(grid.label_counts(labels))
    return bool(different <= _MOST_LABELS and np.array_equal(labels, raw.array))


def _read_nrrd(path: Path) -> grid.RawVolume:
    """Read an attached .nrrd (raw or gzip) with a stated patient space."""
    fields, start = _header(path)
    encoding = fields.get("encoding", "raw").lower()
    if encoding not in _IS_GZIP:
        raise InputError(f"{path}: encoding {encoding!r} is not read. Export as raw or gzip.")
    try:
        shape = tuple(int(n) for n in fields["sizes"].split())
        dtype = np.dtype(_TYPES[fields["type"].lower()])
        lps_from_index = _lps_from_index(path, fields) if len(shape) == 3 else np.eye(4)
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: the NRRD header is damaged or lacks a field ({error}). Export it again."
        ) from error
    grid.check_size(path, shape, dtype.itemsize, _IS_GZIP[encoding])
    grid.check_affine(path, lps_from_index)
    if fields.get("dimension") != "3":
        raise InputError(f"{path}: dimension {fields.get('dimension')} is not that of its sizes.")
    if dtype.itemsize > 1:
        if fields.get("endian", "").lower() not in ("little", "big"):
            raise InputError(f"{path}: the NRRD header states no byte order. Export it again.")
        dtype = dtype.newbyteorder("<" if fields["endian"].lower() == "little" else ">")
    compressed = _IS_GZIP[encoding]
    with grid.volume_stream(path, compressed, start) as stream:
        array = grid.read_voxels(path, stream, shape, dtype, compressed)
    return grid.RawVolume(array, lps_from_index)


def _header(path: Path) -> tuple[dict[str, str], int]:
    """The fields up to the empty line, and the byte where the voxels start."""
    with path.open("rb") as stream:
        head = stream.read(_MAX_HEADER)
    if not head.startswith(b"NRRD000"):
        raise InputError(f"{path} is not a NRRD file. Export it again.")
    gap = re.search(rb"\r?\n\r?\n", head)
    lines = head[: gap.start() if gap else None].decode("latin-1").replace("\r\n", "\n").split("\n")
    fields: dict[str, str] = {}
    for line in lines[1:]:
        if not line.startswith("#") and ":=" not in line:
            name, _, value = line.partition(":")
            fields[name.strip().lower()] = value.strip()
    if gap is None or "data file" in fields or "datafile" in fields:
        raise InputError(f"{path}: its voxels lie in another file. Export one attached .nrrd file.")
    if any(fields.get(name, "0") != "0" for name in ("line skip", "byte skip", "lineskip")):
        raise InputError(f"{path}: skipped lines or bytes are not read. Export it again.")
    return fields, gap.end()


def _lps_from_index(path: Path, fields: dict[str, str]) -> np.ndarray:
    sign = _LPS_FROM_SPACE.get(fields.get("space", "").lower())
    if sign is None or "space directions" not in fields:
        raise InputError(
            f"{path} states no patient orientation (space {fields.get('space')!r}), so left and "
            "right are unknown. Export it with space left-posterior-superior or RAS."
        )
    units = fields.get("space units", "").replace('"', " ").split()
    if any(unit.lower() not in ("mm", "millimeter", "millimetre") for unit in units):
        raise InputError(f"{path} states its units as {units}; millimetres are needed.")
    columns = [_vector(part) for part in fields["space directions"].split(")") if part.strip()]
    lps_from_index = np.eye(4)
    lps_from_index[:3, :3] = np.array(columns).T
    lps_from_index[:3, 3] = _vector(fields.get("space origin", "(0,0,0)").rstrip(") "))
    return np.diag([*sign, 1.0]) @ lps_from_index


def _vector(text: str) -> list[float]:
    numbers = [float(part) for part in text.strip().lstrip("(").split(",")]
    if len(numbers) != 3:
        raise ValueError(f"{text!r} is no 3-vector")
    return numbers
