"""Split the image into connected pieces at depth jumps, creases and narrow places.

A pixel is an edge where a neighbour is missing, lies at another depth, or, if that is asked for,
where the surface folds into a valley. Pixels farther than ``opening_mm`` from every edge are the
cores of pieces. Cores grow by little more than what the opening took away, and never across a
jump.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tumortrack.sense.noise import REFERENCE_MM
from tumortrack.sense.region.working_image import FLYING, ORGAN, RegionConfig, WorkingImage, jit

_CREASE_REACH_MM = 4.0
_FEWEST_NEIGHBOURS = 3  # of 8; at a straight edge there are 5, at a right angle 3
_LONGEST_HOLE = 5  # px; shorter ones are failed matches, not a gap


class Jump(NamedTuple):
    """Neighbouring pixels at depth z are connected if their depths differ by less than
    ``slope * z + noise * z**2``: the steepest surface plus four standard deviations of noise."""

    slope: float
    noise: float


def _jump(image: WorkingImage, config: RegionConfig) -> Jump:
    slope = math.tan(math.radians(config.steepest_degrees)) * image.footprint
    return Jump(slope, 4 * config.noise_mm / REFERENCE_MM**2)


def remove_flying(image: WorkingImage, config: RegionConfig) -> None:
    """Remove pixels with few neighbours at their depth: between two surfaces, or isolated."""
    image.remove(_isolated(image.depth_mm, image.taken, _jump(image, config)), FLYING)


def find_edges(
    image: WorkingImage, config: RegionConfig, folds: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The remaining depths (h, w), mm, with short holes bridged, NaN otherwise; and the distance
    (h, w) of every pixel to the nearest edge, px. ``folds``: are edges, too."""
    jump = _jump(image, config)
    depth_mm = _without_holes(image.depth_mm, image.taken, jump)
    crease = (config.crease_mm * folds, _CREASE_REACH_MM / image.footprint)
    return depth_mm, _edge_distance(depth_mm, jump, crease)


def find_pieces(
    image: WorkingImage, edges: tuple[np.ndarray, np.ndarray], config: RegionConfig, wider: float
) -> tuple[np.ndarray, int]:
    """Piece number of every pixel (h, w), int32, 0 for none, and the number of pieces, at ``wider``
    times the configured opening."""
    from scipy.ndimage import label

    depth_mm, distance = edges
    radius = wider * config.opening_mm / image.footprint  # px at distance 1
    pieces, count = label(distance * depth_mm > radius)
    _grow(depth_mm, pieces, _jump(image, config), radius)
    pieces[image.taken != ORGAN] = 0  # bridged holes
    return pieces, count


@jit
def _isolated(depth_mm, taken, jump):  # type: ignore[no-untyped-def]
    height, width = depth_mm.shape
    isolated = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            if taken[v, u]:
                continue
            z = depth_mm[v, u]
            most = jump.slope * z + jump.noise * z * z
            near = 0
            for dv in range(-1, 2):
                for du in range(-1, 2):
                    y, x = v + dv, u + du
                    if 0 <= y < height and 0 <= x < width:
                        near += taken[y, x] == 0 and abs(depth_mm[y, x] - z) < most
                    else:
                        near += 1  # outside: unknown
            isolated[v, u] = near - 1 < _FEWEST_NEIGHBOURS
    return isolated


@jit
def _without_holes(depth_mm, taken, jump):  # type: ignore[no-untyped-def]
    """The remaining depths (NaN otherwise), short holes along a row bridged where its ends
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
                if abs(before - z) < jump.slope * z + jump.noise * z * z:
                    for x in range(last + 1, u):
                        out[v, x] = before + (z - before) * (x - last) / (u - last)
            last = u
    return out


@jit
def _edge_distance(depth_mm, jump, crease):  # type: ignore[no-untyped-def]
    """Chamfer distance (Borgefors 1986, doi 10.1016/S0734-189X(86)80047-0) in px to the nearest
    edge; 0 on edges and removed pixels. The image's border is no edge: a frame of pixels around it
    is far from everything."""
    height, width = depth_mm.shape
    far = np.float32(height + width)
    out = np.full((height + 2, width + 2), far, np.float32)
    _mark_jumps(depth_mm, out, np.float32(jump.slope), np.float32(jump.noise))
    if crease[0] > 0:
        _mark_creases(depth_mm, out, np.float32(jump.noise), crease)
    axial, oblique = np.float32(0.955), np.float32(1.369)
    for v in range(1, height + 1):
        for u in range(1, width + 1):
            straight = min(out[v, u - 1], out[v - 1, u]) + axial
            across = min(out[v - 1, u - 1], out[v - 1, u + 1]) + oblique
            out[v, u] = min(out[v, u], straight, across)
    for v in range(height, 0, -1):
        for u in range(width, 0, -1):
            straight = min(out[v, u + 1], out[v + 1, u]) + axial
            across = min(out[v + 1, u - 1], out[v + 1, u + 1]) + oblique
            out[v, u] = min(out[v, u], straight, across)
    return out[1:-1, 1:-1].copy()


@jit
def _mark_jumps(depth_mm, out, slope, noise):  # type: ignore[no-untyped-def]
    """Zero missing pixels and both sides of a jump; ``out`` is larger by 1 on every side."""
    height, width = depth_mm.shape
    for v in range(height):
        for u in range(width):
            z = depth_mm[v, u]
            most = (slope + noise * z) * z
            if not z > 0:
                out[v + 1, u + 1] = 0
            if u + 1 < width and not abs(depth_mm[v, u + 1] - z) < most:
                out[v + 1, u + 1] = out[v + 1, u + 2] = 0
            if v + 1 < height and not abs(depth_mm[v + 1, u] - z) < most:
                out[v + 1, u + 1] = out[v + 2, u + 1] = 0


@jit
def _mark_creases(depth_mm, out, noise, crease):  # type: ignore[no-untyped-def]
    """Zero pixels where the surface lies deeper than on both sides."""
    height, width = depth_mm.shape
    least, reach_mm = np.float32(2 * crease[0]), np.float32(crease[1])
    for v in range(height):
        for u in range(width):
            if out[v + 1, u + 1] == 0:
                continue
            z = depth_mm[v, u]
            r = max(int(reach_mm / z + np.float32(0.5)), 1)
            if not (r <= v < height - r and r <= u < width - r):
                continue
            d = (r * 7) // 10
            twice = 2 * z - least - 2 * noise * z * z  # NaN of a neighbour compares as no crease
            if (
                depth_mm[v, u - r] + depth_mm[v, u + r] < twice
                or depth_mm[v - r, u] + depth_mm[v + r, u] < twice
                or depth_mm[v - d, u - d] + depth_mm[v + d, u + d] < twice
                or depth_mm[v - d, u + d] + depth_mm[v + d, u - d] < twice
            ):
                out[v + 1, u + 1] = 0


@jit
def _grow(depth_mm, pieces, jump, radius):  # type: ignore[no-untyped-def]
    """Grow all cores at the same pace, a pixel a round, never across a jump."""
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
        most = jump.slope * z + jump.noise * z * z
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
