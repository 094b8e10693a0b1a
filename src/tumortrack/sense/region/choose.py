"""Which pieces are the organ: the one picked by the user, the last one seen, or the likeliest; what
continues it behind something nearer; and what lies wholly in the last estimate's box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tumortrack.core.errors import NoEstimate
from tumortrack.core.report import Finding
from tumortrack.sense.region.hints import Hints
from tumortrack.sense.region.picture import (
    FLYING,
    LAST_BOX,
    PIECES,
    THIN,
    Picture,
    RegionConfig,
    jit,
)
from tumortrack.sense.region.pieces import find_edges, find_pieces

_OPENINGS = (1.0, 1.7, 2.8)  # times ``opening_mm``: the last is wider than fingers
_CLEARLY = 1.1  # better by so much is worth a wider opening
_PICK_REACH_MM = 10.0  # from the picked point to the piece it means
_STEEPEST_GAP = 0.5  # slope of a surface behind what hides part of it
_STEP_MM = 3.0
_SAME_MM = 5.0  # neighbouring pixels of one surface
_FEWEST_LINES = 0.4  # length along which pieces continue each other, over the smaller one's size
_STRAY = 2  # false matches in a row that are no background
_TIMES = 2  # so many things may lie between the chosen piece and another
_CUT = 0.1
_POOR = 0.5
_WHOLLY = 0.97  # of a piece's surface in the last box: it is a part of the organ
_BOX_MM = 5.0  # the last box may be wrong by so much
_FAR_SIDE = 0.4  # of the box's depth: the camera sees an organ's near side; there is the ground
_THICK_PART_MM = 9.0
_AIMED = 0.4  # so far (tangent) from the optical axis a piece is half as likely the organ
_THICK = 0.8  # of an organ's shortest extent: thinner pieces are likely fingers or shafts


def take_one_piece(picture: Picture, config: RegionConfig, hints: Hints) -> None:
    """Leave one piece (and what continues it) to the organ. NoEstimate: a point was picked, and no
    piece lies within 10 mm of it.

    A hand that touches the organ makes one large piece with it that leaves the picture. Then the
    opening is widened until fingers are too narrow to connect.
    """
    edges = find_edges(picture, config)
    best: tuple[float, np.ndarray, _Sizes, np.ndarray] | None = None
    for wider in _OPENINGS:
        pieces, count = find_pieces(picture, edges, config, wider)
        seen = (picture.depth_mm, edges[1], picture.taken)
        these = _measure(*seen, pieces, picture.pinhole, count)
        together, score, doubtful = _chosen(picture, pieces, these, config, hints)
        if best is None or score > _CLEARLY * best[0]:
            best = score, pieces, these, together
        if not doubtful:
            break
    assert best is not None
    _, pieces, these, together = best
    picture.take(pieces == 0, THIN)
    if hints.last_box_mm is not None and together.any():
        # A tumor that stands out, a part beyond a crease: wholly in the box, not at its far side,
        # and not thin.
        low, high = np.sort(np.asarray(hints.last_box_mm, np.float64), axis=0)
        high[2] -= _FAR_SIDE * (high[2] - low[2])
        area = _area_in_box(picture, pieces, these, low - _BOX_MM, high + _BOX_MM)
        parts = (area > _WHOLLY * these.area_mm2) & (these.thick_mm > _THICK_PART_MM) & (area > 0)
        together = together | parts
    picture.take(~together[pieces], PIECES)


class _Sizes(NamedTuple):
    """Of every piece (count + 1,); entry 0 is not used. ``area_mm2``: across the line of sight.
    ``wide_mm``: longest extent. ``cut``: 0..1, how much of it continues outside the examined part:
    the width there over the square root of the area. ``thick_mm``: diameter of the largest disc in
    it. ``aside``: tangent of the angle between its middle and the optical axis."""

    area_mm2: np.ndarray
    wide_mm: np.ndarray
    cut: np.ndarray
    thick_mm: np.ndarray
    aside: np.ndarray


def _chosen(
    picture: Picture, pieces: np.ndarray, these: _Sizes, config: RegionConfig, hints: Hints
) -> tuple[np.ndarray, float, bool]:
    """Which pieces (count + 1,) are the organ at one way of parting the picture: the one that the
    hints name, else the likeliest (the largest of an organ's size; what leaves the picture counts
    less, as arms do), and those that continue it behind something nearer. How like an organ that
    is; and whether it is doubtful: it leaves the picture or is too wide, or something that does
    seems to continue it, so that perhaps a wider opening parts them."""
    likeness = _like_an_organ(these, config)
    together = np.zeros(len(these.cut), bool)
    piece = _hinted(picture, pieces, these, hints)
    guessed = piece is None
    if guessed:
        scores = these.area_mm2 * likeness
        if not scores.max() > 0:
            return together, -1.0, True
        piece = int(scores.argmax())
    leaves = these.cut > _CUT
    gap = config.gap_mm / picture.footprint
    seen = (picture.depth_mm, picture.taken, pieces)
    lines = _continuing(*seen, gap, picture.footprint, len(together))
    lines = lines + lines.T
    together[piece] = True
    refused = False
    for _ in range(_TIMES):
        more = lines[together].sum(0) > _FEWEST_LINES * np.sqrt(these.area_mm2)
        more[0] = False
        refused |= bool((more & leaves & ~together).any())
        together |= more & ~leaves
    score = these.area_mm2[together].sum() * likeness[piece]
    too_wide = these.wide_mm[piece] > config.organ_mm[1]
    # A poor guess beside something larger that leaves the picture: a hand that holds the organ?
    larger = these.area_mm2[leaves].max(initial=0) > score
    held = guessed and likeness[piece] < _POOR and larger
    doubtful = refused or leaves[piece] or too_wide or held
    return together, float(score), bool(doubtful)


def _hinted(picture: Picture, pieces: np.ndarray, these: _Sizes, hints: Hints) -> int | None:
    """The piece nearest to the picked point; without one, that with the most surface, and the most
    of its surface, in the last box. None if there is none."""
    if hints.picked_mm is not None:
        rows, columns = np.nonzero(pieces)
        z, (fx, fy, cx, cy) = picture.depth_mm[rows, columns].astype(float), picture.pinhole
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
    area = _area_in_box(picture, pieces, these, low, high)
    inside = area**2 / np.maximum(these.area_mm2, 1e-9)  # what surrounds it reaches in, too
    return int(inside.argmax()) if inside.max() > 0 else None


def _area_in_box(
    picture: Picture, pieces: np.ndarray, these: _Sizes, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    return _area_inside(picture.depth_mm, pieces, picture.pinhole, low, high, len(these.cut))


def _like_an_organ(these: _Sizes, config: RegionConfig) -> np.ndarray:
    """Of every piece, 0..1."""
    low, high = config.organ_mm
    fits = np.minimum(1.0, (high / np.maximum(these.wide_mm, 1e-9)) ** 4)
    thick = np.minimum(1.0, these.thick_mm / (_THICK * low)) ** 2
    aimed = 1 / (1 + (these.aside / _AIMED) ** 2)
    return fits * thick * aimed * (1 - 0.95 * these.cut) ** 4 * (these.wide_mm > low)


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
    return _Sizes(area, wide, cut, 2 * disc, aside)


@jit
def _goes_on(depth_mm, taken, z, v, u):  # type: ignore[no-untyped-def]
    """Beyond the image's border, or as the same surface beyond the last estimate's surroundings.
    Range, box and mask don't count: they are there to cut around the organ."""
    height, width = taken.shape
    if not (0 <= v < height and 0 <= u < width):
        return True
    return taken[v, u] == LAST_BOX and abs(depth_mm[v, u] - z) < _SAME_MM


@jit
def _continuing(depth_mm, taken, pieces, gap, footprint, count):  # type: ignore[no-untyped-def]
    """Length (count, count), mm, along which one piece continues as another after a gap in which
    something is nearer and nothing is farther."""
    lines = np.zeros((count, count))
    height, width = depth_mm.shape
    for v in range(height):
        for u in range(width):
            piece = pieces[v, u]
            if piece:
                for step in ((0, 1), (1, 0)):
                    other = _beyond_gap(depth_mm, taken, pieces, (v, u), step, (gap, footprint))
                    if other:
                        lines[piece, other] += depth_mm[v, u] * footprint
    return lines


@jit
def _beyond_gap(depth_mm, taken, pieces, start, step, scale):  # type: ignore[no-untyped-def]
    """The piece that continues the one at ``start``, a few pixels on; 0 for none. ``scale``: the
    longest gap in px at distance 1, and a pixel's width there."""
    gap, footprint = scale
    y, x = start
    z, piece = depth_mm[y, x], pieces[y, x]
    nearer, farther, last = 0, 0, piece
    for length in range(1, int(gap / z) + 2):
        y, x = y + step[0], x + step[1]
        if y >= depth_mm.shape[0] or x >= depth_mm.shape[1] or pieces[y, x] == piece:
            return 0
        if taken[y, x] == FLYING:  # anywhere in depth
            continue
        there, other = depth_mm[y, x], pieces[y, x]
        most = _STEP_MM + _STEEPEST_GAP * length * footprint * z
        if there > z + most:
            farther += 1
            if farther > _STRAY:
                return 0
            continue
        farther = 0
        # Where another piece begins, not in its midst: that one is itself in front.
        if other and other != last and nearer >= 2 and abs(there - z) < most:
            return other
        nearer += there < z - _STEP_MM
        last = other
    return 0
