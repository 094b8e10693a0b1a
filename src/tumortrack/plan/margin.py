"""Our method: the margin kept in all directions, wider where the estimate is uncertain.

The tumor is grown by its margin as a solid; what lies straight above that comes away too, so that
the piece can be lifted. Its side is cut in level layers from the top down, only where there is
organ, and its floor by strokes side by side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float, Float64, Int, Num
from numpy.linalg import norm
from scipy.ndimage import binary_closing, minimum_filter
from skimage.measure import find_contours

from tumortrack.core.errors import NoPlan
from tumortrack.plan.config import Direction, ResectionConfig
from tumortrack.plan.margin_kernels import outline_fields
from tumortrack.plan.outline import arcs, evenly_round, first_in_cell, polygon_of, rings_of
from tumortrack.plan.values import Cut, CutLayer, Located, MethodResult, Rings, name_of

# Of outlines, which are interpolated; and one surface point in each cube of that size. Both finer
# where the margin is narrow, so that it is kept to a tenth of a millimetre.
_CELL_MM, _CELL_SHARE = 1.0, 0.4
_THIN_MM, _THIN_SHARE = 0.7, 0.2
_SLACK_MM = 2.0  # the organ may reach so much higher, or lower, than was estimated
_COLUMN_MM = 2.0  # of the organ's upper and lower surface
_SMOOTH_MM = 0.05  # outlines lose corners smaller than this
_FAR_MM = 1e3
_LEAST_MM2 = 1.0  # a smaller rest of a floor needs no stroke

Heights = tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]  # lowest and highest, mm
# Points of the tumor, and the margin that each needs, mm
Grown = tuple[Float64[np.ndarray, "n 3"], Num[np.ndarray, " n"]]


def margin_plan(located: Located, label: int, config: ResectionConfig) -> MethodResult:
    """The piece, its strokes, both from the top down, and where to hold; table frame, mm.

    Raises:
        NoPlan: the margin with its uncertainty is wider than allowed; there is nothing to cut.
    """
    columns = Columns.of(located)
    layers = _layers(_grown_tumor(located, label, config), columns, config.layer_mm)
    slabs = list(zip(layers, (*layers[1:], None), strict=True))
    cuts: list[Cut] = []
    for layer, below in slabs if config.order == "down" else reversed(slabs):
        sweep, last = (cuts[-1].sweep + 1, cuts[-1].path_mm[-1]) if cuts else (1, None)
        cuts += _in_turn(_strokes(layer, below, columns, config), sweep, last, config.direction)
    if not cuts:
        raise NoPlan("the organ does not reach the tumor's margin; there is nothing to cut.")
    return layers, tuple(cuts), _grasp(located.of(label), columns)


def _grown_tumor(located: Located, label: int, config: ResectionConfig) -> Grown:
    """Points of the tumor's surface (also inside it, where there is no mesh) and the margin that
    each needs, mm.

    Raises:
        NoPlan: a margin is wider than ``most_margin_mm``; the estimate has no uncertainty, and it
            is asked for.
    """
    name = name_of(label)
    mesh = located.meshes.get(name)
    points = np.asarray(located.of(label) if mesh is None else mesh.vertices_mm, float)
    margins = np.full(len(points), config.margin_mm)
    if config.sigmas > 0:
        if mesh is None or name not in located.std_mm:
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
    widest_first = np.argsort(-margins, kind="stable")
    points, margins = points[widest_first], margins[widest_first]  # of each cube, this one stays
    keep = first_in_cell(np.floor(points / size_mm).astype(np.int64))
    return points[keep], margins[keep]


@dataclass(frozen=True, eq=False)
class Columns:
    """The organ's lowest and highest point over a grid of the table's plane, mm; NaN outside it.
    ``first_mm``: the middle of the first cell."""

    first_mm: Float64[np.ndarray, " 2"]
    lowest_mm: Float64[np.ndarray, "i j"]
    highest_mm: Float64[np.ndarray, "i j"]

    @classmethod
    def of(cls, located: Located) -> Columns:
        """From the organ's surface, or from all points, where there is no surface."""
        mesh = located.meshes.get("kidney")
        points = np.asarray(located.points_mm if mesh is None else mesh.vertices_mm, float)
        low = points[:, :2].min(0) - 2 * _COLUMN_MM
        cell = np.round((points[:, :2] - low) / _COLUMN_MM).astype(int)
        shape = cell.max(0) + 3
        flat = cell[:, 0] * shape[1] + cell[:, 1]
        lowest, highest = column_extremes(flat, points[:, 2], shape.prod())
        return cls(low, _spread(lowest.reshape(shape)), -_spread(-highest.reshape(shape)))

    def at(self, points_mm: Float[np.ndarray, "n 2"]) -> Heights:
        """Lowest and highest point of the organ below and above each place."""
        cell = np.round((points_mm - self.first_mm) / _COLUMN_MM).astype(int)
        shape = np.array(self.lowest_mm.shape)
        inside = ((cell >= 0) & (cell < shape)).all(1)
        i, j = np.clip(cell, 0, shape - 1).T
        low, high = self.lowest_mm[i, j], self.highest_mm[i, j]
        return np.where(inside, low, np.nan), np.where(inside, high, np.nan)

    def within(
        self, points_mm: Float[np.ndarray, "n 2"], bottom_mm: float, top_mm: float
    ) -> np.ndarray:
        """Where there is organ between two heights, or nearly: the estimate may be a little off,
        and a thin bridge would hold the piece."""
        low, high = self.at(points_mm)
        return (high + _SLACK_MM > bottom_mm) & (low - _SLACK_MM < top_mm)  # False at NaN


def column_extremes(
    columns: Int[np.ndarray, " m"], heights: Float[np.ndarray, " m"], n_columns: int
) -> Heights:
    """The lowest and the highest point of each column; inf and -inf where none is."""
    lowest, highest = np.full(n_columns, np.inf), np.full(n_columns, -np.inf)
    np.minimum.at(lowest, columns, heights)
    np.maximum.at(highest, columns, heights)
    return lowest, highest


def _spread(values: Float[np.ndarray, "i j"]) -> Float64[np.ndarray, "i j"]:
    """Empty cells take the least of their neighbours, if those surround them."""
    known = np.isfinite(values)
    closed = binary_closing(known, iterations=2) | known
    near = minimum_filter(np.where(known, values, np.inf), 5)
    filled = np.where(known, values, near)
    return np.where(closed & np.isfinite(filled), filled, np.nan)


def _layers(grown: Grown, columns: Columns, layer_mm: float) -> tuple[CutLayer, ...]:
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
    outlines = [*_outlines(grown, tops[:-1]), outermost]
    layers = [
        CutLayer(float(bottom), float(top), rings)
        for bottom, top, rings in zip(bottoms, tops, outlines, strict=True)
        if rings
    ]
    return tuple(reversed(layers))


def _outlines(grown: Grown, levels_mm: Float[np.ndarray, " k"]) -> list[Rings]:
    """Rings of what comes away at each height."""
    points, margins = grown
    cell = min(_CELL_MM, _CELL_SHARE * float(margins.min()))
    room = float(margins.max()) + 4 * cell
    first = points[:, :2].min(0) - room
    shape = np.ceil((points[:, :2].max(0) + room - first) / cell).astype(int) + 1
    fields = np.full((len(levels_mm), *shape), _FAR_MM)
    outline_fields(points, margins, np.asarray(levels_mm, float), first, cell, fields)
    found = []
    for field in fields:
        # Far cells hold no distance: next to the outline all are nearer than this.
        contours = find_contours(np.minimum(field, 2 * cell), 0.0)
        area = polygon_of(first + c * cell for c in contours if len(c) > 3)
        found.append(rings_of(shapely.simplify(area, _SMOOTH_MM, preserve_topology=False)))
    return found


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
    strokes: list[Cut], sweep: int, last: Float[np.ndarray, " 3"] | None, direction: Direction
) -> list[Cut]:
    """Walls first, then the floor; each time the stroke that begins nearest to where the one before
    ended. Outlines run anticlockwise, seen from above."""
    turns = {"shortest": (1, -1), "clockwise": (-1,), "anticlockwise": (1,)}[direction]
    ordered = []
    for floor in (False, True):
        left = [stroke for stroke in strokes if (stroke.kind == "floor") == floor]
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


def _grasp(tumor: Float[np.ndarray, "n 3"], columns: Columns) -> Float64[np.ndarray, " 3"]:
    """The surface straight above the tumor's centre of mass: there the cup finds something."""
    x, y, _ = tumor.mean(0)
    high = columns.at(np.array([[x, y]], float))[1][0]
    return np.array([x, y, tumor[:, 2].max() if np.isnan(high) else high], float)
