"""Select one organ and its tumors from a label map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from scipy import ndimage

from tumortrack.case.options import MIN_TUMOR_ML
from tumortrack.core import grid
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import spacing_mm
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.patient import UNKNOWN, Side
from tumortrack.core.report import Finding, Note
from tumortrack.core.types import FIRST_TUMOR, ORGAN, LabelVolume

_GAP_MM = 3.0  # annotators and resampling leave such gaps; of thicker slices one voxel counts
_MIN_ML, _MAX_ML = 10.0, 4000.0  # a small prostate; a large liver
_MIDLINE_MARGIN_MM = 20.0
_PAIR_APART_MM = 60.0  # between centres, left to right: kidneys have over 100, a split organ less
_MOST_TUMORS = 254
_MOST_OF_BORDER = 1 / 3  # of the map's outermost voxels; an organ cut in half covers a quarter
_SPECK_ML = 0.5  # a larger piece that is dropped weakens the case
_MOST_RUGGED = 60.0  # area of all labels' borders over volume^(2/3); a voxelised ball has 7


class _Pieces:
    """Connected pieces of organ and tumor voxels, ``numbers`` 1, 2, ... largest first, 0 outside;
    and volumes by number."""

    def __init__(
        self, labels: np.ndarray, affine: np.ndarray, organ: int, tumors: tuple[int, ...]
    ) -> None:
        self.labels, self.affine, self.organ, self.tumors = labels.copy(), affine, organ, tumors
        self.numbers, _ = grid.components(among(labels, (organ, *tumors)))
        self.measure()

    def measure(self) -> None:
        voxel_ml, size = grid.voxel_ml(self.affine), int(self.numbers.max()) + 1
        self.organ_ml, self.tumor_ml = (
            np.bincount(self.numbers[among(self.labels, values)], minlength=size) * voxel_ml
            for values in ((self.organ,), self.tumors)
        )
        self.whole_ml = self.organ_ml + self.tumor_ml

    def with_tumor(self, min_tumor_ml: float) -> list[int]:
        return np.flatnonzero((self.tumor_ml > 0) & (self.tumor_ml >= min_tumor_ml)).tolist()

    def x_mm(self, number: int) -> float:
        """x of a piece's centre, LPS: increases towards the patient's left."""
        return float((self.affine @ [*np.argwhere(self.numbers == number).mean(0), 1])[0])


def select_labels(
    label_volume: LabelVolume,
    side: Side = UNKNOWN,
    organ: int = ORGAN,
    tumors: tuple[int, ...] | None = None,
    min_tumor_ml: float = MIN_TUMOR_ML,
    organ_kind: Organ = KIDNEY,
) -> tuple[LabelVolume, list[Note], Side]:
    """Keep one organ (label 1) and its tumors (2, 3, ...), cropped with a margin.

    An organ is a large connected piece of organ and tumor voxels. A tumor within 3 mm of an organ
    belongs to it; one farther away is left out with a note; other pieces are dropped as specks.
    A tumor is a piece of one label of ``tumors`` (None: all others from 2 up) inside that organ;
    those below ``min_tumor_ml`` become organ. Tumor labels keep their order; pieces of one label
    are ordered by size. Of a pair the patient's ``side`` is taken; unknown: with the most tumor.

    Returns the labels, notes on what was dropped or renumbered, and the organ's side: measured in a
    map with both organs of a pair, else as given. Raises InputError: no organ, no such tumor label,
    two organs of a pair without tumor and no ``side``, the only tumor lies apart from every organ.
    """
    labels, affine = label_volume.labels, label_volume.lps_from_index
    present = (np.flatnonzero(grid.label_counts(labels)[1:]) + 1).tolist()
    tumors = _tumor_labels(present, organ, tumors)
    middle = affine @ [*(np.array(labels.shape) / 2), 1]
    counted = among(labels, (organ, *tumors))
    _check_border(counted)
    box = grid.bounding_box(counted, affine, 2.0)
    affine = grid.moved_origin(affine, box)
    pieces = _Pieces(labels[box], affine, organ, tumors)
    organs = _large_pieces(pieces)
    notes, apart = _attach_tumors(pieces, organs, min_tumor_ml)
    notes += _left_out(pieces, organs, apart, min_tumor_ml)
    chosen, note, side = _choose(pieces, organs, side, float(middle[0]), organ_kind)
    notes += [note] if note else []
    for n in set(organs) - {chosen}:
        if not (organ_kind.in_pairs and abs(pieces.x_mm(n) - pieces.x_mm(chosen)) > _PAIR_APART_MM):
            ml = float(pieces.whole_ml[n])
            notes.append(Finding("dropped", {"what": organ_kind.words, "ml": ml}))
    if not _MIN_ML <= (ml := pieces.whole_ml[chosen]) <= _MAX_ML:
        raise InputError(
            f"label {organ} and its tumors fill {ml:.1f} ml; an organ has "
            f"{_MIN_ML:g} to {_MAX_ML:g} ml. Check --organ, --tumor and the spacing."
        )
    inside = pieces.numbers == chosen
    box = grid.bounding_box(inside, affine, 2.0)
    kept = np.where(inside, pieces.labels, 0)[box].astype(np.uint8)
    _check_ruggedness(kept, affine)
    out, more = _number_tumors(kept, tumors, grid.voxel_ml(affine), min_tumor_ml)
    return grid.cropped(out, grid.moved_origin(affine, box)), notes + more, side


def among(labels: np.ndarray, values: Sequence[int]) -> np.ndarray:
    """``np.isin``, ten times as fast for few values."""
    mask = np.zeros_like(labels, bool)
    for value in values:
        mask |= labels == value
    return mask


def _check_border(counted: np.ndarray) -> None:
    """Refuse a map with much of its border labelled, which cuts off the organ's surface."""
    inner = counted[1:-1, 1:-1, 1:-1]
    border = np.count_nonzero(counted) - np.count_nonzero(inner)
    share = border / max(counted.size - inner.size, 1)
    if share > _MOST_OF_BORDER:
        raise InputError(f"{share:.0%} of the map's border is labelled. Give it a wider margin.")


def _check_ruggedness(labels: np.ndarray, affine: np.ndarray) -> None:
    """Refuse noise, as meshing it would take minutes."""
    borders = [np.count_nonzero(np.diff(labels, axis=axis)) for axis in range(3)]
    area_mm2 = borders @ grid.face_areas_mm2(affine)
    volume_mm3 = 1000 * np.count_nonzero(labels) * grid.voxel_ml(affine)
    if area_mm2 > _MOST_RUGGED * volume_mm3 ** (2 / 3):
        raise InputError(
            f"the labels are noise: {volume_mm3 / 1000:.0f} ml with borders of "
            f"{area_mm2 / 100:.0f} cm2, where an organ has a tenth. Smooth them."
        )


def _tumor_labels(
    present: list[int], organ: int, tumors: tuple[int, ...] | None
) -> tuple[int, ...]:
    if not present:
        raise InputError("the label map is empty: every voxel is 0.")
    if organ not in present:
        raise InputError(
            f"the label map has no organ label {organ}; it has {present}. Give --organ N."
        )
    if tumors is None:
        return tuple(n for n in present if n >= FIRST_TUMOR and n != organ)
    if missing := set(tumors) - set(present) | set(tumors) & {organ}:
        raise InputError(
            f"the label map has no tumor label {min(missing)} besides the organ; it has {present}. "
            "Give --tumor N, or --tumor 0 for none."
        )
    return tumors


def _large_pieces(pieces: _Pieces) -> list[int]:
    """Numbers of the pieces that are organs, largest first: those with at least 10 ml of organ and
    a tenth of the largest one's volume; else the one with most organ."""
    whole_ml = pieces.whole_ml
    large = np.flatnonzero(pieces.organ_ml >= _MIN_ML).tolist()
    if not large:  # a very small organ, or one that is nearly all tumor
        return [int(pieces.organ_ml.argmax())]
    return [n for n in large if whole_ml[n] >= whole_ml[large].max() / 10]


def _attach_tumors(
    pieces: _Pieces, organs: list[int], min_tumor_ml: float
) -> tuple[list[Note], list[int]]:
    """Give each piece with a tumor of at least ``min_tumor_ml`` to an organ within 3 mm (or one
    voxel where voxels are larger). Returns notes, and the pieces that lie farther away."""
    notes, apart = list[Note](), list[int]()
    separate = [n for n in pieces.with_tumor(min_tumor_ml) if n not in organs]
    if len(separate) > _MOST_TUMORS:
        raise InputError(f"over {_MOST_TUMORS} tumors lie beside the organ: raise --min-tumor-ml.")
    for number in separate:
        ml = float(pieces.tumor_ml[number])
        if (joined := _joined(pieces, organs, number)) is None:
            apart.append(number)
        else:
            notes.append(
                f"a tumor of {ml:.2f} ml lies {joined[0]:.1f} mm off the organ's labels: taken as "
                f"the organ's, the gap filled with {joined[1]:.2f} ml of organ"
            )
    pieces.measure()
    return notes, apart


def _joined(pieces: _Pieces, organs: list[int], number: int) -> tuple[float, float] | None:
    """Join a piece to its nearest organ, with organ in the gap where the two face each other.
    Returns the gap's width and filled volume; None: it is too far away."""
    spacing = spacing_mm(pieces.affine)
    reach_mm = max(_GAP_MM, float(spacing.max()))
    around_mm = reach_mm + 2 * float(spacing.max())
    box = grid.bounding_box(pieces.numbers == number, pieces.affine, around_mm)
    numbers = pieces.numbers[box]
    tumor, organ = numbers == number, np.isin(numbers, organs)
    if not organ.any():
        return None
    to_organ, nearest = ndimage.distance_transform_edt(
        ~organ, sampling=spacing, return_indices=True
    )
    tumor_voxel = np.unravel_index(np.where(tumor, to_organ, np.inf).argmin(), tumor.shape)
    organ_voxel = tuple(int(axis[tumor_voxel]) for axis in nearest)
    steps = np.abs(np.subtract(tumor_voxel, organ_voxel))
    gap_mm = float(np.linalg.norm(np.maximum(steps - 1, 0) * spacing))  # between voxels' faces
    if gap_mm > reach_mm:
        return None
    to_tumor = ndimage.distance_transform_edt(~tumor, sampling=spacing)
    between = to_organ + to_tumor <= float(to_organ[tumor_voxel]) + float(np.median(spacing))
    bridge = between & (numbers == 0)
    numbers[tumor | bridge] = numbers[organ_voxel]
    pieces.labels[box][bridge] = pieces.organ
    return gap_mm, float(bridge.sum()) * grid.voxel_ml(pieces.affine)


def _left_out(
    pieces: _Pieces, organs: list[int], apart: list[int], min_tumor_ml: float
) -> list[Note]:
    """Notes on specks and on tumors apart from every organ. Raises InputError: there is no
    other."""
    specks_ml = np.delete(pieces.whole_ml, [0, *apart, *organs])
    large_ml, specks_ml = specks_ml[specks_ml >= _SPECK_ML], specks_ml[specks_ml < _SPECK_ML]
    what = "label map"
    notes: list[Note] = [Finding("dropped", {"what": what, "ml": ml}) for ml in large_ml.tolist()]
    if count := int((specks_ml > 0).sum()):
        notes.append(f"{count} specks beside the organ dropped ({specks_ml.sum():.2f} ml together)")
    if apart and not set(organs) & set(pieces.with_tumor(min_tumor_ml)):
        text = " and ".join(f"{pieces.tumor_ml[n]:.1f} ml" for n in apart[:5])
        raise InputError(
            f"the only tumor ({text}) lies more than {_GAP_MM:g} mm from the organ. Check the "
            "labels and --organ, or give --tumor 0 to leave it out."
        )
    return notes + [
        Finding("left_out", {"what": "tumor", "ml": ml, "mm": _GAP_MM})
        for ml in pieces.tumor_ml[apart].tolist()
    ]


def _choose(
    pieces: _Pieces, organs: list[int], side: Side, middle_x_mm: float, organ_kind: Organ
) -> tuple[int, str, Side]:
    """The number of the organ to keep, a note (may be empty), and its side."""

    def tumor_then_size(number: int) -> tuple[float, float]:
        return pieces.tumor_ml[number], pieces.whole_ml[number]

    best, alone = max(organs, key=tumor_then_size), len(organs) == 1
    if not organ_kind.in_pairs:
        note = f"of {len(organs)} large pieces the one with most tumor, or the largest, was taken"
        return best, "" if alone else note, side
    if side == UNKNOWN and alone:
        return best, "", UNKNOWN
    x_mm = {number: pieces.x_mm(number) for number in organs}
    right_mm, left_mm = min(x_mm.values()), max(x_mm.values())
    if not alone:
        middle_x_mm = (right_mm + left_mm) / 2
    if side == UNKNOWN:
        if pieces.tumor_ml[best] == 0:
            what = f"{len(organs)} {organ_kind.words}s and no tumor"
            raise InputError(f"the label map holds {what}. Give --side left or --side right.")
        side = "left" if x_mm[best] > middle_x_mm else "right"
        note = f"the patient's {side} {organ_kind.words} was chosen: it bears most tumor"
        return best, note, side if left_mm - right_mm > _PAIR_APART_MM else UNKNOWN
    # With one organ only the image's midline is known: near it, trust the user.
    slack, sign = _MIDLINE_MARGIN_MM if alone else 0.0, 1 if side == "left" else -1
    fitting = [n for n in organs if sign * (x_mm[n] - middle_x_mm) > -slack]
    if not fitting:
        raise InputError(f"the {organ_kind.words} lies on the patient's other side. Check --side.")
    what = organ_kind.words
    note = f"only one {what} in the map; its side was checked against the image's middle only"
    return max(fitting, key=tumor_then_size), note if alone else "", side


def _number_tumors(
    labels: np.ndarray, tumors: tuple[int, ...], voxel_volume_ml: float, min_tumor_ml: float
) -> tuple[np.ndarray, list[str]]:
    """Labels 1, 2, 3, ... without gaps, and notes on what was dropped or renumbered."""
    notes: list[str] = []
    solid = labels > 0
    out = np.where(ndimage.binary_fill_holes(solid), ORGAN, 0).astype(np.uint8)
    filled_ml = float(out.sum() - solid.sum()) * voxel_volume_ml
    if filled_ml > 0:
        notes.append(f"holes of {filled_ml:.2f} ml inside the organ filled")
    number = FIRST_TUMOR
    for value in tumors:
        pieces, counts = grid.components(labels == value)
        kept = int((counts * voxel_volume_ml >= min_tumor_ml).sum())  # largest first
        if small := len(counts) - kept:
            small_ml = float(counts[kept:].sum()) * voxel_volume_ml
            notes.append(
                f"label {value}: {small} pieces below {min_tumor_ml:g} ml became organ "
                f"({small_ml:.2f} ml together)"
            )
        if kept > 1:
            notes.append(f"label {value} has {kept} separate pieces: one tumor each")
        for n in range(kept):
            if number > _MOST_TUMORS + 1:
                raise InputError("more than 254 tumors; raise --min-tumor-ml or check the labels.")
            out[pieces == n + 1] = number
            if number != value:
                notes.append(f"tumor label {value} is now {number}")
            number += 1
    if number == FIRST_TUMOR:
        notes.append("no tumor in this organ")
    return out, notes


def neighbours(
    labels: UInt8[np.ndarray, "i j k"], chosen: UInt8[np.ndarray, "i j k"], used: tuple[int, ...]
) -> dict[int, float]:
    """Labels of a map that touch what was ``chosen`` of it, on the same grid, and are not ``used``:
    by label, the share of its surface that lies on what is used. A tumor inside has 1."""
    near = ndimage.binary_dilation(chosen > 0)
    touching = set(np.unique(labels[near]).tolist()) - {0, *used}
    beside = ndimage.binary_dilation(among(labels, used) & (chosen > 0))
    shares = {}
    for label in touching:
        mask = labels == label
        surface = mask & ~ndimage.binary_erosion(mask, border_value=1)
        shares[label] = float(np.count_nonzero(surface & beside) / (surface.sum() + 1e-9))
    return {label: share for label, share in shares.items() if share > 0}
