"""How the instrument goes through a plan's cuts: from which side, how deep, in which pieces."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack.plan.arms.situation import Situation
from tumortrack.plan.arms.tracks import solve
from tumortrack.plan.motions import CUTTER
from tumortrack.plan.values import Cut, Layer

STEP_MM = 2.0  # between poses on a cut
_AIR_STEP_MM = 5.0  # on the straight way in and out
_LINK_MM = 12.0  # strokes whose ends are no farther apart are one pass
_CLEAR_MM = 12.0  # the tip is this far outside the organ before it goes elsewhere
_CORNER = np.cos(np.radians(40.0))  # sharper ones are not rounded: the tip stops there
_YAWS = 24
_PROBES = 16  # points of a pass at which directions are compared
_TISSUE_BIN_MM = 3.0  # differences in cut tissue below this do not count
_WALL_MM = 1.5  # the outline itself counts as part of the piece


@dataclass(frozen=True, eq=False)
class Pass:
    """Strokes that are made in one go. ``points_mm``: the tip's way (n, 3)."""

    points_mm: Float64[np.ndarray, "n 3"]


def passes(cuts: tuple[Cut, ...]) -> list[Pass]:
    """Strokes one after the other, joined where the next begins beside the end of the last."""
    ways: list[np.ndarray] = []
    for cut in cuts:
        if ways and np.linalg.norm(ways[-1][-1] - cut.path_mm[0]) <= _LINK_MM:
            ways[-1] = np.concatenate([ways[-1], cut.path_mm])
        else:
            ways.append(np.array(cut.path_mm))
    return [Pass(_resampled(way, STEP_MM)) for way in ways]


class Tissue:
    """Sections of organ and piece at a height, as polygons."""

    def __init__(self, layers: tuple[Layer, ...], organ: Mesh) -> None:
        from tumortrack.core.solids import solid_of

        self._layers, self._solid = layers, solid_of(organ, "the organ's surface")
        self.organ = lru_cache(maxsize=None)(self._organ)
        self.healthy = lru_cache(maxsize=None)(self._healthy)

    def _organ(self, height_mm: float) -> Any:
        """The organ's section at this height."""
        import shapely

        rings = self._solid.slice(height_mm).to_polygons()
        # Even-odd: holes come as rings of their own.
        section = shapely.Polygon()
        for ring in rings:
            section = section.symmetric_difference(shapely.Polygon(ring).buffer(0))
        return section

    def _healthy(self, height_mm: float) -> Any:
        """That section without the piece that is to come away."""
        import shapely

        rings = [
            shapely.Polygon(ring).buffer(_WALL_MM)
            for layer in self._layers
            if layer.bottom_mm - _WALL_MM <= height_mm <= layer.top_mm + _WALL_MM
            for ring in layer.rings_mm
        ]
        return self.organ(height_mm).difference(shapely.union_all(rings))

    def back_out_mm(self, tip_mm: Float64[np.ndarray, " 3"], yaw_rad: float) -> float:
        """How far straight back the tip leaves the organ for good."""
        import shapely

        ray = self._line(tip_mm, yaw_rad, 1000.0)
        inside = shapely.get_coordinates(shapely.intersection(ray, self.organ(float(tip_mm[2]))))
        if not len(inside):
            return 0.0
        return float(np.linalg.norm(inside - tip_mm[:2], axis=1).max())

    def cut_mm(
        self, tips_mm: Float64[np.ndarray, "n 3"], yaw_rad: float, length_mm: float
    ) -> float:
        """Mean length of the instrument within healthy tissue while its tip is at these places."""
        import shapely

        lines = [self._line(tip, yaw_rad, length_mm) for tip in tips_mm]
        sections = [self.healthy(float(tip[2])) for tip in tips_mm]
        return float(np.mean(shapely.length(shapely.intersection(lines, sections))))

    @staticmethod
    def _line(tip_mm: np.ndarray, yaw_rad: float, length_mm: float) -> Any:
        import shapely

        back = tip_mm[:2] - length_mm * np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
        return shapely.LineString([tip_mm[:2], back])


def directions(one: Pass, tissue: Tissue, situation: Situation) -> list[float]:
    """Where the instrument may point during a pass (yaw, radians), the best first.

    First what cuts least healthy tissue beside the outline, then what turns the arm's joints least
    from where they are; directions in which the first point is out of reach are left out.
    """
    config = situation.cell.config
    probes = one.points_mm[:: max(1, len(one.points_mm) // _PROBES)]
    length = config.electrode_mm + config.pencil_mm
    tip = situation.cell.tips(situation.joints_rad)[CUTTER]
    yaws = np.arctan2(tip[1, 0], tip[0, 0]) + np.linspace(0, 2 * np.pi, _YAWS, endpoint=False)
    scores = []
    for yaw in yaws:
        turns = solve(situation, poses(one.points_mm[:1], yaw)[0]) - situation.here_rad
        if len(turns):
            bins = round(tissue.cut_mm(probes, yaw, length) / _TISSUE_BIN_MM)
            scores.append((bins, float(np.abs(turns).max(1).min()), float(yaw)))
    return [yaw for *_, yaw in sorted(scores)]


def in_and_out(
    one: Pass, tissue: Tissue, yaw_rad: float
) -> tuple[Float64[np.ndarray, "i 3"], Float64[np.ndarray, "o 3"]]:
    """The tip's straight ways to the first point and back from the last, along the instrument's
    own axis: it opens no more than it occupies."""
    ahead = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
    ways = []
    for tip in (one.points_mm[0], one.points_mm[-1]):
        far = tissue.back_out_mm(tip, yaw_rad) + _CLEAR_MM
        steps = int(np.ceil(far / _AIR_STEP_MM)) + 1
        ways.append(tip - np.linspace(0, far, steps)[:, None] * ahead)
    return ways[0][::-1], ways[1]


def poses(tips_mm: Float64[np.ndarray, "n 3"], yaw_rad: float) -> Float64[np.ndarray, "n 4 4"]:
    """``table_from_tip`` of a level instrument that points so."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.array([rigid(turn, tip) for tip in tips_mm])


def smooth_runs(points_mm: Float64[np.ndarray, "n 3"]) -> list[slice]:
    """Pieces of a way without sharp corners; each begins where the one before ends."""
    edges = np.diff(points_mm, axis=0)
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    corners = np.flatnonzero((edges[1:] * edges[:-1]).sum(1) < _CORNER) + 1
    ends = [0, *corners.tolist(), len(points_mm) - 1]
    return [slice(a, b + 1) for a, b in itertools.pairwise(ends)]


def _resampled(way_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """Points on a polyline no farther apart than a step; its own points stay, doubles go."""
    way_mm = way_mm[np.r_[True, np.linalg.norm(np.diff(way_mm, axis=0), axis=1) > 1e-6]]
    pieces = [
        np.linspace(a, b, int(np.ceil(np.linalg.norm(b - a) / step_mm)) + 1)[:-1]
        for a, b in itertools.pairwise(way_mm)
    ]
    return np.concatenate([*pieces, way_mm[-1:]])
