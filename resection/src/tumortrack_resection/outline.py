"""Outlines in the table's plane, and the paper's method (its section "Integration with Robotic
Resection"), which knows the tip alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from jaxtyping import Float, Float64, Int
from scipy.ndimage import binary_erosion, label
from scipy.spatial import ConvexHull, Delaunay, QhullError
from shapely import Polygon
from shapely.geometry.polygon import orient

from tumortrack.core.errors import NoPlan
from tumortrack_resection.values import Cut, Located, ResectionConfig

_CELL = 2.0  # of a grid that separates inner from outer points, in sqrt(area / number of points)
_EDGE = 5.0  # longest edge of a hull, in sqrt(area / number of points)
_SPARSE = 6  # one inner point stays in each block of so many cells
_MOST = 10_000  # points used
_SAME_MM = 0.01  # points nearer to each other are one
_LEAST_MM2 = 1.0  # smaller pieces of an outline are left out
_SMOOTH = 16  # corners of a quarter circle: 5 mm of margin are exact to 0.01 mm


def concave_hull(points_mm: Float[np.ndarray, "n 2"]) -> Polygon:
    """The outline of a cloud's largest cluster. Edges are at most 5 sqrt(A / n) long, with the
    convex hull's area A: GEOS's fixed ratio would mean another length at every density. Raises
    NoPlan: fewer than three points, or all on a line."""
    points = np.asarray(points_mm, float)
    if len(points) > _MOST:
        points = points[np.linspace(0, len(points) - 1, _MOST).astype(int)]
    # Points of a grid coincide when projected, and would count several times.
    points = points[first_in_cell(np.round(points / _SAME_MM).astype(np.int64))]
    try:
        typical_mm = float(np.sqrt(ConvexHull(points).volume / len(points)))
        outer = _outer(points, _CELL * typical_mm)
        corners = outer[Delaunay(outer).simplices]
    except (QhullError, ValueError, IndexError) as error:
        raise NoPlan(
            f"{len(points_mm)} points that lie on a line, or are too few, have no outline."
        ) from error
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    span = max(float(np.ptp(lengths)), 1e-9)
    ratio = float(np.clip((_EDGE * typical_mm - lengths.min()) / span, 0.0, 1.0))
    return _largest(shapely.concave_hull(shapely.MultiPoint(outer), ratio=ratio))


def grown(outline: Polygon, margin_mm: float) -> Polygon:
    return _largest(outline.buffer(margin_mm, quad_segs=_SMOOTH))


def common(a: Polygon, b: Polygon) -> Polygon:
    return _largest(a.intersection(b))


def evenly(ring_mm: Float[np.ndarray, "n 2"], spacing_mm: float) -> Float64[np.ndarray, "m 2"]:
    """Points at equal distances along a line, ends included; at most ``spacing_mm`` apart."""
    line = shapely.LineString(ring_mm)
    shares = np.linspace(0, 1, max(2, int(np.ceil(line.length / spacing_mm)) + 1))
    return shapely.get_coordinates(shapely.line_interpolate_point(line, shares, normalized=True))


def published_cuts(
    located: Located, label: int, config: ResectionConfig
) -> tuple[tuple[Cut, ...], Float64[np.ndarray, "n 2"], float, Float64[np.ndarray, " 3"]]:
    """The paper's strokes (its section II-D), the outline and the lower end of the piece, and
    the grasp point. The tumor's points are projected on the table's plane; their concave hull,
    grown by the margin and clipped to the organ's projection, is cut along at the middle of the
    tumor's bounding box, and on its lower face. Held is the tumor's centre of mass, carried up
    to the top of the box. NoPlan: there is no contour."""
    tumor = located.points_of(label)
    low, high = float(tumor[:, 2].min()), float(tumor[:, 2].max())
    wide = grown(concave_hull(tumor[:, :2]), config.margin_mm)
    both = common(wide, concave_hull(located.points_mm[:, :2]))
    ring = np.array(orient(both).exterior.coords)[:-1]
    flat = evenly(np.concatenate([ring, ring[:1]]), config.spacing_mm)
    heights = ((low + high) / 2, low)
    cuts = tuple(
        Cut(sweep, np.column_stack([flat, np.full(len(flat), height)]))
        for sweep, height in enumerate(heights, start=1)
    )
    x, y, _ = tumor.mean(0)
    return cuts, ring, low, np.array([x, y, high], float)


def _largest(area: Any) -> Polygon:
    """The largest polygon, without its holes: what lies in them comes away too."""
    polygons = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]
    largest = max(polygons, key=lambda piece: piece.area, default=Polygon())
    if largest.area < _LEAST_MM2:
        raise NoPlan("the outline has no area; there is no contour to cut along.")
    return Polygon(largest.exterior)


def first_in_cell(cells: Int[np.ndarray, "n d"]) -> Int[np.ndarray, " m"]:
    """Numbers of the points that are the first in their cells, ordered by cell."""
    shifted = cells - cells.min(0, initial=0)
    keys = np.ravel_multi_index(tuple(shifted.T), tuple(shifted.max(0, initial=0) + 1))
    return np.unique(keys, return_index=True)[1]


def _outer(points: np.ndarray, cell_mm: float) -> np.ndarray:
    """Points of the largest cluster that matter for its outline: those in cells next to an empty
    one, and a few others."""
    i, j = ((points - points.min(0)) / cell_mm).astype(int).T
    some = np.zeros((i.max() + 1, j.max() + 1), bool)
    some[i, j] = True
    clusters = label(some, np.ones((3, 3)))[0][i, j]
    mine = clusters == np.bincount(clusters).argmax()
    points, i, j = points[mine], i[mine], j[mine]
    keep = ~binary_erosion(some, np.ones((3, 3)))[i, j]
    keep[first_in_cell(np.stack([i, j], axis=1) // _SPARSE)] = True
    return points[keep]
