"""Choose the organ's piece: the one that the user picked, that the last estimate points to, or the
most likely; and what lies wholly in the last estimate's box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.report import Finding
from tumortrack.native import F64, I32, U8, kernel
from tumortrack.segmentation.pieces import find_edges, find_pieces
from tumortrack.segmentation.tissue import Hints
from tumortrack.segmentation.working_image import (
    DEPTH,
    LAST_BOX,
    PIECES,
    TANGENTS,
    THIN,
    RegionConfig,
    WorkingImage,
)

# Whether folds are edges, and the opening, times ``opening_mm``: the last is wider than fingers.
_SPLITS = (False, 1.0), (True, 1.0), (True, 1.7), (True, 2.8)
_CLEARLY = 1.1  # a wider opening must raise the score by this factor
_PICK_REACH_MM = 10.0  # from the picked point to its piece
_OTHERS, _LEAST_OTHER = 3, 0.1  # pieces that may be it instead; score over the best of them
_MOST_ON_BORDER = 0.1  # ``_Sizes.cut`` from which a piece leaves the image
_POOR = 0.5  # likeness of an organ below which a guess is doubtful
_WHOLLY = 0.97  # share of a piece in the last box from which it is part of the organ
_BOX_MM = 5.0  # tolerance of the last box
_FAR_SIDE = 0.4  # of the box's depth: its far side shows the ground, the near side the organ
_THICK_PART_MM = 9.0  # thinner pieces in the last box are no part of the organ
_AIMED = 0.4  # at this angle (tangent) from the optical axis a piece is half as likely the organ
_THICK = 0.8  # of an organ's shortest extent: thinner pieces are likely fingers or shafts

_PIECES = I32["height", "width"]  # from ``label``: fewer than are told, 0 none
# Depths, pieces, tangents, product of the focal lengths, a box's corners; areas in it.
_areas = kernel(
    "area_inside",
    *(DEPTH, _PIECES, *TANGENTS, float),
    *((float,) * 3, (float,) * 3, F64["pieces"].out),
)
# Depths, px to the nearest edge, states, pieces, tangents, focal lengths, state of what goes on;
# a row for each piece.
_measures = kernel(
    "measure_pieces",
    *(DEPTH, DEPTH, U8["height", "width"], _PIECES, *TANGENTS, float, float, int),
    F64["pieces", 17].out,
)


def choose_pieces(image: WorkingImage, config: RegionConfig, hints: Hints) -> list[np.ndarray]:
    """Remove all but the organ's piece and what belongs to it.
    Returns the masks of the next most likely pieces, unless hints say which one it is. Raises
    NoEstimate: no piece lies within 10 mm of the picked point.

    Surroundings level with the organ, or a hand that touches it, make one large piece with it that
    leaves the image. Then folds part the two; then the opening is widened until fingers are too
    narrow to connect.
    """
    best: tuple[float, np.ndarray, _Sizes, np.ndarray] | None = None
    edges = find_edges(image, config, folds=False)
    for folds, wider in _SPLITS:
        if folds and wider == 1:
            edges = find_edges(image, config, folds)
        pieces, count = find_pieces(image, edges, config, wider)
        sizes = measure(image, edges[1], pieces, count)
        poor = _POOR if folds else 1.0  # beside something large a fold may hide the organ in it
        chosen, score, doubtful = _chosen(image, pieces, sizes, config, hints, poor)
        if best is None or score > _CLEARLY * best[0]:
            best = score, pieces, sizes, chosen
        if not doubtful:
            break
    assert best is not None
    _, pieces, sizes, chosen = best
    image.remove(pieces == 0, THIN)
    if hints.last_box_mm is not None and chosen.any():
        # A protruding tumor, a part beyond a fold: in the box, not at its far side, not thin.
        low, high = np.sort(np.asarray(hints.last_box_mm, np.float64), axis=0)
        high[2] -= _FAR_SIDE * (high[2] - low[2])
        box = low - _BOX_MM, high + _BOX_MM
        area = area_inside(image, pieces, *box, len(chosen))
        parts = (area > _WHOLLY * sizes.area_mm2) & (sizes.thick_mm > _THICK_PART_MM) & (area > 0)
        chosen = chosen | parts
    image.remove(~chosen[pieces], PIECES)
    if hints.picked_mm is not None or hints.last_box_mm is not None:
        return []
    scores = np.where(chosen, 0.0, sizes.area_mm2 * _like_an_organ(sizes, config))
    likely = np.argsort(-scores)[:_OTHERS]
    return [pieces == n for n in likely if scores[n] > _LEAST_OTHER * scores.max()]


class _Sizes(NamedTuple):
    """Measures of every piece (count + 1,); entry 0 is not used. ``area_mm2``: across the line of
    sight. ``wide_mm``: the longest extent along four directions of the image. ``border_fraction``:
    0..1, how much of it continues outside the examined part: the width there over the square root
    of the area. ``thick_mm``: diameter of its largest inscribed disc. ``aside``: tangent of the
    angle between its middle and the optical axis."""

    area_mm2: np.ndarray
    wide_mm: np.ndarray
    border_fraction: np.ndarray
    thick_mm: np.ndarray
    aside: np.ndarray


def _chosen(
    image: WorkingImage,
    pieces: np.ndarray,
    sizes: _Sizes,
    config: RegionConfig,
    hints: Hints,
    poor: float,
) -> tuple[np.ndarray, float, bool]:
    """Which piece (count + 1,) of one split of the image is the organ: the one that the hints
    select, else the most likely (the largest of an organ's size; what leaves the image counts less,
    as arms do). Its score; and whether it is doubtful, so that another split may be better: it
    leaves the image, is too wide, or less like an organ than ``poor`` beside something larger that
    leaves the image."""
    likeness = _like_an_organ(sizes, config)
    chosen = np.zeros(len(sizes.border_fraction), bool)
    piece = _hinted(image, pieces, sizes, hints)
    guessed = piece is None
    if guessed:
        scores = sizes.area_mm2 * likeness
        if not scores.max() > 0:
            return chosen, -1.0, True
        piece = int(scores.argmax())
    leaves = sizes.border_fraction > _MOST_ON_BORDER
    chosen[piece] = True
    score = sizes.area_mm2[piece] * likeness[piece]
    too_wide = sizes.wide_mm[piece] > config.organ_mm[1]
    # A poor guess beside something larger that leaves the image: a hand that holds the organ?
    larger = sizes.area_mm2[leaves].max(initial=0) > score
    held = guessed and likeness[piece] < poor and larger
    return chosen, float(score), bool(leaves[piece] or too_wide or held)


def _hinted(image: WorkingImage, pieces: np.ndarray, sizes: _Sizes, hints: Hints) -> int | None:
    """The piece nearest to the picked point; without one, that with the largest area, and the
    largest share of its area, in the last box. None without a hint or such a piece."""
    if hints.picked_mm is not None:
        rows, columns = np.nonzero(pieces)
        z, (fx, fy, cx, cy) = image.depth_mm[rows, columns].astype(float), image.pinhole
        points_mm = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1)
        square = ((points_mm - hints.picked_mm) ** 2).sum(1)
        if not square.min(initial=np.inf) <= _PICK_REACH_MM**2:
            there = ", ".join(f"{x:.0f}" for x in hints.picked_mm)
            raise NoEstimate(Finding("pick_missed", {"reach_mm": _PICK_REACH_MM, "place": there}))
        nearest = square.argmin()
        return int(pieces[rows[nearest], columns[nearest]])
    if hints.last_box_mm is None:
        return None
    low, high = np.sort(np.asarray(hints.last_box_mm, np.float64), axis=0)
    area = area_inside(image, pieces, low, high, len(sizes.border_fraction))
    inside = area**2 / np.maximum(sizes.area_mm2, 1e-9)  # the surroundings reach in, too
    return int(inside.argmax()) if inside.max() > 0 else None


def _like_an_organ(sizes: _Sizes, config: RegionConfig) -> np.ndarray:
    """How much each piece resembles an organ, 0..1."""
    low, high = config.organ_mm
    fits = np.minimum(1.0, (high / np.maximum(sizes.wide_mm, 1e-9)) ** 4)
    thick = np.minimum(1.0, sizes.thick_mm / (_THICK * low)) ** 2
    aimed = 1 / (1 + (sizes.aside / _AIMED) ** 2)
    return fits * thick * aimed * (1 - 0.95 * sizes.border_fraction) ** 4 * (sizes.wide_mm > low)


def area_inside(
    image: WorkingImage, pieces: np.ndarray, low: np.ndarray, high: np.ndarray, count: int
) -> np.ndarray:
    """Each piece's area (count,) within a box, mm^2."""
    area = np.zeros(count)
    focal = image.pinhole.fx * image.pinhole.fy
    _areas(image.depth_mm, pieces, *image.tangents, focal, low, high, area)
    return area


def measure(image: WorkingImage, distance: np.ndarray, pieces: np.ndarray, count: int) -> _Sizes:
    """``distance``: px to the nearest edge."""
    out = np.empty((count + 1, 17))
    camera = *image.tangents, *image.pinhole[:2]
    _measures(image.depth_mm, distance, image.pixel_class, pieces, *camera, LAST_BOX, out)
    area, _, _, _, _, thick, wide, border_fraction, aside = out.T[:9]
    return _Sizes(area, wide, border_fraction, thick, aside)
