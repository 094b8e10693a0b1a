"""Our method: the margin kept in all directions, wider where the estimate is uncertain.

The tumor is grown by its margin as a solid; what lies straight above that comes away too, so that
the piece can be lifted. Its side is cut in level layers from the top down, only where there is
organ, and its floor by strokes side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float, Float64
from numpy.linalg import norm
from scipy.ndimage import binary_closing, minimum_filter
from skimage.measure import find_contours

from tumortrack.core.compiled import njit
from tumortrack.core.errors import NoPlan
from tumortrack.core.geometry import spread_over
from tumortrack.core.types import Mesh
from tumortrack_resection.outline import arcs, evenly_round, first_in_cell, polygon_of, rings_of
from tumortrack_resection.values import (
    Cut,
    CutLayer,
    Direction,
    Located,
    MethodResult,
    ResectionConfig,
    Rings,
    name_of,
)

# Balls of the margin at a triangle's corners, sqrt(6 gap margin) apart, leave this gap between.
_GAP_MM = 0.1
# Cells of outlines, which are interpolated; and of surface points, one in each. Both are finer for
# a narrow margin, so that it is kept to a tenth of a millimetre.
_CELL_MM, _CELL_SHARE = 1.0, 0.4
_THIN_MM, _THIN_SHARE = 0.7, 0.2
_SLACK_MM = 2.0  # the organ may reach so much higher, or lower, than estimated
_COLUMN_MM = 2.0  # of the organ's upper and lower surface
_EDGE_MM = 3.0  # of triangles: so few columns between vertices take their neighbours' heights
_SMOOTH_MM = 0.05  # outlines lose corners smaller than this
_FAR_MM = 1e3
_LEAST_MM2 = 1.0  # a smaller rest of a floor needs no stroke

Heights = tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]  # lowest and highest, mm
_Grown = tuple[np.ndarray, np.ndarray]  # points of the tumor, and the margin that each needs, mm


def margin_plan(located: Located, label: int, config: ResectionConfig) -> MethodResult:
    """The piece, its strokes, both from the top down, and where to hold; table frame, mm. Raises
    NoPlan: the margin with its uncertainty is wider than allowed; there is nothing to cut."""
    columns, tumor = Columns.of(located.organ), located.of(label)
    layers = _layers(_grown_tumor(located, label, config), columns, config.layer_mm)
    slabs = list(zip(layers, (*layers[1:], None), strict=True))
    cuts: list[Cut] = []
    for layer, below in slabs if config.order == "down" else reversed(slabs):
        sweep, last = (cuts[-1].sweep + 1, cuts[-1].path_mm[-1]) if cuts else (1, None)
        cuts += _in_turn(_strokes(layer, below, columns, config), sweep, last, config.direction)
    if not cuts:
        raise NoPlan("the organ does not reach the tumor's margin; there is nothing to cut.")
    # The cup holds the surface straight above the tumor's centre of mass.
    x, y, _ = tumor.mean(0)
    high = columns.at(np.array([[x, y]], float))[1][0]
    top = tumor[:, 2].max() if np.isnan(high) else high
    return layers, tuple(cuts), np.array([x, y, top], float)


def _grown_tumor(located: Located, label: int, config: ResectionConfig) -> _Grown:
    """Points of the tumor's surface, and their margins."""
    name = name_of(label)
    mesh = located.meshes[name]
    margins = np.full(len(mesh.vertices_mm), config.margin_mm)
    if config.sigmas > 0:
        if name not in located.std_mm:
            raise NoPlan(
                "the estimate does not say how unsure it is, so its uncertainty can't be added to "
                "the margin. Use a model of preset clinic, or sigmas 0."
            )
        margins = margins + config.sigmas * located.std_mm[name]
    if (widest := float(margins.max())) > config.most_margin_mm:
        raise NoPlan(
            f"the estimate is so unsure that the margin would be {widest:.1f} mm wide; allowed are "
            f"{config.most_margin_mm:g} mm. Look from nearer, or uncover more of the organ."
        )
    size_mm = min(_THIN_MM, _THIN_SHARE * float(margins.min()))
    edge_mm = float(np.sqrt(6 * _GAP_MM * margins.min()))
    spread = spread_over(np.column_stack([mesh.vertices_mm, margins]), mesh.faces, edge_mm)
    spread = spread[np.argsort(-spread[:, 3], kind="stable")]  # of each cube, the widest stays
    keep = first_in_cell(np.floor(spread[:, :3] / size_mm).astype(np.int64))
    return spread[keep, :3], spread[keep, 3]


@dataclass(frozen=True, eq=False)
class Columns:
    """The organ's lowest and highest point over a grid of the table's plane, mm; NaN outside it.
    ``first_mm``: the middle of the first cell."""

    first_mm: Float64[np.ndarray, " 2"]
    lowest_mm: Float64[np.ndarray, "i j"]
    highest_mm: Float64[np.ndarray, "i j"]

    @classmethod
    def of(cls, organ: Mesh) -> Columns:
        """From the organ's surface."""
        points = organ.spread_mm(_EDGE_MM)
        low = points[:, :2].min(0) - 2 * _COLUMN_MM
        cell = np.round((points[:, :2] - low) / _COLUMN_MM).astype(int)
        lowest = np.full(tuple(cell.max(0) + 3), np.inf)
        highest = -lowest
        np.minimum.at(lowest, tuple(cell.T), points[:, 2])
        np.maximum.at(highest, tuple(cell.T), points[:, 2])
        return cls(low, _spread(lowest), -_spread(-highest))

    def at(self, points_mm: Float[np.ndarray, "n 2"]) -> Heights:
        """Lowest and highest point of the organ below and above each place."""
        cell = np.round((points_mm - self.first_mm) / _COLUMN_MM).astype(int)
        inside = ((cell >= 0) & (cell < self.lowest_mm.shape)).all(1)
        place = tuple(np.where(inside, cell.T, 0))
        low, high = self.lowest_mm[place], self.highest_mm[place]
        return np.where(inside, low, np.nan), np.where(inside, high, np.nan)

    def within(self, points_mm: np.ndarray, bottom_mm: float, top_mm: float) -> np.ndarray:
        """Where there is organ between two heights, or nearly: the estimate may be a little off,
        and a thin bridge would hold the piece."""
        low, high = self.at(points_mm)
        return (high + _SLACK_MM > bottom_mm) & (low - _SLACK_MM < top_mm)  # False at NaN


def _spread(values: np.ndarray) -> np.ndarray:
    """Empty cells take the least of their neighbours, if those surround them."""
    known = np.isfinite(values)
    filled = np.where(known, values, minimum_filter(np.where(known, values, np.inf), 5))
    closed = binary_closing(known, iterations=2) | known
    return np.where(closed & np.isfinite(filled), filled, np.nan)


def _layers(grown: _Grown, columns: Columns, layer_mm: float) -> tuple[CutLayer, ...]:
    """Slabs from the top down; each has the outline at its upper end, where it is widest."""
    points, margins = grown
    floor = float((points[:, 2] - margins).min())
    outermost = _outlines(grown, np.array([np.inf]))[0]
    if not outermost:
        raise NoPlan("the tumor's outline has no area; locate it again with more points.")
    high = columns.at(np.concatenate(outermost))[1]
    if np.isnan(high).all():
        raise NoPlan("the organ does not reach the tumor's margin; there is nothing to cut.")
    n = max(1, int(np.ceil((np.nanmax(high) - floor) / layer_mm)))
    bottoms = floor + (np.nanmax(high) - floor) / n * np.arange(n)
    tops = np.append(bottoms[1:], np.inf)
    slabs = zip(bottoms, tops, [*_outlines(grown, tops[:-1]), outermost], strict=True)
    layers = [CutLayer(float(low), float(top), rings) for low, top, rings in slabs if rings]
    return tuple(reversed(layers))


def _outlines(grown: _Grown, levels_mm: np.ndarray) -> list[Rings]:
    """Rings of what comes away at each height."""
    points, margins = grown
    cell = min(_CELL_MM, _CELL_SHARE * float(margins.min()))
    room = float(margins.max()) + 4 * cell
    first = points[:, :2].min(0) - room
    shape = np.ceil((points[:, :2].max(0) + room - first) / cell).astype(int) + 1
    fields = np.full((len(levels_mm), *shape), _FAR_MM)
    _outline_fields(points, margins, levels_mm, first, cell, fields)
    outlines = []
    for field in fields:
        # Far cells hold no distance, but all next to the outline are nearer than this.
        contours = find_contours(np.minimum(field, 2 * cell), 0.0)
        area = polygon_of(first + c * cell for c in contours if len(c) > 3)
        outlines.append(rings_of(shapely.simplify(area, _SMOOTH_MM, preserve_topology=False)))
    return outlines


def _strokes(
    layer: CutLayer, below: CutLayer | None, columns: Columns, config: ResectionConfig
) -> list[Cut]:
    """A layer's strokes at its lower end: along its outline, and over its floor where that is not
    the next layer's."""
    area = polygon_of(layer.rings_mm)
    open_floor = area if below is None else area.difference(polygon_of(below.rings_mm))
    z, lead = layer.bottom_mm, int(np.ceil(config.lead_mm / config.spacing_mm))
    strokes = []
    for ring in layer.rings_mm:
        flat = evenly_round(ring, config.spacing_mm)
        there = columns.within(flat, z, layer.top_mm)
        strokes += [Cut.level(1, line, z, "wall") for line in arcs(flat, there, lead)]
    inset = area.buffer(-config.stroke_mm, quad_segs=4)
    while inset.intersection(open_floor).area > _LEAST_MM2:
        for ring in rings_of(inset):
            flat = evenly_round(ring, config.spacing_mm)
            there = shapely.contains_xy(open_floor, *flat.T) & columns.within(flat, z, z)
            strokes += [Cut.level(1, line, z, "floor") for line in arcs(flat, there, lead)]
        inset = inset.buffer(-config.stroke_mm, quad_segs=4)
    return strokes


def _in_turn(
    strokes: list[Cut], sweep: int, last: np.ndarray | None, direction: Direction
) -> list[Cut]:
    """Walls first, then the floor; each time the stroke that begins nearest to where the one before
    ended. Outlines run anticlockwise, seen from above."""
    turns = {"shortest": (1, -1), "clockwise": (-1,), "anticlockwise": (1,)}[direction]
    ordered = []
    for kind in ("wall", "floor"):
        left = [stroke for stroke in strokes if stroke.kind == kind]
        while left:
            gaps = [
                (0.0 if last is None else float(norm(stroke.path_mm[::turn][0] - last)), n, -turn)
                for n, stroke in enumerate(left)
                for turn in turns
            ]
            _, n, turned = min(gaps)
            stroke = left.pop(n)
            ordered.append(replace(stroke, sweep=sweep, path_mm=stroke.path_mm[::-turned]))
            last = ordered[-1].path_mm[-1]
    return ordered


@njit(nogil=True)
def _outline_fields(points, margins, levels, first, cell, fields):  # type: ignore[no-untyped-def]
    """Into ``fields`` (k, nx, ny), large where nothing is near: for each of k levels (mm) the
    signed distance (mm, near 0) to the outline of what comes away there.

    What comes away at a height is all that lies above the tumor, points (n, 3) grown by margins
    (n,): of each point a disc, as wide as its ball of the margin is at that height, and the whole
    ball's width above its middle. ``first``: x and y of the first grid point; ``cell``: between
    grid points.
    """
    n_levels, nx, ny = fields.shape
    for i in range(len(points)):
        x, y, z = points[i]
        margin = margins[i]
        for level in range(n_levels):
            rise = z - levels[level]
            if rise >= margin:
                continue
            radius = margin if rise <= 0 else np.sqrt(margin * margin - rise * rise)
            reach, core = radius + 2 * cell, max(0.0, radius - 2 * cell)
            left = max(0, int(np.ceil((x - reach - first[0]) / cell)))
            right = min(nx - 1, int(np.floor((x + reach - first[0]) / cell)))
            low = max(0, int(np.ceil((y - reach - first[1]) / cell)))
            high = min(ny - 1, int(np.floor((y + reach - first[1]) / cell)))
            for a in range(left, right + 1):
                across = first[0] + a * cell - x
                for b in range(low, high + 1):
                    along = first[1] + b * cell - y
                    square = across * across + along * along
                    if square >= reach * reach:
                        continue
                    # Deep inside no exact distance is needed.
                    off = core - radius if square < core * core else np.sqrt(square) - radius
                    if off < fields[level, a, b]:
                        fields[level, a, b] = off
