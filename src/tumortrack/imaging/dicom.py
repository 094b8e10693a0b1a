"""A DICOM series as a volume: pydicom for the tags, GDCM (in SimpleITK) for the pixels.

Slices are sorted by their position along the slice normal, and every gap is checked here:
readers only warn of a missing slice and stretch the patient.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError
from tumortrack.imaging.grid import RawVolume, check_affine, check_size

MIN_SLICES = 10
_MAX_FILES = 20_000
_NO_SLICE, _MULTI_FRAME = "no DICOM slices", "multi-frame DICOM objects"
_TAGS = [
    "SeriesInstanceUID", "SeriesDescription", "Modality", "ImageType", "Rows", "Columns",
    "NumberOfFrames", "PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient",
    "SamplesPerPixel",
]  # fmt: skip


@dataclass(frozen=True)
class _Slice:
    path: Path
    uid: str
    description: str
    modality: str
    shape: tuple[int, int]  # rows, columns
    spacing_mm: tuple[float, float]  # between rows, between columns
    position_mm: tuple[float, ...]  # LPS, first pixel
    orientation: tuple[float, ...]  # along a row, along a column

    @property
    def group(self) -> tuple[Any, ...]:
        return (self.uid, self.shape, tuple(round(c, 3) for c in self.orientation))


@dataclass(frozen=True, eq=False)
class Series:
    """The slices of one series, in order along the slice normal, and how they lie.

    ``shape``: columns, rows, slices; ``lps_from_index``: (column, row, slice) -> LPS mm.
    """

    files: tuple[Path, ...]
    shape: tuple[int, int, int]
    lps_from_index: Float[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()


def find_series(folder: Path, series: str | None = None) -> Series:
    """Find one CT series of a folder (sub-folders not searched); its pixels are not read.

    The rule among several: the only one with modality CT and at least 10 slices of one size and
    orientation. Otherwise ``series`` must name one: its UID or its number in the error's list.

    Raises:
        InputError: no series, several, a missing, double or stray slice.
    """
    groups, notes = _groups(folder)
    slices = _choose(folder, groups, series)
    first = slices[0]
    row, column = np.reshape(first.orientation, (2, 3))
    normal = np.cross(row, column)
    if not 0.99 < np.linalg.norm(normal) < 1.01:
        raise InputError(f"{first.path}: ImageOrientationPatient is not two unit directions.")
    slices = sorted(slices, key=lambda s: float(np.dot(s.position_mm, normal)))
    step = _slice_step(slices, normal)
    lps_from_index = np.eye(4)
    # Pixel spacing is (between rows, between columns); index i runs along a row.
    lps_from_index[:3, 0] = row * slices[0].spacing_mm[1]
    lps_from_index[:3, 1] = column * slices[0].spacing_mm[0]
    lps_from_index[:3, 2] = step
    lps_from_index[:3, 3] = slices[0].position_mm
    shape = (first.shape[1], first.shape[0], len(slices))
    check_size(folder, shape, 4)
    check_affine(folder, lps_from_index)
    files = tuple(s.path for s in slices)
    return Series(files, shape, lps_from_index, notes + _other_series(groups, slices))


def read_dicom(folder: Path, series: str | None = None) -> RawVolume:
    """Read one CT series of a folder, chosen as by ``find_series``.

    Raises:
        InputError: see ``find_series``; damaged pixels.
    """
    found = find_series(folder, series)
    pixels = _pixels(folder, list(found.files), found.shape)
    return RawVolume(pixels, found.lps_from_index, found.notes)


def _groups(folder: Path) -> tuple[list[list[_Slice]], tuple[str, ...]]:
    """Slices by series, size and orientation, in a fixed order; and notes on other files.

    Raises:
        InputError: too many files, or no slice at all.
    """
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    if len(files) > _MAX_FILES:
        raise InputError(f"{folder} holds {len(files)} files; the limit is {_MAX_FILES}.")
    found: dict[tuple[Any, ...], list[_Slice]] = {}
    left_out: dict[str, list[Path]] = {_NO_SLICE: [], _MULTI_FRAME: []}
    for file in files:
        one = _read_tags(file)
        if isinstance(one, _Slice):
            found.setdefault(one.group, []).append(one)
        else:
            left_out[one].append(file)
    if not found and (multi_frame := left_out[_MULTI_FRAME]):
        raise InputError(
            f"{multi_frame[0]} is a multi-frame DICOM object; export classic slices, one file "
            "each, or NIfTI."
        )
    if not found:
        raise InputError(
            f"{folder} holds no DICOM image with a position. Give the folder that holds the CT's "
            "slices themselves."
        )
    groups = [found[key] for key in sorted(found, key=lambda key: (-len(found[key]), repr(key)))]
    notes = tuple(
        f"{len(paths)} files are {what}: left out ({', '.join(p.name for p in paths[:3])}"
        + (", ...)" if len(paths) > 3 else ")")
        for what, paths in left_out.items()
        if paths
    )
    return groups, notes


def _other_series(groups: list[list[_Slice]], chosen: list[_Slice]) -> tuple[str, ...]:
    """A note on the images that were not taken: a damaged slice may be among them."""
    n_slices = sum(map(len, groups)) - len(chosen)
    if not n_slices:
        return ()
    return (f"{n_slices} images of other series, sizes or orientations left out",)


def _read_tags(path: Path) -> _Slice | str:
    """The tags of one slice, or why the file is none (``_NO_SLICE``, ``_MULTI_FRAME``)."""
    import pydicom

    try:
        with warnings.catch_warnings():  # a damaged header gets our own errors
            warnings.simplefilter("ignore")
            tags = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=_TAGS)
            if int(tags.get("NumberOfFrames") or 1) > 1:
                return _MULTI_FRAME
            return _Slice(
                path=path,
                uid=_printable(tags.get("SeriesInstanceUID")),
                description=_printable(tags.get("SeriesDescription")),
                modality=_printable(tags.get("Modality")),
                shape=(int(tags.Rows), int(tags.Columns)),
                spacing_mm=(float(tags.PixelSpacing[0]), float(tags.PixelSpacing[1])),
                position_mm=tuple(float(x) for x in tags.ImagePositionPatient),
                orientation=tuple(float(x) for x in tags.ImageOrientationPatient),
            )
    except Exception:  # pydicom raises anything on a foreign or damaged file: it is no slice
        return _NO_SLICE


def _printable(value: object) -> str:
    """A tag's text, safe to print on a terminal."""
    return "".join(c if c.isprintable() else "?" for c in str(value or ""))


def _choose(folder: Path, groups: list[list[_Slice]], series: str | None) -> list[_Slice]:
    if series is not None:
        fitting = [g for n, g in enumerate(groups, 1) if series in (g[0].uid, str(n))]
    else:
        fitting = [g for g in groups if g[0].modality == "CT" and len(g) >= MIN_SLICES]
    if len(fitting) == 1:
        return fitting[0]
    listing = "\n".join(
        f"  {n}: {g[0].uid or '(no UID)'}, {g[0].description or '(no description)'}, "
        f"{g[0].modality}, {len(g)} slices of {g[0].shape[1]} x {g[0].shape[0]}"
        for n, g in enumerate(groups, 1)
    )
    what = (
        f"{len(fitting)} of them fit {series!r}"
        if series is not None
        else f"{len(fitting)} of them are CT with at least {MIN_SLICES} slices"
    )
    raise InputError(
        f"{folder} holds these series and {what}; give --series with a UID or number:\n{listing}"
    )


def _slice_step(slices: list[_Slice], normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The vector from one slice to the next, after checking that all slices follow it."""
    if len({s.spacing_mm for s in slices}) > 1:
        raise InputError(f"{slices[0].path.parent}: its slices differ in pixel spacing.")
    if len(slices) < 2:
        raise InputError(f"{slices[0].path.parent}: one slice is no volume.")
    positions = np.array([s.position_mm for s in slices])
    along = positions @ normal
    gaps = np.diff(along)
    usual = float(np.median(gaps))
    for n in np.flatnonzero(np.abs(gaps - usual) > max(0.02, 0.05 * abs(usual))):
        kind = (
            "two slices lie at"
            if gaps[n] < 0.5 * usual or usual < 0.01
            else "a slice is missing after"
        )
        raise InputError(
            f"{slices[n].path.parent}: {kind} position {along[n]:.2f} mm ({slices[n].path.name} to "
            f"{slices[n + 1].path.name}: {gaps[n]:.2f} mm, usually {usual:.2f} mm). Export the "
            "whole series again, each slice once."
        )
    step = (positions[-1] - positions[0]) / (len(slices) - 1)
    stray = np.linalg.norm(
        positions - positions[0] - np.arange(len(slices))[:, None] * step, axis=1
    )
    if stray.max() > max(0.1, 0.1 * abs(usual)):
        raise InputError(
            f"{slices[int(stray.argmax())].path}: this slice lies {stray.max():.2f} mm off the "
            "line through the others. Export one continuous series."
        )
    return step


def _pixels(folder: Path, files: list[Path], shape: tuple[int, int, int]) -> np.ndarray:
    """Rescaled values (HU), float32, axes (column, row, slice)."""
    import SimpleITK as sitk  # noqa: N813

    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(f) for f in files])
    reader.SetOutputPixelType(sitk.sitkFloat32)
    try:
        array = sitk.GetArrayFromImage(reader.Execute()).transpose(2, 1, 0)
    except RuntimeError as error:
        last = str(error).strip().splitlines()[-1]
        raise InputError(f"{folder}: the slices' pixels cannot be decoded: {last}.") from error
    if array.shape != shape:
        raise InputError(f"{folder}: the pixels are {array.shape}, the tags say {shape}.")
    return array
