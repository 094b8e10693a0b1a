"""How the instrument goes through a plan's cuts: from which side, how deep, in which pieces."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack.plan.arms.body import ELECTRODE_RADIUS_MM, PENCIL_RADIUS_MM
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.values import Cut, ResectionPlan

_STEP_MM = 2.0  # between poses on a cut
_AIR_STEP_MM = 5.0  # on the straight way in and out
_LINK_MM = 12.0  # strokes whose ends are no farther apart are one pass
_CLEAR_MM = 6.0  # the tip is this far from the organ before it goes elsewhere
_CORNER = np.cos(np.radians(40.0))  # sharper ones are not rounded: the tip stops there
_WALL_MM = 1.5  # the outline itself counts as part of the piece
_FAR_MM = 1000.0


def passes(cuts: tuple[Cut, ...]) -> list[Float64[np.ndarray, "n 3"]]:
    """The tip's ways, closely spaced: strokes one after the other, joined where the next begins
    beside the end of the last."""
    ways: list[np.ndarray] = []
    for cut in cuts:
        if ways and np.linalg.norm(ways[-1][-1] - cut.path_mm[0]) <= _LINK_MM:
            ways[-1] = np.concatenate([ways[-1], cut.path_mm])
        else:
            ways.append(np.array(cut.path_mm))
    return [_resampled(way, _STEP_MM) for way in ways]


class Surroundings:
    """What is where at a height: organ, piece and grasper, as polygons seen from above."""

    def __init__(self, organ: Mesh, config: CellConfig, plan: ResectionPlan | None = None) -> None:
        from tumortrack.imaging.meshes import solid_of

        self._solid = solid_of(organ, "the organ's surface")
        self._layers = () if plan is None else plan.layers
        self._grasp_mm = None if plan is None else plan.grasp_mm
        self._config = config
        # A plan asks for the same few heights again and again.
        self._organ = lru_cache(maxsize=None)(self._section)
        self._healthy = lru_cache(maxsize=None)(self._without_piece)
        self._bars_electrode = lru_cache(maxsize=None)(self._grasper)
        self._bars_pencil = lru_cache(maxsize=None)(self._round_pencil)
        self._not_clear = lru_cache(maxsize=None)(self._within_clearance)

    def depth_mm(self, point_mm: Float64[np.ndarray, " 3"]) -> float:
        """How much organ there is straight above a point."""
        import shapely

        x, y, z = (float(value) for value in point_mm)
        above = [h for h in range(2, 200, 2) if shapely.contains_xy(self._organ(z + h), x, y)]
        return float(max(above, default=0))

    def back_out_mm(self, tip_mm: Float64[np.ndarray, " 3"], yaw_rad: float) -> float:
        """How far straight back until the tip is clear of organ and grasper for good."""
        import shapely

        ray = _lines(tip_mm[None], np.array([yaw_rad]), _FAR_MM)[0, 0]
        within = shapely.intersection(ray, self._not_clear(float(tip_mm[2])))
        inside = shapely.get_coordinates(within)
        return float(np.linalg.norm(inside - tip_mm[:2], axis=1).max(initial=0.0))

    def tissue_mm(
        self, tips_mm: Float64[np.ndarray, "n 3"], yaws_rad: Float64[np.ndarray, " y"]
    ) -> Float64[np.ndarray, "y n"]:
        """Length of the instrument in healthy tissue, outside of the piece, at these places."""
        import shapely

        length = self._config.electrode_mm + self._config.pencil_mm
        lines = _lines(tips_mm, yaws_rad, length)
        return shapely.length(shapely.intersection(lines, self._at(self._healthy, tips_mm)))

    def fits(
        self, tips_mm: Float64[np.ndarray, "n 3"], yaws_rad: Float64[np.ndarray, " y"]
    ) -> Bool[np.ndarray, "y n"]:
        """Whether the level instrument keeps clear of the grasper, and its grip of the organ."""
        import shapely

        whole = self._config.electrode_mm + self._config.pencil_mm
        electrode = _lines(tips_mm, yaws_rad, self._config.electrode_mm)
        pencil = _lines(tips_mm, yaws_rad, whole, self._config.electrode_mm)
        return ~(
            shapely.intersects(electrode, self._at(self._bars_electrode, tips_mm))
            | shapely.intersects(pencil, self._at(self._bars_pencil, tips_mm))
        )

    @staticmethod
    def _at(section: Any, tips_mm: np.ndarray) -> list:
        return [section(float(height)) for height in tips_mm[:, 2]]

    def _section(self, height_mm: float) -> Any:
        """The organ's section at this height."""
        import shapely

        # Even-odd: holes come as rings of their own.
        section = shapely.Polygon()
        for ring in self._solid.slice(height_mm).to_polygons():
            section = section.symmetric_difference(shapely.Polygon(ring).buffer(0))
        return section.simplify(0.1)

    def _within(self, height_mm: float, margin_mm: float) -> Any:
        """All that lies within a margin of the organ at this height, and a little more."""
        import shapely

        heights = (height_mm - margin_mm, height_mm, height_mm + margin_mm)
        return shapely.union_all([self._organ(h) for h in heights]).buffer(margin_mm, 4)

    def _without_piece(self, height_mm: float) -> Any:
        import shapely

        rings = [
            shapely.Polygon(ring).buffer(_WALL_MM)
            for layer in self._layers
            if layer.bottom_mm - _WALL_MM <= height_mm <= layer.top_mm + _WALL_MM
            for ring in layer.rings_mm
        ]
        return self._organ(height_mm).difference(shapely.union_all(rings))

    def _grasper(self, height_mm: float) -> Any:
        return self._round_cup(height_mm, ELECTRODE_RADIUS_MM + self._config.contact_mm)

    def _round_cup(self, height_mm: float, around_mm: float) -> Any:
        import shapely

        if self._grasp_mm is None or height_mm + around_mm < self._grasp_mm[2]:
            return shapely.Polygon()
        radius = self._config.cup_radius_mm + around_mm
        return shapely.Point(self._grasp_mm[:2]).buffer(radius, 6)

    def _within_clearance(self, height_mm: float) -> Any:
        import shapely

        around = ELECTRODE_RADIUS_MM + self._config.clearance_mm
        cup = self._round_cup(height_mm, around + 1.0)
        return shapely.union(self._within(height_mm, _CLEAR_MM), cup)

    def _round_pencil(self, height_mm: float) -> Any:
        import shapely

        margin = PENCIL_RADIUS_MM + self._config.organ_clearance_mm
        # A little less than what collides: the exact test comes later.
        organ = self._within(height_mm, 0.8 * margin)
        cup = self._round_cup(height_mm, PENCIL_RADIUS_MM + self._config.clearance_mm)
        return shapely.union(organ, cup)


@dataclass(frozen=True, eq=False)
class Leg:
    """A piece of a pass in one direction: the tip's way in, along the cut and back out, mm."""

    yaw_rad: float
    enter_mm: Float64[np.ndarray, "i 3"]
    cut_mm: Float64[np.ndarray, "n 3"]
    leave_mm: Float64[np.ndarray, "o 3"]

    @property
    def poses(self) -> Float64[np.ndarray, "m 4 4"]:
        """``table_from_tip`` along the whole leg; corners are there once."""
        tips = np.concatenate([self.enter_mm[:-1], self.cut_mm, self.leave_mm[1:]])
        return level_poses(tips, self.yaw_rad)

    @property
    def runs(self) -> list[tuple[slice, bool]]:
        """Pieces of ``poses`` that are gone without a stop, and whether they cut; each begins
        where the one before ends."""
        first, n = len(self.enter_mm) - 1, len(self.cut_mm)
        cuts = [
            (slice(first + run.start, first + run.stop), True) for run in _smooth_runs(self.cut_mm)
        ]
        end = first + n - 1
        ways = [(slice(0, first + 1), False), *cuts, (slice(end, end + len(self.leave_mm)), False)]
        return [(way, cutting) for way, cutting in ways if way.stop - way.start > 1]


def leg(cut_mm: Float64[np.ndarray, "n 3"], yaw_rad: float, around: Surroundings) -> Leg:
    """With straight ways to the first point and back from the last, along the instrument's own
    axis: it opens no more than it occupies."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    ways = []
    for tip in (cut_mm[0], cut_mm[-1]):
        far = max(around.back_out_mm(tip, yaw_rad), _AIR_STEP_MM)
        steps = int(np.ceil(far / _AIR_STEP_MM)) + 1
        ways.append(tip - np.linspace(0, far, steps)[:, None] * ahead)
    return Leg(yaw_rad, ways[0][::-1], cut_mm, ways[1])


def level_poses(
    tips_mm: Float64[np.ndarray, "n 3"], yaw_rad: float
) -> Float64[np.ndarray, "n 4 4"]:
    """``table_from_tip`` of a level instrument that points so."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([rigid(turn, tip) for tip in tips_mm])


def _lines(
    tips_mm: np.ndarray, yaws_rad: np.ndarray, to_mm: float, from_mm: float = 0.0
) -> np.ndarray:
    """Lines (y, n) that go back from each tip against each direction, seen from above."""
    import shapely

    ahead = np.stack([np.cos(yaws_rad), np.sin(yaws_rad)], 1)[:, None]
    ends = [tips_mm[None, :, :2] - far * ahead for far in (from_mm, to_mm)]
    return shapely.linestrings(np.stack(ends, axis=2))


def _smooth_runs(points_mm: np.ndarray) -> list[slice]:
    """Pieces of a way without sharp corners; each begins where the one before ends."""
    if len(points_mm) < 3:
        return [slice(0, len(points_mm))]
    edges = np.diff(points_mm, axis=0)
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    corners = np.flatnonzero((edges[1:] * edges[:-1]).sum(1) < _CORNER) + 1
    ends = [0, *corners.tolist(), len(points_mm) - 1]
    return [slice(a, b + 1) for a, b in itertools.pairwise(ends)]


def _resampled(way_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """Points on a polyline, about a step apart; its corners stay, doubles go."""
    way_mm = way_mm[np.r_[True, np.linalg.norm(np.diff(way_mm, axis=0), axis=1) > 1e-6]]
    pieces = [
        np.linspace(a, b, int(np.ceil(np.linalg.norm(b - a) / step_mm)) + 1)[:-1]
        for a, b in itertools.pairwise(way_mm)
    ]
    return np.concatenate([*pieces, way_mm[-1:]])
