"""The connected pieces of a label map, and tumors that a thin gap parts from their kidney."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int32, UInt8

from tumortrack.core.geometry import spacing_mm
from tumortrack.imaging.grid import bounding_box, components, voxel_ml

GAP_MM = 3.0  # annotators and resampling leave such gaps; a thicker slice counts as one voxel


@dataclass(frozen=True, eq=False)
class Pieces:
    """Connected pieces of organ and tumor voxels, numbered 1, 2, ... largest first; 0 outside.

    ``labels`` keep the map's own values; ``organ`` and ``tumors`` name those that count.
    """

    labels: UInt8[np.ndarray, "i j k"]
    numbers: Int32[np.ndarray, "i j k"]
    lps_from_index: Float[np.ndarray, "4 4"]
    organ: int
    tumors: tuple[int, ...]

    @cached_property
    def organ_ml(self) -> Float[np.ndarray, " n"]:
        """Organ volume by piece number (entry 0 is the outside's: 0)."""
        return self._ml((self.organ,))

    @cached_property
    def tumor_ml(self) -> Float[np.ndarray, " n"]:
        """Tumor volume by piece number."""
        return self._ml(self.tumors)

    @property
    def whole_ml(self) -> Float[np.ndarray, " n"]:
        """Volume by piece number."""
        return self.organ_ml + self.tumor_ml

    def _ml(self, values: tuple[int, ...]) -> Float[np.ndarray, " n"]:
        inside = self.numbers[np.isin(self.labels, values)]
        count = np.bincount(inside, minlength=int(self.numbers.max()) + 1)
        return count * voxel_ml(self.lps_from_index)


def find_pieces(
    labels: UInt8[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    organ: int,
    tumors: list[int],
) -> Pieces:
    """The pieces (26 neighbours) of the voxels labelled organ or tumor."""
    numbers, _ = components(np.isin(labels, [organ, *tumors]))
    return Pieces(labels, numbers, lps_from_index, organ, tuple(tumors))


def attach_tumors(
    pieces: Pieces, kidneys: list[int], min_tumor_ml: float
) -> tuple[Pieces, list[str], list[int]]:
    """Join every piece with a tumor of at least ``min_tumor_ml`` to a kidney within 3 mm.

    The gap (up to 3 mm, or one voxel where voxels are larger) is filled with organ, no wider
    than the two face each other, so that organ and tumor have one surface.

    Args:
        kidneys: the numbers of the pieces that are kidneys.

    Returns:
        The pieces with joined ones numbered as their kidney, notes, and the numbers of the
        pieces that lie farther off.
    """
    notes: list[str] = []
    apart: list[int] = []
    for number in range(1, len(pieces.tumor_ml)):
        ml = float(pieces.tumor_ml[number])
        if number in kidneys or ml == 0 or ml < min_tumor_ml:
            continue
        joined = _joined(pieces, kidneys, number)
        if joined is None:
            apart.append(number)
        else:
            pieces, gap_mm, bridge_ml = joined
            notes.append(
                f"a tumor of {ml:.2f} ml lies {gap_mm:.1f} mm off the kidney's labels: taken as "
                f"the kidney's, the gap filled with {bridge_ml:.2f} ml of organ"
            )
    return pieces, notes, apart


def _joined(pieces: Pieces, kidneys: list[int], number: int) -> tuple[Pieces, float, float] | None:
    """The pieces with one joined to its nearest kidney, the gap in mm and what fills it in ml."""
    from scipy import ndimage

    spacing = spacing_mm(pieces.lps_from_index)
    reach_mm = max(GAP_MM, float(spacing.max()))
    box = bounding_box(
        pieces.numbers == number, pieces.lps_from_index, reach_mm + 2 * float(spacing.max())
    )
    numbers = pieces.numbers[box]
    own, kidney = numbers == number, np.isin(numbers, kidneys)
    if not kidney.any():
        return None
    to_kidney, nearest = ndimage.distance_transform_edt(
        ~kidney, sampling=spacing, return_indices=True
    )
    here = np.unravel_index(np.where(own, to_kidney, np.inf).argmin(), own.shape)
    there = tuple(int(axis[here]) for axis in nearest)
    steps = np.abs(np.subtract(here, there))
    gap_mm = float(np.linalg.norm(np.maximum(steps - 1, 0) * spacing))  # between voxels' faces
    if gap_mm > reach_mm:
        return None
    to_own = ndimage.distance_transform_edt(~own, sampling=spacing)
    between = to_kidney + to_own <= float(to_kidney[here]) + float(np.median(spacing))
    bridge = between & (numbers == 0)
    joined, labels = pieces.numbers.copy(), pieces.labels.copy()
    joined[box][own | bridge] = numbers[there]
    labels[box][bridge] = pieces.organ
    ml = float(bridge.sum()) * voxel_ml(pieces.lps_from_index)
    return replace(pieces, labels=labels, numbers=joined), gap_mm, ml
