"""How the facets of a piece are cut, where the cup holds it, and how it comes out."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float64
from scipy.spatial import cKDTree

from tumortrack_resection.facets import (
    EDGE_MM,
    UP,
    Piece,
    Planes,
    Tools,
    Vector,
    across,
    inside,
    sphere,
)
from tumortrack_resection.outline import evenly
from tumortrack_resection.values import Cut, Located, ResectionConfig, name_of

_THROUGH_MM = 3.0  # and beyond the organ's surface: it may lie deeper than estimated
_COLUMN_MM = 2.0  # of the organ's highest points
_FINE_DEG, _TURN_DEG = 2.0, 13.0  # between directions of the electrode in its facet
_LEAST_SLOPE = 0.02  # sine between the electrode and another facet: it only moves away from it
_CUP_SLOPE = 0.05  # the same of the cup's way
_CUP_ROOM_MM, _STEEP_MM = 2.0, 6.0  # beside the cup; a slope of 1 counts as so far off
_LEAST_MM2 = 1.0  # a smaller section needs no cut
_DIRECTIONS = 500  # from which the cup may come


class Stroke(NamedTuple):
    """How a facet is cut: the pass, and how deep its electrode is in the organ at most, mm."""

    cut: Cut
    depth_mm: float


class Sections:
    """The organ's sections in planes, each made once: polygons, mm along ``across(normal)``."""

    def __init__(self, solid: Any) -> None:
        self._solid, self._made = solid, dict[tuple[float, ...], Any]()

    def at(self, plane: Float64[np.ndarray, " 4"]) -> Any:
        """By normal and offset."""
        key = tuple(plane.tolist())
        if key not in self._made:
            axes = np.column_stack([[*across(plane[:3]), plane[:3]], np.zeros(3)])
            section = shapely.Polygon()  # even-odd: holes are rings, too
            for ring in self._solid.transform(axes).slice(float(plane[3])).to_polygons():
                section = section.symmetric_difference(shapely.Polygon(ring).buffer(0))
            self._made[key] = section
        return self._made[key]


class Facet:
    """How one facet can be cut. ``section``: of the organ within the piece's other planes, in
    the facet's plane, mm along ``axes`` (2, 3)."""

    def __init__(self, sections: Sections, planes: Planes, number: int) -> None:
        self.number = number  # of its sweep, from 1
        self.normal, self._offset = planes[number - 1, :3], float(planes[number - 1, 3])
        self._rest = np.delete(planes, number - 1, axis=0)
        self.axes = across(self.normal)
        self.section = sections.at(planes[number - 1])
        if self.section.is_empty:
            return
        far = float(np.abs(self.section.bounds).max()) + 1.0
        flat, room = self._rest[:, :3] @ self.axes.T, self._room
        for line, most in zip(flat, room, strict=True):
            self.section = shapely.intersection(self.section, _half_plane(line, most, far))

    @property
    def _room(self) -> Float64[np.ndarray, " k"]:
        return self._rest[:, 3] - self._offset * (self._rest[:, :3] @ self.normal)

    @property
    def empty(self) -> bool:
        return bool(self.section.area < _LEAST_MM2)

    def directions(self, lowest: float = -1.0) -> list[Vector]:
        """From the tip back along the electrode: those for which it cuts nothing but this facet,
        the middle of them first. ``lowest``: their least z."""
        turns = np.radians(np.arange(0, 360, _FINE_DEG))
        back = np.stack([np.cos(turns), np.sin(turns)], 1) @ self.axes
        steep = (back @ self._rest[:, :3].T).max(1, initial=-1.0)  # away from all other planes
        free = (steep <= -_LEAST_SLOPE) & (back[:, 2] >= lowest)
        spread: list[Vector] = []
        for n in np.argsort(steep, kind="stable"):
            apart = all(back[n] @ other < np.cos(np.radians(_TURN_DEG)) for other in spread)
            if free[n] and apart:
                spread.append(back[n])
        return spread

    def stroke(self, back: Vector, config: ResectionConfig) -> Stroke:
        """The tip along the far side of the facet, the electrode all the time in this direction
        from it."""
        aside = np.cross(back, self.normal)
        flat = shapely.transform(
            self.section, lambda points: points @ (self.axes @ np.stack([aside, back]).T)
        )
        low, high = flat.bounds[0], flat.bounds[2]
        at = np.linspace(low, high, max(3, int(np.ceil((high - low) / config.spacing_mm)) + 1))
        at[[0, -1]] += np.array([1, -1]) * 1e-6 * (high - low)
        far = abs(flat.bounds[3]) + abs(flat.bounds[1]) + 1.0
        ends = np.stack([np.column_stack([at, np.full(len(at), y)]) for y in (-far, far)], axis=1)
        cuts = shapely.bounds(shapely.intersection(shapely.linestrings(ends), flat))
        here = ~np.isnan(cuts[:, 1])
        at, tips, exits = at[here], cuts[here, 1], cuts[here, 3]
        hull = _lower_hull(at, tips)

        def tip_at(s: np.ndarray) -> np.ndarray:
            return np.maximum(np.interp(s, *hull) - _THROUGH_MM, self._edge(s, aside, back))

        depth_mm = float((exits - tip_at(at)).max())
        lead = config.lead_mm
        s = np.linspace(at[0] - lead, at[-1] + lead, 4 * len(at) + 8)
        path = np.column_stack([s, tip_at(s)])
        path = _within(path, path[:, 1] - np.interp(s, at, exits) - lead)
        place = self._offset * self.normal
        path_mm = evenly(path, config.spacing_mm) @ np.stack([aside, back]) + place
        return Stroke(Cut(self.number, path_mm, -back), depth_mm)

    def _edge(self, s: np.ndarray, aside: Vector, back: Vector) -> np.ndarray:
        """How far along ``back`` the tip has to stay to cut hardly beyond the next facets."""
        if not len(self._rest):
            return np.full(len(s), -np.inf)
        normals = self._rest[:, :3]
        edges = (self._room[:, None] - np.outer(normals @ aside, s)) / (normals @ back)[:, None]
        return edges.max(0) - EDGE_MM


def _within(path: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """From the first to the last place where ``beyond`` is 0."""
    first, last = np.flatnonzero(beyond <= 0)[[0, -1]]
    ends = []
    for inner, outer in ((first, first - 1), (last, last + 1)):
        if 0 <= outer < len(path):
            share = beyond[inner] / (beyond[inner] - beyond[outer])
            ends.append((path[inner] + share * (path[outer] - path[inner]))[None])
        else:
            ends.append(path[:0])
    return np.concatenate([ends[0], path[first : last + 1], ends[1]])


def _lower_hull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the convex line below points whose x rise."""
    kept: list[int] = []
    for n in range(len(x)):
        while len(kept) > 1:
            a, b = kept[-2:]
            if (y[b] - y[a]) * (x[n] - x[a]) < (y[n] - y[a]) * (x[b] - x[a]):
                break
            kept.pop()
        kept.append(n)
    return x[kept], y[kept]


def _half_plane(line: np.ndarray, most: float, far: float) -> Any:
    """Of the square of +-2 ``far``, the part with ``line`` x <= ``most``."""
    size = float(np.hypot(*line))
    if size < 1e-9:
        return shapely.box(-2 * far, -2 * far, 2 * far, 2 * far) if most >= 0 else shapely.Polygon()
    ahead = line / size
    aside, edge = np.array([-ahead[1], ahead[0]]), min(most / size, 4 * far)
    corners = [edge * ahead + 4 * far * aside, edge * ahead - 4 * far * aside]
    return shapely.Polygon([*corners, *(corner - 9 * far * ahead for corner in corners[::-1])])


def trimmed(solid: Any, planes: Planes, inward_mm: float) -> Any:
    """A solid on the inner sides of planes that are moved inward."""
    for *normal, offset in planes.tolist():
        solid = solid.trim_by_plane((-np.array(normal)).tolist(), inward_mm - offset)
    return solid


def cup_direction(planes: Planes) -> Vector | None:
    """As steeply from above as the piece comes free. None: from nowhere above."""
    directions = np.concatenate([[UP], sphere(_DIRECTIONS, 0.0)])
    free = (directions @ planes[:, :3].T).max(1) <= -_CUP_SLOPE
    if not free.any():
        return None
    return directions[np.where(free, directions[:, 2], -np.inf).argmax()]


def grasp_point(
    located: Located, label: int, piece: Piece, tools: Tools, back: Vector
) -> Vector | None:
    """Where the cup, which comes from ``back``, lands: on a part of the piece that lies free on
    that side, near to the tumor's centre, not steep, and away from what stays. None: nowhere."""
    turn = np.stack([*across(back), back])  # into a frame in which the cup comes from above
    heights, low = _highest(located.organ.spread_mm(_COLUMN_MM) @ turn.T)
    slopes = np.hypot(*np.gradient(heights, _COLUMN_MM))
    cells = np.argwhere(np.isfinite(heights) & np.isfinite(slopes))
    flat = np.column_stack([low + _COLUMN_MM * cells, heights[tuple(cells.T)]])
    middle, places = turn @ located.points_of(label).mean(0), flat @ turn
    off = np.linalg.norm(flat[:, :2] - middle[:2], axis=1) + _STEEP_MM * slopes[tuple(cells.T)]
    for n in located.tumors:
        if n != label and n not in piece.with_it:
            near = cKDTree(located.meshes[name_of(n)].vertices_mm)
            off[near.query(places)[0] < tools.cup_radius_mm + _CUP_ROOM_MM] = np.inf
    for room_mm in (tools.cup_radius_mm + _CUP_ROOM_MM, tools.cup_radius_mm / 2):
        good = inside(piece.planes, places, tools.radius_mm + room_mm) & np.isfinite(off)
        if good.any():
            return places[good][off[good].argmin()]
    return None


def _highest(
    points_mm: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "i j"], Float64[np.ndarray, " 2"]]:
    """The highest z over a grid of x and y, NaN: none; and the middle of the first cell."""
    low = points_mm[:, :2].min(0) - _COLUMN_MM
    cell = np.round((points_mm[:, :2] - low) / _COLUMN_MM).astype(int)
    highest = np.full(tuple(cell.max(0) + 2), -np.inf)
    np.maximum.at(highest, tuple(cell.T), points_mm[:, 2])
    return np.where(np.isfinite(highest), highest, np.nan), low
