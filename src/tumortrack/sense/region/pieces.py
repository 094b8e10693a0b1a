"""The picture in connected pieces, parted by jumps of depth, creases and narrow places.

A pixel is an edge where a neighbour is missing, lies at another depth, or where the surface folds
into a valley. What is farther than ``opening_mm`` from every edge is the core of a piece; pieces
grow from their cores, by little more than what the opening took, and never over a jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from tumortrack.sense.region.config import RegionConfig
from tumortrack.sense.region.picture import FLYING, ORGAN, Picture

REFERENCE_MM = 150.0  # the distance at which ``noise_mm`` is stated
_CREASE_REACH_MM = 4.0
_FEWEST_NEIGHBOURS = 3  # of 8; a straight edge leaves 5, a right angle 3
_LONGEST_HOLE = 5  # px; failed matches, not a gap

_jit = numba.njit(cache=True, nogil=True)


def jump_scale(picture: Picture, config: RegionConfig) -> tuple[float, float]:
    """Neighbouring pixels at depth z belong together if their depths differ by less than
    ``first * z + second * z**2``: slope, and four standard deviations of noise."""
    slope = math.tan(math.radians(config.steepest_degrees)) * picture.footprint
    return slope, 4 * config.noise_mm / REFERENCE_MM**2


def remove_flying(picture: Picture, config: RegionConfig) -> None:
    """Take pixels with hardly a neighbour at their depth: between two surfaces, or alone."""
    _take_lonely(picture.depth_mm, picture.taken, jump_scale(picture, config), FLYING)


@dataclass(frozen=True, eq=False)
class Edges:
    """Where the picture may part: ``depth_mm`` (h, w) with short holes bridged, NaN where nothing
    is left; ``distance`` (h, w) of every pixel to the nearest edge, px."""

    depth_mm: np.ndarray
    distance: np.ndarray
    jump: tuple[float, float]


def find_edges(picture: Picture, config: RegionConfig) -> Edges:
    """Edges between what is left of the picture."""
    jump = jump_scale(picture, config)
    depth_mm = _without_holes(picture.depth_mm, picture.taken, jump)
    crease = (config.crease_mm, _CREASE_REACH_MM / picture.footprint)
    return Edges(depth_mm, _edge_distance(depth_mm, jump, crease), jump)


def find_pieces(picture: Picture, edges: Edges, opening_mm: float) -> tuple[np.ndarray, int]:
    """Number of its piece for every pixel (h, w), int32, 0 for none, and how many there are."""
    from scipy.ndimage import label

    radius = opening_mm / picture.footprint  # px at distance 1
    pieces, count = label(edges.distance * edges.depth_mm > radius)
    _grow(edges.depth_mm, pieces, edges.jump, radius)
    pieces[picture.taken != ORGAN] = 0  # bridged holes
    return pieces, count


@_jit
def _take_lonely(depth_mm, taken, jump, step):  # type: ignore[no-untyped-def]
    height, width = depth_mm.shape
    lonely = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            if taken[v, u]:
                continue
            z = depth_mm[v, u]
            most = jump[0] * z + jump[1] * z * z
            near = 0
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    y, x = v + dv, u + du
                    if 0 <= y < height and 0 <= x < width:
                        near += taken[y, x] == 0 and abs(depth_mm[y, x] - z) < most
                    else:
                        near += 1  # outside: nobody knows
            lonely[v, u] = near - 1 < _FEWEST_NEIGHBOURS
    for v in range(height):
        for u in range(width):
            if lonely[v, u]:
                taken[v, u] = step


@_jit
def _without_holes(depth_mm, taken, jump):  # type: ignore[no-untyped-def]
    """What is left (NaN elsewhere), with short failures along a row bridged where both ends
    agree."""
    height, width = depth_mm.shape
    out = np.full((height, width), np.nan, np.float32)
    for v in range(height):
        last = -1
        for u in range(width):
            if taken[v, u]:
                continue
            z = depth_mm[v, u]
            out[v, u] = z
            if last >= 0 and 1 < u - last <= _LONGEST_HOLE + 1:
                before = depth_mm[v, last]
                if abs(before - z) < jump[0] * z + jump[1] * z * z:
                    for x in range(last + 1, u):
                        out[v, x] = before + (z - before) * (x - last) / (u - last)
            last = u
    return out


@_jit
def _folds(before, here, after, deep):  # type: ignore[no-untyped-def]
    return here - (before + after) * np.float32(0.5) > deep  # False where one is NaN


@_jit
def _is_edge(depth_mm, v, u, most, crease, reach):  # type: ignore[no-untyped-def]
    height, width = depth_mm.shape
    z = depth_mm[v, u]
    for dv, du in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y, x = v + dv, u + du
        inside = 0 <= y < height and 0 <= x < width  # the image's border is no edge
        if inside and not abs(depth_mm[y, x] - z) < most:
            return True
    if crease > 0 and reach <= v < height - reach and reach <= u < width - reach:
        r, d = reach, (reach * 7) // 10
        return (
            _folds(depth_mm[v, u - r], z, depth_mm[v, u + r], crease)
            or _folds(depth_mm[v - r, u], z, depth_mm[v + r, u], crease)
            or _folds(depth_mm[v - d, u - d], z, depth_mm[v + d, u + d], crease)
            or _folds(depth_mm[v - d, u + d], z, depth_mm[v + d, u - d], crease)
        )
    return False


@_jit
def _edge_distance(depth_mm, jump, crease):  # type: ignore[no-untyped-def]
    """Chamfer distance (Borgefors 1986, doi 10.1016/S0734-189X(86)80047-0) in px to the nearest
    edge; 0 on edges and where nothing is left."""
    height, width = depth_mm.shape
    far = np.float32(height + width)
    one, oblique = np.float32(0.955), np.float32(1.369)
    out = np.zeros((height, width), np.float32)
    for v in range(height):
        for u in range(width):
            z = depth_mm[v, u]
            if z > 0:
                noise = jump[1] * z * z
                deep = crease[0] + noise if crease[0] > 0 else 0.0
                reach = max(int(crease[1] / z + 0.5), 1)
                if not _is_edge(depth_mm, v, u, jump[0] * z + noise, deep, reach):
                    out[v, u] = far
    for v in range(height):
        for u in range(width):
            here = out[v, u]
            if here > 0:
                if u > 0:
                    here = min(here, out[v, u - 1] + one)
                if v > 0:
                    here = min(here, out[v - 1, u] + one)
                    if u > 0:
                        here = min(here, out[v - 1, u - 1] + oblique)
                    if u + 1 < width:
                        here = min(here, out[v - 1, u + 1] + oblique)
                out[v, u] = here
    for v in range(height - 1, -1, -1):
        for u in range(width - 1, -1, -1):
            here = out[v, u]
            if here > 0:
                if u + 1 < width:
                    here = min(here, out[v, u + 1] + one)
                if v + 1 < height:
                    here = min(here, out[v + 1, u] + one)
                    if u > 0:
                        here = min(here, out[v + 1, u - 1] + oblique)
                    if u + 1 < width:
                        here = min(here, out[v + 1, u + 1] + oblique)
                out[v, u] = here
    return out


@_jit
def _grow(depth_mm, pieces, jump, radius):  # type: ignore[no-untyped-def]
    """Grow all cores at the same pace, a pixel a round, never over a jump."""
    height, width = depth_mm.shape
    queue = np.empty(height * width, np.int32)
    rounds = np.zeros(height * width, np.int16)
    end = 0
    for v in range(height):
        for u in range(width):
            if pieces[v, u] and (
                (u > 0 and pieces[v, u - 1] == 0)
                or (u + 1 < width and pieces[v, u + 1] == 0)
                or (v > 0 and pieces[v - 1, u] == 0)
                or (v + 1 < height and pieces[v + 1, u] == 0)
            ):
                queue[end] = v * width + u
                end += 1
    start = 0
    while start < end:
        place = queue[start]
        start += 1
        v, u = place // width, place % width
        z = depth_mm[v, u]
        if rounds[place] >= 1.4 * radius / z + 2:
            continue
        most = jump[0] * z + jump[1] * z * z
        for dv in range(-1, 2):
            for du in range(-1, 2):
                y, x = v + dv, u + du
                if not (0 <= y < height and 0 <= x < width) or pieces[y, x]:
                    continue
                if abs(depth_mm[y, x] - z) < most:
                    pieces[y, x] = pieces[v, u]
                    rounds[y * width + x] = rounds[place] + 1
                    queue[end] = y * width + x
                    end += 1
