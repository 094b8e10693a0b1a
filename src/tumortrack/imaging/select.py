"""One kidney and its tumors out of a label map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.types import FIRST_TUMOR, ORGAN, LabelVolume
from tumortrack.imaging.grid import (
    bounding_box,
    components,
    cropped,
    label_counts,
    moved_origin,
    voxel_ml,
)
from tumortrack.imaging.pieces import GAP_MM, Pieces, attach_tumors, find_pieces

MIN_TUMOR_ML = 0.2
MIN_KIDNEY_ML, MAX_KIDNEY_ML = 10.0, 2500.0  # a polycystic kidney can pass 2 litres
_MIDLINE_MARGIN_MM = 20.0


@dataclass(frozen=True)
class _Kidney:
    piece: int
    ml: float
    tumor_ml: float
    x_mm: float  # LPS: grows to the patient's left


def select_labels(
    label_volume: LabelVolume,
    side: str | None = None,
    organ: int = ORGAN,
    tumor: int | None = None,
    min_tumor_ml: float = MIN_TUMOR_ML,
) -> tuple[LabelVolume, list[str]]:
    """Keep one kidney (label 1) and its tumors (2, 3, ...), cropped with a margin.

    A kidney is a connected piece of organ and tumor voxels with at least 10 ml of organ and a
    tenth of the largest one's volume (where there is none, the piece with most organ). A tumor
    within 3 mm of a kidney belongs to it: see ``pieces.attach_tumors``. One farther off is left
    out with a note; other pieces are specks and go. A tumor is a piece of one tumor label inside
    that kidney; smaller ones than ``min_tumor_ml`` become organ. Different tumor labels keep
    their order; the pieces of one label follow each other, largest first.

    Args:
        side: the PATIENT's ``left`` or ``right``; None takes the kidney with most tumor.
        organ: the organ's label.
        tumor: the tumor's label; None takes every other label from 2 up, 0 takes none.

    Returns:
        The selected labels and notes on what was dropped or renumbered.

    Raises:
        InputError: no organ, no such tumor label, two kidneys without tumor and no ``side``, no
            tumor but one apart from every kidney.
    """
    labels = label_volume.labels
    present = [int(n) for n in np.flatnonzero(label_counts(labels)) if n > 0]
    tumors = _tumor_labels(present, organ, tumor)
    affine = label_volume.lps_from_index
    box = bounding_box(np.isin(labels, [organ, *tumors]), affine, 2.0)
    affine = moved_origin(affine, box)
    pieces = find_pieces(labels[box], affine, organ, tumors)
    numbers = _kidney_pieces(pieces)
    pieces, notes, apart = attach_tumors(pieces, numbers, min_tumor_ml)
    kidneys = _kidneys(pieces, numbers)
    notes += _left_out(pieces, kidneys, apart, min_tumor_ml)
    middle = label_volume.lps_from_index @ [*(np.array(labels.shape) / 2), 1]
    chosen, more = _choose_kidney(kidneys, side, float(middle[0]))
    notes += more
    if not MIN_KIDNEY_ML <= chosen.ml <= MAX_KIDNEY_ML:
        raise InputError(
            f"label {organ} and its tumors fill {chosen.ml:.1f} ml; a kidney has "
            f"{MIN_KIDNEY_ML:g} to {MAX_KIDNEY_ML:g} ml. Check --organ, --tumor and the spacing."
        )
    kidney = pieces.numbers == chosen.piece
    box = bounding_box(kidney, affine, 2.0)
    out, more = _number_tumors(
        np.where(kidney, pieces.labels, 0)[box].astype(np.uint8),
        tumors,
        voxel_ml(affine),
        min_tumor_ml,
    )
    return cropped(out, moved_origin(affine, box)), notes + more


def _tumor_labels(present: list[int], organ: int, tumor: int | None) -> list[int]:
    if not present:
        raise InputError("the label map is empty: every voxel is 0.")
    if organ not in present:
        raise InputError(
            f"the label map has no organ label {organ}; it has {present}. Give --organ N."
        )
    if tumor is None:
        return [n for n in present if n >= FIRST_TUMOR and n != organ]
    if tumor == 0:
        return []
    if tumor not in present or tumor == organ:
        raise InputError(
            f"the label map has no tumor label {tumor} besides the organ; it has {present}. "
            "Give --tumor N, or --tumor 0 for none."
        )
    return [tumor]


def _kidney_pieces(pieces: Pieces) -> list[int]:
    """The numbers of the pieces that hold enough organ to be a kidney, largest first."""
    whole_ml = pieces.whole_ml
    large = [n for n in range(1, len(whole_ml)) if pieces.organ_ml[n] >= MIN_KIDNEY_ML]
    if not large:  # a kidney nearly eaten up by its tumor, or a very small one
        return [int(pieces.organ_ml.argmax())]
    return [n for n in large if whole_ml[n] >= whole_ml[large].max() / 10]


def _kidneys(pieces: Pieces, numbers: list[int]) -> list[_Kidney]:
    from scipy import ndimage

    whole_ml = pieces.whole_ml
    boxes = ndimage.find_objects(pieces.numbers, max_label=max(numbers))
    out = []
    for n in numbers:
        box = boxes[n - 1]
        index = np.argwhere(pieces.numbers[box] == n).mean(0) + [s.start for s in box]
        x_mm = float((pieces.lps_from_index @ [*index, 1])[0])
        out.append(_Kidney(n, float(whole_ml[n]), float(pieces.tumor_ml[n]), x_mm))
    return out


def _left_out(
    pieces: Pieces, kidneys: list[_Kidney], apart: list[int], min_tumor_ml: float
) -> list[str]:
    """Notes on tumors that no kidney is near, and on specks; refused where no other tumor is."""
    notes: list[str] = []
    rest_ml = np.delete(pieces.whole_ml, [0, *apart, *(k.piece for k in kidneys)])
    if n_specks := int((rest_ml > 0).sum()):
        notes.append(
            f"{n_specks} specks beside the kidneys dropped ({rest_ml.sum():.2f} ml together)"
        )
    if not apart:
        return notes
    text = " and ".join(f"{pieces.tumor_ml[n]:.1f} ml" for n in apart[:5])
    if not any(k.tumor_ml > 0 and k.tumor_ml >= min_tumor_ml for k in kidneys):
        raise InputError(
            f"the only tumor ({text}) lies more than {GAP_MM:g} mm from every kidney. Check the "
            "labels and --organ, or give --tumor 0 to leave it out."
        )
    notes.append(
        f"LEFT OUT: tumor of {text}, more than {GAP_MM:g} mm from every kidney. If it belongs to "
        "the kidney, close the gap in the label map"
    )
    return notes


def _choose_kidney(
    kidneys: list[_Kidney], side: str | None, middle_x_mm: float
) -> tuple[_Kidney, list[str]]:
    def rank(kidney: _Kidney) -> tuple[float, float]:
        return (kidney.tumor_ml, kidney.ml)

    if side not in (None, "left", "right"):
        raise InputError(f"side {side!r} is not understood. Allowed: left, right (the patient's).")
    if len(kidneys) > 1:
        xs = [kidney.x_mm for kidney in kidneys]
        middle_x_mm = (min(xs) + max(xs)) / 2
    if side is None:
        if len(kidneys) > 1 and max(k.tumor_ml for k in kidneys) == 0:
            raise InputError(
                f"the label map holds {len(kidneys)} kidneys and no tumor. Give --side left or "
                "--side right (the patient's)."
            )
        best = max(kidneys, key=rank)
        if len(kidneys) == 1:
            return best, []
        name = "left" if best.x_mm > middle_x_mm else "right"
        return best, [f"the patient's {name} kidney was chosen: it bears most tumor"]
    sign = 1 if side == "left" else -1
    # One kidney alone says nothing of the midline but the image's: near it, trust the user.
    slack = _MIDLINE_MARGIN_MM if len(kidneys) == 1 else 0.0
    fitting = [k for k in kidneys if sign * (k.x_mm - middle_x_mm) > -slack]
    if not fitting:
        raise InputError(
            f"no kidney on the patient's {side} side in this label map; its kidney lies on the "
            "other side. Leave out --side, or check the map's orientation."
        )
    notes = ["only one kidney in the map; its side was checked against the image's middle only"]
    return max(fitting, key=rank), notes if len(kidneys) == 1 else []


def _number_tumors(
    labels: UInt8[np.ndarray, "i j k"],
    tumors: list[int],
    voxel_volume_ml: float,
    min_tumor_ml: float,
) -> tuple[UInt8[np.ndarray, "i j k"], list[str]]:
    """Renumber to 1, 2, 3, ... without gaps; report what went and what changed its number."""
    from scipy import ndimage

    notes: list[str] = []
    solid = labels > 0
    out = np.where(ndimage.binary_fill_holes(solid), ORGAN, 0).astype(np.uint8)
    filled_ml = float(out.sum() - solid.sum()) * voxel_volume_ml
    if filled_ml > 0:
        notes.append(f"holes of {filled_ml:.2f} ml inside the organ filled")
    number = FIRST_TUMOR
    for value in tumors:
        pieces, counts = components(labels == value)
        kept = [n for n in range(len(counts)) if counts[n] * voxel_volume_ml >= min_tumor_ml]
        if lost := len(counts) - len(kept):
            lost_ml = float(counts[len(kept) :].sum()) * voxel_volume_ml
            notes.append(
                f"label {value}: {lost} pieces below {min_tumor_ml:g} ml became organ "
                f"({lost_ml:.2f} ml together)"
            )
        if len(kept) > 1:
            notes.append(f"label {value} has {len(kept)} separate pieces: one tumor each")
        for n in kept:
            if number > 255:
                raise InputError("more than 254 tumors; raise --min-tumor-ml or check the labels.")
            out[pieces == n + 1] = number
            if number != value:
                notes.append(f"tumor label {value} is now {number}")
            number += 1
    if number == FIRST_TUMOR:
        notes.append("no tumor in this kidney")
    return out, notes
