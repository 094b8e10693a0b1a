"""A binary DICOM segmentation (PS3.3 A.51) as segments, by pydicom."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import InputError, readable
from tumortrack.core.grid import RawVolume, Segment, check_affine, check_size
from tumortrack.io.dicom import frame_groups, is_segmentation, plane_of
from tumortrack.io.segments import painted

_OFF_STEP = 0.05  # of a slice: rounding of positions
_NO_ENDS = (
    "a DICOM segmentation does not say whether the CT ended at its first and last slice: give --ct"
)


def read_segmentation(path: Path) -> RawVolume | None:
    """The segments of a file, with an empty slice at either end; None: it is no segmentation.
    Slices that hold nothing are usually left out, so a note says that where the image ended is
    unknown. Raises InputError: damaged, fractional, slices without a common step."""
    if not is_segmentation(path):
        return None
    import pydicom

    with readable(path, "is cut short or damaged"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _read(path, pydicom.dcmread(path))


def _read(path: Path, tags: Any) -> RawVolume:
    if tags.SegmentationType != "BINARY":
        raise InputError(f"{path}: its segments are {tags.SegmentationType}; BINARY is read.")
    groups = list(frame_groups(tags, int(tags.NumberOfFrames)))
    planes = [plane_of(group) for group in groups]
    positions, normal = np.array([plane.position_mm for plane in planes]), planes[0].normal
    along = positions @ normal
    gaps = np.diff(np.unique(np.round(along, 3)))
    step = float(gaps.min() if len(gaps) else groups[0]("PixelMeasuresSequence").SliceThickness)
    slices = (along - along.min()) / step
    first, last = positions[along.argmin()], positions[along.argmax()]
    between = (last - first) / max(round(float(slices.max())), 1) if len(gaps) else normal * step
    off_line = np.linalg.norm(positions - first - np.outer(np.rint(slices), between), axis=1)
    if max(np.abs(slices - np.rint(slices)).max(), off_line.max() / step) > _OFF_STEP:
        raise InputError(f"{path}: its slices have no common step. Export it again, or as NIfTI.")
    index = np.rint(slices).astype(int) + 1
    lps_from_index = planes[0]._replace(position_mm=first - between).lps_from_index(between)
    shape = int(tags.Columns), int(tags.Rows), int(index.max()) + 2
    names = {int(s.SegmentNumber): str(s.SegmentLabel) for s in tags.SegmentSequence}
    numbers = [int(g("SegmentIdentificationSequence").ReferencedSegmentNumber) for g in groups]
    if len(names) < len(tags.SegmentSequence) or not set(numbers) <= set(names) <= set(range(256)):
        raise InputError(f"{path}: its segments' numbers are damaged. Export it again.")
    check_size(path, shape, 1, True)
    check_affine(path, lps_from_index)
    frames = tags.pixel_array.reshape(len(groups), *shape[1::-1])

    def mask(number: int) -> np.ndarray:
        out = np.zeros(shape, bool)
        for frame, k, of in zip(frames, index.tolist(), numbers, strict=True):
            if of == number:
                out[..., k] |= frame.T > 0
        return out

    segments = tuple(Segment(n, name, partial(mask, n)) for n, name in names.items())
    return RawVolume(painted(shape, segments)[0], lps_from_index, (_NO_ENDS,), segments=segments)
