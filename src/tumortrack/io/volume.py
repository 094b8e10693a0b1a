"""Volumes from files: a DICOM folder, NIfTI or NRRD -> Volume or LabelVolume, LPS mm.

NRRD is read here (https://teem.sourceforge.net/nrrd/format.html), so that its header is checked
before it is trusted.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import grid
from tumortrack.core.errors import InputError, readable
from tumortrack.core.tables import read_table
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.io.dicom import read_dicom
from tumortrack.io.dicom_segmentation import read_segmentation
from tumortrack.io.nifti import read_nifti
from tumortrack.io.segments import Parts, painted

_VOLUMES = (".nii", ".nii.gz", ".nrrd")
MOST_LABELS = 32  # distinct values that still look like a label map
_SAME_MM = 0.01  # of the grids of several files
_OFF_WHOLE = 1e-3  # of labels that were stored with a scale, as 1.00000002
_MAX_HEADER = 2**20
_SEGMENT = re.compile(r"segment(\d+)_(id)?", re.IGNORECASE)
_IS_GZIP = {"raw": False, "gzip": True, "gz": True}
_NAMES = read_table("tumortrack.io", "nrrd_types.toml", dict[str, list[str]])
NRRD_TYPES = {name: dtype for dtype, names in _NAMES.items() for name in names}
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
    if not path.is_file() or path.stat().st_size == 0:
        raise InputError(f"{path} does not exist, is empty, or is a pipe or a device.")
    if name.endswith((".dcm", ".ima")) or is_dicom(path):
        return read_segmentation(path) or read_dicom(path, series)
    if name.endswith((".nii", ".nii.gz")):
        return read_nifti(path)
    if name.endswith(".nrrd"):
        return _read_nrrd(path)
    if name.endswith((".nhdr", ".hdr", ".img")):
        raise InputError(f"{path}: its voxels lie in another file. Export one .nrrd or .nii.gz.")
    grid.check_suffix(path)
    raise InputError(f"{path} is no volume. Allowed: DICOM slices, .nii, .nii.gz, .nrrd.")


def is_dicom(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(132)[128:] == b"DICM"


def stem(path: Path) -> str:
    """A volume's name without its suffixes."""
    return re.sub(r"(\.seg)?\.(nii|nii\.gz|nrrd)$", "", path.name, flags=re.IGNORECASE)


def is_volume(path: Path) -> bool:
    """Whether a file's name says that it is one, other than of DICOM."""
    return path.name.lower().endswith(_VOLUMES)


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
    if not max(-low, high) <= 100_000:  # nor NaN
        raise InputError(
            f"{path} has values from {low:g} to {high:g}, which are no Hounsfield units."
        )
    return Volume(hu, raw.lps_from_index)


def labels_of(raw: grid.RawVolume, path: Path) -> LabelVolume:
    """Raw voxels as labels. Raises InputError: not whole numbers in 0..255, of any type."""
    if (labels := _whole(raw.array)) is None:
        low, high = raw.array.min(), raw.array.max()
        fault = f"values from {low:g} to {high:g}, or fractions"
        raise InputError(f"{path} is no label map ({fault}): whole numbers of 0..255 are needed.")
    return LabelVolume(labels, raw.lps_from_index)


def _whole(array: np.ndarray) -> UInt8[np.ndarray, "i j k"] | None:
    """Numbers as labels, to which they must be as close as rounding leaves them; None: they are
    not."""
    if array.dtype == np.uint8:
        return array
    if not (array.min() >= -_OFF_WHOLE and array.max() <= 255 + _OFF_WHOLE):
        return None
    if array.dtype.kind != "f":
        return array.astype(np.uint8)
    labels = np.rint(array).astype(np.uint8)
    return labels if np.allclose(labels, array, rtol=0, atol=_OFF_WHOLE) else None


def label_map(raw: grid.RawVolume, parts: Parts, path: Path) -> LabelVolume:
    """One label map, in which all of the organ has one number. Raises InputError: see
    ``labels_of``, which names ``path``; a segment is lost in the organ, and nobody named it."""
    if raw.segments:
        structures = (n for n in parts.structures.values() if isinstance(n, int))
        used = *structures, *(parts.tumors or ())
        labels, lost = painted(raw.array.shape, raw.segments, parts.organ, used)
        if lost and not parts.stated:
            n, name = lost[0], parts.names[lost[0]]
            raise InputError(
                f"{path}: {n} {name} lies in the organ. Give --tumor {n} with the other tumors, "
                f"--organ {n} as well if it is part of the organ, or --tumor 0."
            )
        return LabelVolume(labels, raw.lps_from_index)
    volume, (first, *others) = labels_of(raw, path), parts.organ
    same = np.arange(256, dtype=np.uint8)
    same[others] = first
    return LabelVolume(same[volume.labels], volume.lps_from_index) if others else volume


def read_files(paths: list[Path], files: list[Path], series: str | None) -> grid.RawVolume:
    """One volume, or several label files, of ``paths`` that hold the ``files``. Raises InputError:
    see ``read_raw`` and ``read_several``."""
    if len(paths) > 1:
        return read_several(files)
    volumes, others = [f for f in files if is_volume(f)], [f for f in files if not is_volume(f)]
    if not (paths[0].is_dir() and volumes) or any(map(is_dicom, others)):
        return read_raw(paths[0], series)
    raw, names = read_several(volumes), ", ".join(file.name for file in others[:5])
    return replace(raw, notes=(f"no label files, left out: {names}",)) if others else raw


def read_several(files: Sequence[Path]) -> grid.RawVolume:
    """Label files with one structure each, numbered in their order and named as the files. Raises
    InputError: several labels in one, different grids."""
    if len(files) > 255:
        raise InputError(f"{len(files)} label files were given; at most 255 are read at once.")
    first = read_raw(files[0])

    def mask(file: Path) -> np.ndarray:
        raw = read_raw(file)
        labels = labels_of(raw, file).labels
        if not same_grid(raw, first):
            raise InputError(f"{file} has another grid than {files[0]}. Export both on the same.")
        if len(found := np.unique(labels)) > 2 or found[0] != 0:
            raise InputError(f"{file} has labels {found[:9].tolist()}. Give a label map alone.")
        return labels > 0

    segments = tuple(
        grid.Segment(n, stem(file), partial(mask, file)) for n, file in enumerate(files, 1)
    )
    return grid.RawVolume(first.array, first.lps_from_index, segments=segments)


def same_grid(a: grid.RawVolume, b: grid.RawVolume) -> bool:
    return a.array.shape == b.array.shape and np.allclose(
        a.lps_from_index, b.lps_from_index, atol=_SAME_MM
    )


def is_label_map(raw: grid.RawVolume, most: int = MOST_LABELS) -> bool:
    """Whether there are only whole numbers in 0..255, at most so many different ones: few CTs have
    256, none 32."""
    labels = _whole(raw.array)
    return labels is not None and int((grid.label_counts(labels) > 0).sum()) <= most


def _read_nrrd(path: Path) -> grid.RawVolume:
    """Read an attached .nrrd (raw or gzip) with a stated patient space."""
    fields, _, start = nrrd_header(path)
    encoding = fields.get("encoding", "raw").lower()
    if (compressed := _IS_GZIP.get(encoding)) is None:
        raise InputError(f"{path}: encoding {encoding!r} is not read. Export as raw or gzip.")
    with readable(path, "has a NRRD header that is damaged or lacks a field"):
        layers, shape = 1, tuple(int(n) for n in fields["sizes"].split())
        if len(shape) == 4 and "segment0_id" in fields:  # the first axis holds layers
            layers, shape = shape[0], shape[1:]
        dtype = np.dtype(NRRD_TYPES[fields["type"].lower()])
        lps_from_index = _lps_from_index(path, fields) if len(shape) == 3 else np.eye(4)
    grid.check_size(path, shape, layers * dtype.itemsize, compressed)
    grid.check_affine(path, lps_from_index)
    if fields.get("dimension") != str(len(fields["sizes"].split())):
        raise InputError(f"{path}: dimension {fields.get('dimension')} is not that of its sizes.")
    if dtype.itemsize > 1:
        if fields.get("endian", "").lower() not in ("little", "big"):
            raise InputError(f"{path}: the NRRD header states no byte order. Export it again.")
        dtype = dtype.newbyteorder("<" if fields["endian"].lower() == "little" else ">")
    with grid.volume_stream(path, compressed, start) as stream:
        array = grid.read_voxels(path, stream, (layers, *shape), dtype, compressed)
    segments = _segments(path, fields, array)
    array = painted(shape, segments)[0] if layers > 1 else array[0]
    return grid.RawVolume(array, lps_from_index, segments=segments)


def _segments(path: Path, fields: dict[str, str], layers: np.ndarray) -> tuple[grid.Segment, ...]:
    """Of a .seg.nrrd; numbered by their label values, where these differ, else in their order.
    Raises InputError: two are the same label of the same layer, or a label is no segment's."""
    found: dict[tuple[int, int], str] = {}
    matches = (_SEGMENT.fullmatch(field) for field in fields)
    for n in sorted(int(match[1]) for match in matches if match):
        value, layer, name = (
            fields.get(f"segment{n}_{key}", default)
            for key, default in (("labelvalue", "1"), ("layer", str(n)), ("name", ""))
        )
        with readable(path, f"has no label {value!r} of layer {layer!r}, its segment {n}"):
            place = int(layer) if len(layers) > 1 else 0, int(value)
            layers[place[0]]
        if place in found:
            both = f"{found[place]!r} and {name!r} are both label {value} of one layer"
            raise InputError(f"{path}: its segments {both}. Export it again.")
        found[place] = name or fields[f"segment{n}_id"]
    for at, array in enumerate(layers if found else ()):
        known = [0, *(number for own_layer, number in found if own_layer == at)]
        if others := np.setdiff1d(array, known).tolist():
            raise InputError(f"{path} has voxels of label {others[0]:g}, which no segment has.")
    values = [value for _, value in found]
    if len(found) > 255:
        raise InputError(f"{path} has {len(found)} segments; at most 255 are read.")
    own = len(set(values)) == len(values) and all(0 < value < 256 for value in values)
    return tuple(
        grid.Segment(value if own else n, name, partial(np.equal, layers[layer], value))
        for n, ((layer, value), name) in enumerate(found.items(), 1)
    )


def nrrd_header(
    path: Path, most_bytes: int = _MAX_HEADER
) -> tuple[dict[str, str], dict[str, str], int]:
    """The fields up to the empty line, their names in lower case; keys with their values, those of
    segments among the fields as well; and the byte where the voxels start."""
    with path.open("rb") as stream:
        head = stream.read(most_bytes)
    if not head.startswith(b"NRRD000"):
        raise InputError(f"{path} is not a NRRD file. Export it again.")
    gap = re.search(rb"\r?\n\r?\n", head)
    lines = head[: gap.start() if gap else None].decode("latin-1").replace("\r\n", "\n").split("\n")
    fields, keys = dict[str, str](), dict[str, str]()
    for line in (line for line in lines[1:] if not line.startswith("#")):
        name, _, value = line.partition(":")
        if ":=" in line:
            name, _, value = line.partition(":=")
            keys[name.strip()] = value.strip()
        if ":=" not in line or _SEGMENT.match(line):
            fields[name.strip().lower()] = value.strip()
    if gap is None or "data file" in fields or "datafile" in fields:
        raise InputError(f"{path}: its voxels lie in another file. Export one attached .nrrd file.")
    if any(fields.get(name, "0") != "0" for name in ("line skip", "byte skip", "lineskip")):
        raise InputError(f"{path}: skipped lines or bytes are not read. Export it again.")
    return fields, keys, gap.end()


def _lps_from_index(path: Path, fields: dict[str, str]) -> np.ndarray:
    sign = _LPS_FROM_SPACE.get(fields.get("space", "").lower())
    if sign is None or "space directions" not in fields:
        raise InputError(
            f"{path} states no patient orientation (space {fields.get('space')!r}). Export it with "
            "space left-posterior-superior or RAS."
        )
    units = fields.get("space units", "").replace('"', " ").split()
    if any(unit.lower() not in ("mm", "millimeter", "millimetre") for unit in units):
        raise InputError(f"{path} states its units as {units}; millimetres are needed.")
    directions = fields["space directions"].replace("none", "")  # of the axis of layers
    columns = [_vector(part) for part in directions.split(")") if part.strip()]
    lps_from_index = np.eye(4)
    lps_from_index[:3, :3] = np.array(columns).T
    lps_from_index[:3, 3] = _vector(fields.get("space origin", "(0,0,0)").rstrip(") "))
    return np.diag([*sign, 1.0]) @ lps_from_index


def _vector(text: str) -> list[float]:
    numbers = [float(part) for part in text.strip().lstrip("(").split(",")]
    if len(numbers) != 3:
        raise ValueError(f"{text!r} is no 3-vector")
    return numbers
