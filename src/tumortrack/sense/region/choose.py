"""Choose the organ's piece: the one that the user picked, that the last estimate points to, or the
likeliest; and what lies wholly in the last estimate's box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.report import Finding
from tumortrack.sense.region.hints import Hints
from tumortrack.sense.region.pieces import find_edges, find_pieces
from tumortrack.sense.region.working_image import (
    LAST_BOX,
    PIECES,
    THIN,
    RegionConfig,
    WorkingImage,
    jit,
)

# Whether folds are edges, and the opening, times ``opening_mm``: the last is wider than fingers.
_SPLITS = (False, 1.0), (True, 1.0), (True, 1.7), (True, 2.8)
_CLEARLY = 1.1  # a wider opening must raise the score by this factor
_PICK_REACH_MM = 10.0  # from the picked point to its piece
_OTHERS, _LEAST_OTHER = 3, 0.1  # pieces that may be it instead; score over the best of them
_SAME_MM = 5.0  # largest step in depth between neighbouring pixels of one surface
_CUT = 0.1  # ``_Sizes.cut`` from which a piece leaves the image
_POOR = 0.5  # likeness of an organ below which a guess is doubtful
_WHOLLY = 0.97  # share of a piece in the last box from which it is part of the organ
_BOX_MM = 5.0  # tolerance of the last box
_FAR_SIDE = 0.4  # of the box's depth: its far side shows the ground, the near side the organ
_THICK_PART_MM = 9.0  # thinner pieces in the last box are no part of the organ
_AIMED = 0.4  # at this angle (tangent) from the optical axis a piece is half as likely the organ
_THICK = 0.8  # of an organ's shortest extent: thinner pieces are likely fingers or shafts


def choose_pieces(image: WorkingImage, config: RegionConfig, hints: Hints) -> list[np.ndarray]:
    """Remove all but the organ's piece and what belongs to it.
    Returns the masks of the next likeliest pieces, unless hints say which one it is. Raises
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
        sizes = _measure(image.depth_mm, edges[1], image.taken, pieces, image.pinhole, count)
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
        area = _area_inside(image.depth_mm, pieces, image.pinhole, *box, len(chosen))
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
    sight. ``low_mm``, ``high_mm`` (count + 1, 4): its ends along four directions of the image;
    ``wide_mm``: the longest extent. ``cut``: 0..1, how much of it continues outside the examined
    part: the width there over the square root of the area. ``thick_mm``: diameter of its largest
    inscribed disc. ``aside``: tangent of the angle between its middle and the optical axis."""

    area_mm2: np.ndarray
    low_mm: np.ndarray
    high_mm: np.ndarray
    wide_mm: np.ndarray
    cut: np.ndarray
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
    select, else the likeliest (the largest of an organ's size; what leaves the image counts less,
    as arms do). Its score; and whether it is doubtful, so that another split may be better: it
    leaves the image, is too wide, or less like an organ than ``poor`` beside something larger that
    leaves the image."""
    likeness = _like_an_organ(sizes, config)
    chosen = np.zeros(len(sizes.cut), bool)
    piece = _hinted(image, pieces, sizes, hints)
    guessed = piece is None
    if guessed:
        scores = sizes.area_mm2 * likeness
        if not scores.max() > 0:
            return chosen, -1.0, True
        piece = int(scores.argmax())
    leaves = sizes.cut > _CUT
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
    area = _area_inside(image.depth_mm, pieces, image.pinhole, low, high, len(sizes.cut))
    inside = area**2 / np.maximum(sizes.area_mm2, 1e-9)  # the surroundings reach in, too
    return int(inside.argmax()) if inside.max() > 0 else None


def _like_an_organ(sizes: _Sizes, config: RegionConfig) -> np.ndarray:
    """How much each piece resembles an organ, 0..1."""
    low, high = config.organ_mm
    fits = np.minimum(1.0, (high / np.maximum(sizes.wide_mm, 1e-9)) ** 4)
    thick = np.minimum(1.0, sizes.thick_mm / (_THICK * low)) ** 2
    aimed = 1 / (1 + (sizes.aside / _AIMED) ** 2)
    return fits * thick * aimed * (1 - 0.95 * sizes.cut) ** 4 * (sizes.wide_mm > low)


@jit
def _area_inside(depth_mm, pieces, pinhole, low, high, count):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = pinhole
    area = np.zeros(count)
    for v in range(len(depth_mm)):
        for u in range(depth_mm.shape[1]):
            if pieces[v, u]:
                z = depth_mm[v, u]
                x, y = (u - cx) / fx * z, (v - cy) / fy * z
                if low[2] < z < high[2] and low[1] < y < high[1] and low[0] < x < high[0]:
                    area[pieces[v, u]] += z * z / (fx * fy)
    return area


@jit
def _measure(depth_mm, distance, taken, pieces, pinhole, count):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = pinhole
    height, width = depth_mm.shape
    area, border, disc = np.zeros(count + 1), np.zeros(count + 1), np.zeros(count + 1)
    middle, pixels = np.zeros((count + 1, 2)), np.zeros(count + 1)
    low, high = np.full((count + 1, 4), np.inf), np.full((count + 1, 4), -np.inf)
    for v in range(height):
        for u in range(width):
            piece = pieces[v, u]
            if piece == 0:
                continue
            z = depth_mm[v, u]
            area[piece] += z * z / (fx * fy)
            pixels[piece] += 1
            middle[piece, 0] += (u - cx) / fx
            middle[piece, 1] += (v - cy) / fy
            disc[piece] = max(disc[piece], distance[v, u] * z / fx)
            inside = 0 < v < height - 1 and 0 < u < width - 1
            if (
                inside
                and pieces[v - 1, u] == pieces[v + 1, u] == piece
                and pieces[v, u - 1] == pieces[v, u + 1] == piece
            ):
                continue  # the extent is reached at the outline
            if (
                _goes_on(depth_mm, taken, z, v - 1, u)
                or _goes_on(depth_mm, taken, z, v + 1, u)
                or _goes_on(depth_mm, taken, z, v, u - 1)
                or _goes_on(depth_mm, taken, z, v, u + 1)
            ):
                border[piece] += z / fx
            x, y = (u - cx) / fx * z, (v - cy) / fy * z
            along = (x, y, (x + y) * 0.7071, (x - y) * 0.7071)
            for k in range(4):
                low[piece, k] = min(low[piece, k], along[k])
                high[piece, k] = max(high[piece, k], along[k])
    wide, cut = np.zeros(count + 1), np.zeros(count + 1)
    for piece in range(1, count + 1):
        if area[piece] > 0:
            wide[piece] = (high[piece] - low[piece]).max()
            cut[piece] = min(border[piece] / np.sqrt(area[piece]), 1.0)
    aside = np.sqrt((middle**2).sum(1)) / np.maximum(pixels, 1)
    return _Sizes(area, low, high, wide, cut, 2 * disc, aside)


@jit
def _goes_on(depth_mm, taken, z, v, u):  # type: ignore[no-untyped-def]
    """Whether a piece continues at a pixel beyond the image's border or the last estimate's
    surroundings. Range, box and mask don't count: they are meant to cut around the organ."""
    height, width = taken.shape
    if not (0 <= v < height and 0 <= u < width):
        return True
    return taken[v, u] == LAST_BOX and abs(depth_mm[v, u] - z) < _SAME_MM
