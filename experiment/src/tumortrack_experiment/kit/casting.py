"""A mold of two halves round one closed surface: block, flange, bolts, keys, sprue and vents.

All is in the mold's frame: z is the pull of the upper half, and up while it is filled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from scipy.spatial import ConvexHull

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import perpendicular, rigid, transform_points, unit
from tumortrack.core.solids import solid_of
from tumortrack.core.types import Mesh
from tumortrack_experiment.kit.parting import Cells, HeightField, best_pull, parting_surface

FLANGE_MM, THICK_MM = 14.0, 8.0  # beyond the wall, room for a washer; each half's, at the rim
_CELL_MM = (1.0, 1.0, 0.25)
_SPACING_MM = 32.0  # from a bolt to the next key and on to the next bolt
_BOLT_MM, _SEAT_MM = 4.5, 11.0  # M4 with play (ISO 273, medium); its washer (9 mm) with play
_NUT_MM = 7.0  # below its seat, where the mold stands
_KEY_MM = (3.6, 2.4, 5.0)  # a cone's radius on the parting surface and at its end, and its height
_POCKET_CELLS = 2  # of 1 mm: shallower trapped air gets no vent
_PIN_PLAY_MM = 0.1  # on the radius: printed holes come out narrower
_SMOOTH_MM = 2e-4  # edges shorter than that vanish: they would collapse in single precision

Segment = tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]  # its ends


@dataclass(frozen=True, eq=False)
class Layout:
    """Where everything is before it is cut. ``outline`` and ``rim``: the block without and with its
    flange, seen along the pull (``manifold3d.CrossSection``). ``sprue_mm``: where it meets the
    organ; ``vents_mm``: where else air would be caught; ``parting_mm``: the loop on the organ."""

    mold_from_ct: Float64[np.ndarray, "4 4"]
    mesh: Mesh
    cells: Cells
    field: HeightField
    outline: Any
    rim: Any
    bottom_mm: float
    top_mm: float
    sprue_mm: Float64[np.ndarray, " 3"]
    sprue_radius_mm: float
    vents_mm: Float64[np.ndarray, "v 3"]
    parting_mm: Float64[np.ndarray, "n 3"]

    def beyond(self, points_mm: Float[np.ndarray, "*n k"]) -> Float64[np.ndarray, " *n"]:
        """How far points (x and y come first) lie outside the outline; negative: inside it."""
        out = np.full(points_mm.shape[:-1], -np.inf)
        for x, y, offset in ConvexHull(self.outline.to_polygons()[0]).equations:
            np.maximum(out, points_mm[..., 0] * x + points_mm[..., 1] * y + offset, out=out)
        return out

    def in_block(self, points_mm: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, " *n"]:
        """Whether points lie in the block or its flange."""
        z, beyond = points_mm[..., 2], self.beyond(points_mm)
        thick = THICK_MM + FLANGE_MM - np.maximum(beyond, 0)
        flange = (beyond < FLANGE_MM) & (np.abs(z - self.field.at(points_mm)) < thick)
        return (flange | (beyond < 0)) & (z > self.bottom_mm) & (z < self.top_mm)


def lay_out(
    mesh_ct: Mesh, tumors_ct: tuple[Mesh, ...], wall_mm: float, sprue_mm: float,
    pins: Float[np.ndarray, "p 3"] | None = None,
) -> Layout:  # fmt: skip
    """The pull, the parting surface and the block round a closed surface of the ``ct`` frame.

    The side where the ``tumors_ct`` are that will lie in it is down, so that they can be set on
    pins in the open lower half; sprue and vents keep off them. ``pins``: as in ``best_pull``.

    Raises:
        InputError: a surface that is not closed, or tumors that leave no place for the sprue.
    """
    from manifold3d import JoinType

    pull = best_pull(mesh_ct, pins)
    middles = [tumor.box_mm.mean(0) - mesh_ct.box_mm.mean(0) for tumor in tumors_ct]
    if sum(middle @ pull for middle in middles) > 0:
        pull = -pull
    mold_from_ct = _upright(mesh_ct, pull)
    mesh, *tumors = (
        m.with_vertices(transform_points(mold_from_ct, m.vertices_mm))
        for m in (mesh_ct, *tumors_ct)
    )
    cells = Cells(mesh, _CELL_MM, wall_mm + FLANGE_MM + 3.0)
    field = parting_surface(cells)
    shadow = solid_of(mesh, "the surface to be cast").project()
    outline, rim = (
        shadow.hull().offset(wide, JoinType.Round, circular_segments=96)
        for wide in (wall_mm, wall_mm + FLANGE_MM)
    )
    radius = min(sprue_mm / 2, float(np.ptp(mesh.box_mm, axis=0)[:2].min()) / 6)
    loop = max(shadow.simplify(0.05).to_polygons(), key=len)
    sprue, vents = _openings(cells, tumors, radius)
    (low, high), heights = mesh.box_mm[:, 2], field.at(rim.to_polygons()[0])
    bottom = min(low - wall_mm, heights.min() - THICK_MM - _NUT_MM)
    top = max(high + wall_mm, heights.max() + THICK_MM)
    return Layout(
        mold_from_ct, mesh, cells, field, outline, rim, bottom, top, sprue, radius, vents,
        np.column_stack([loop, field.at(loop)]),
    )  # fmt: skip


def _upright(mesh: Mesh, pull: np.ndarray) -> np.ndarray:
    """The mold's frame: z along the pull, x along the longest extent across it, 0 in the middle
    of the surface's box."""
    across = np.stack([perpendicular(pull), np.cross(pull, perpendicular(pull))])
    longest = unit(np.linalg.eigh(np.cov(across @ mesh.vertices_mm.T))[1][:, 1] @ across)
    turn = np.stack([longest, np.cross(pull, longest), pull])
    turned = mesh.with_vertices(mesh.vertices_mm @ turn.T)
    return rigid(turn, -turned.box_mm.mean(0))


def _openings(cells: Cells, tumors: list[Mesh], radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the sprue's disc has the highest roof all over, and the tops of pockets of air that lie
    higher than every way out of them; neither below a tumor, which fills the cavity there."""
    from skimage.morphology import disk, h_maxima

    coarse = round(cells.step_mm[0] / cells.step_mm[2])  # cubes will do
    inside = cells.inside[:, :, ::coarse]
    tumor, height = np.zeros(inside.shape, bool), np.arange(inside.shape[2])
    for mesh in tumors:
        tumor |= ndimage.binary_dilation(cells.fill(mesh)[:, :, ::coarse], iterations=2)
    free = np.where(inside & ~tumor, height, 0)
    roof, below = free.max(2), np.where(inside & tumor, height, 0).max(2)
    disc = disk(int(np.ceil(radius_mm / cells.step_mm[0])))
    under = ndimage.grey_erosion(np.where(roof > below, roof, 0), footprint=disc, mode="constant")
    if not under.any():
        raise InputError(
            f"there is no place for a sprue of {2 * radius_mm:g} mm beside the tumors, which take "
            "up all of the upper side. Take a narrower one."
        )
    sprue = np.array(np.unravel_index(under.argmax(), under.shape))
    pockets, count = ndimage.label(h_maxima(free, _POCKET_CELLS), np.ones((3, 3, 3)))
    tops = np.array(ndimage.center_of_mass(pockets > 0, pockets, range(1, count + 1)))
    tops = np.rint(tops).astype(int).reshape(-1, 3)
    away = np.linalg.norm((tops[:, :2] - sprue) * cells.step_mm[0], axis=1)
    kept = (below[tops[:, 0], tops[:, 1]] < tops[:, 2]) & (away > radius_mm + 1.0)
    full = np.array([1, 1, coarse])
    return cells.place_mm(np.array([*sprue, under.max()]) * full), cells.place_mm(tops[kept] * full)


@dataclass(frozen=True, eq=False)
class Halves:
    """Solids (``manifold3d.Manifold``): ``block`` is what both halves were cut from, ``channels``
    are all holes: sprue, vents, pins, bolts, keys."""

    upper: Any
    lower: Any
    block: Any
    channels: Any
    keys: int
    bolts: int


def cut_halves(
    layout: Layout, vent_mm: float, pin_mm: float, clearance_mm: float, pins: list[Segment]
) -> Halves:
    """Both halves; keys and bolts keep off the pins' ways."""
    from manifold3d import Manifold, OpType

    field, top, bottom = layout.field, layout.top_mm, layout.bottom_mm
    body, rim = (
        shape.extrude(top - bottom).translate([0, 0, bottom])
        for shape in (layout.outline, layout.rim)
    )
    beyond = np.clip(layout.beyond(field.nodes()), 0, FLANGE_MM)
    thick = THICK_MM + FLANGE_MM - beyond  # its underside rises by 45 degrees: no support
    upper, lower = (
        (body ^ field.solid(end + 5 * way)) + (rim ^ field.solid(field.heights_mm + way * thick))
        for way, end in ((1, top), (-1, bottom))
    )
    bolts, keys = _places(layout, pins)
    drills = [
        *_channels(layout, vent_mm, pin_mm, pins),
        *(r for at in bolts for r in _bolt(layout, at)),
    ]
    holes = [_key(place, clearance_mm) for place in keys]
    pegged = Manifold.batch_boolean([lower, *(_key(place, 0.0) for place in keys)], OpType.Add)
    drills.append(solid_of(layout.mesh, "the surface to be cast"))
    upper_half, lower_half = (
        max(  # crumbs that hang on nothing are left out
            Manifold.batch_boolean([solid, *cut], OpType.Subtract).decompose(),
            key=lambda piece: piece.volume(),
        ).simplify(_SMOOTH_MM)
        for solid, cut in ((upper, [*drills, *holes]), (pegged, drills))
    )
    channels = Manifold.batch_boolean([*drills[:-1], *holes], OpType.Add)
    return Halves(upper_half, lower_half, upper + lower, channels, len(keys), len(bolts))


def rod(start: np.ndarray, end: np.ndarray, radius_mm: float, end_mm: float | None = None) -> Any:
    """A cylinder or cone between two points; ``end_mm``: its radius there, if it differs."""
    from manifold3d import Manifold

    z, x = unit(end - start), perpendicular(end - start)
    pose = np.column_stack([x, np.cross(z, x), z, start])
    length = float(np.linalg.norm(end - start))
    return Manifold.cylinder(length, radius_mm, end_mm or radius_mm, 48).transform(pose)


def _channels(layout: Layout, vent_mm: float, pin_mm: float, pins: list[Segment]) -> list[Any]:
    def raised(foot: np.ndarray, by_mm: float) -> np.ndarray:
        return foot + [0.0, 0.0, by_mm]

    foot, radius = layout.sprue_mm, layout.sprue_radius_mm
    out = layout.top_mm - foot[2]
    room = min(2 * radius, out - 3.0, -float(layout.beyond(foot)) - radius - 2.0)
    funnel = max(room, 0.1)  # deep, of 45 degrees
    rods = [rod(foot, raised(foot, out + 5), radius)]
    rods.append(rod(raised(foot, out - funnel), raised(foot, out), radius, radius + funnel))
    rods += [rod(raised(v, -1.0), raised(v, layout.top_mm - v[2] + 5), vent_mm / 2)
             for v in layout.vents_mm]  # fmt: skip
    return rods + [rod(start, end, pin_mm / 2 + _PIN_PLAY_MM) for start, end in pins]


def _places(layout: Layout, pins: list[Segment]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Points of the parting surface round the flange's middle for bolts and keys in turn, off the
    pins' ways."""
    ring = layout.outline.offset(FLANGE_MM / 2).to_polygons()[0]
    ring = np.concatenate([ring, ring[:1]])
    run = np.append(0, np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1)))
    n = max(2 * round(run[-1] / _SPACING_MM / 2), 6)
    ways = [np.linspace(*pin, 400)[:, :2] for pin in pins]
    way = np.concatenate([*ways, np.full((1, 2), np.inf)])
    found: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    for place in range(n):
        tried = (place + np.array([0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3])) / n * run[-1] % run[-1]
        spots = np.column_stack([np.interp(tried, run, ring[:, axis]) for axis in (0, 1)])
        spots = np.column_stack([spots, layout.field.at(spots)])
        clear = [np.linalg.norm(way - spot[:2], axis=1).min() > _SEAT_MM / 2 + 2 for spot in spots]
        if any(clear):
            found[place % 2].append(spots[int(np.argmax(clear))])
    return found


def _bolt(layout: Layout, place: np.ndarray) -> list[Any]:
    """A hole through both flanges and level seats for washers."""
    rods = []
    for way, end in ((1, layout.top_mm + 5), (-1, layout.bottom_mm - 5)):
        out, seat = np.array([*place[:2], end]), place + [0, 0, way * THICK_MM]
        rods += [rod(place - [0, 0, way], out, _BOLT_MM / 2), rod(seat, out, _SEAT_MM / 2)]
    return rods


def _key(place: np.ndarray, clearance_mm: float) -> Any:
    """A cone from 4 mm below the parting surface to its end above it; with clearance, its hole."""
    wide, narrow, height = _KEY_MM
    root = wide + 4.0 * (wide - narrow) / height
    end = place + [0, 0, height + clearance_mm]
    return rod(place - [0, 0, 4.0], end, root + clearance_mm, narrow + clearance_mm)
