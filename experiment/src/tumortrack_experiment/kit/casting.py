"""A mold of two halves round one closed surface: block, flange, bolts, keys, sprue and vents.

All solids are in the mold's frame: z is the pull of the upper half and up while it is filled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy import ndimage

from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import solid_of
from tumortrack_experiment.kit.parting import HeightField, best_pull, parting_surface, peaks

FLANGE_MM = 14.0  # beyond the block's wall: room for a washer (9 mm) and a wall on either side
THICK_MM = 8.0  # of each half's flange at its rim; inwards it grows by 45 degrees
_SPACING_MM = 32.0  # from a bolt to the next key and on to the next bolt
_BOLT_MM, _SEAT_MM = 4.5, 11.0  # M4 with play (ISO 273, medium); its washer with play
_KEY_MM = (3.6, 2.4, 5.0)  # a cone's radius on the parting surface and at its end, and its height
_PROMINENCE_MM = 1.0  # a pocket of air that is less deep leaves a dimple that nobody minds
_ROUND = 48  # sides of a round hole


@dataclass(frozen=True, eq=False)
class Layout:
    """Where everything is, before it is cut. ``outline``: the block seen along the pull, a
    ``manifold3d.CrossSection``; ``rim``: with the flange. ``corners_mm``: of the hull within the
    wall. ``vents_mm``: the pockets' highest points."""

    mold_from_ct: Float64[np.ndarray, "4 4"]
    mesh: Mesh
    field: HeightField
    outline: Any
    rim: Any
    hull_mm: Float64[np.ndarray, "n 2"]
    wall_mm: float
    bottom_mm: float
    top_mm: float
    sprue_mm: Float64[np.ndarray, " 3"]
    sprue_radius_mm: float
    vents_mm: Float64[np.ndarray, "v 3"]
    parting_mm: Float64[np.ndarray, "n 3"]

    def beyond_wall(self, points_mm: Float[np.ndarray, "*n 2"]) -> Float64[np.ndarray, " *n"]:
        """How far points of the plane lie outside the block's outline; negative: inside it."""
        a, b = self.hull_mm, np.roll(self.hull_mm, -1, axis=0)
        along = b - a
        flat = points_mm.reshape(-1, 1, 2) - a
        share = (flat * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
        near = flat - np.clip(share, 0, 1)[..., None] * along
        away = np.linalg.norm(near, axis=-1).min(1)
        left = along[:, 0] * flat[..., 1] - along[:, 1] * flat[..., 0]
        inside = (left >= 0).all(1)
        return (np.where(inside, -away, away) - self.wall_mm).reshape(points_mm.shape[:-1])


def lay_out(
    mesh_ct: Mesh, wall_mm: float, sprue_mm: float, pins: Float[np.ndarray, "p 3"] | None = None
) -> Layout:
    """The pull, the parting surface and the block round a closed surface of the ``ct`` frame;
    ``pins`` as in ``best_pull``."""
    mold_from_ct = _upright(mesh_ct, best_pull(mesh_ct, pins))
    mesh = mesh_ct.moved(transform_points(mold_from_ct, mesh_ct.vertices_mm))
    field, roof = parting_surface(mesh, wall_mm + FLANGE_MM + 3.0)
    shadow = solid_of(mesh, "the surface to be cast").project()
    hull = shadow.hull()
    rim = _offset(hull, wall_mm + FLANGE_MM)
    low, high = mesh.box_mm
    (corners,) = hull.to_polygons()
    radius = min(sprue_mm / 2, float((high - low)[:2].min()) / 6)
    loop = max(shadow.simplify(0.05).to_polygons(), key=len)
    draft = Layout(
        mold_from_ct, mesh, field, _offset(hull, wall_mm), rim, corners, wall_mm,
        bottom_mm=low[2] - wall_mm, top_mm=high[2] + wall_mm,
        sprue_mm=_highest(roof, radius), sprue_radius_mm=radius,
        vents_mm=_pockets(mesh), parting_mm=np.c_[loop, field.at(loop)],
    )  # fmt: skip
    return _with_room(draft)


def _with_room(draft: Layout) -> Layout:
    """The block as high as its flange needs, and vents only where the sprue is not."""
    from dataclasses import replace

    heights = draft.field.heights_mm[draft.beyond_wall(draft.field.nodes()) < FLANGE_MM]
    away = np.linalg.norm(draft.vents_mm[:, :2] - draft.sprue_mm[:2], axis=1)
    return replace(
        draft,
        bottom_mm=min(draft.bottom_mm, float(heights.min()) - THICK_MM),
        top_mm=max(draft.top_mm, float(heights.max()) + THICK_MM),
        vents_mm=draft.vents_mm[away > draft.sprue_radius_mm + 1.0],
    )


def _upright(mesh: Mesh, pull: np.ndarray) -> np.ndarray:
    """The mold's frame: z along the pull, x along the longest extent across it, 0 in the middle
    of the surface's box."""
    points = mesh.vertices_mm - mesh.vertices_mm.mean(0)
    flat = points - np.outer(points @ pull, pull)
    longest = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    longest -= longest @ pull * pull
    longest /= np.linalg.norm(longest)
    turn = np.stack([longest, np.cross(pull, longest), pull])
    turned = mesh.vertices_mm @ turn.T
    return rigid(turn, -(turned.min(0) + turned.max(0)) / 2)


def _offset(section: Any, distance_mm: float) -> Any:
    import manifold3d

    return section.offset(distance_mm, manifold3d.JoinType.Round, circular_segments=96)


def _highest(roof: HeightField, radius_mm: float) -> np.ndarray:
    """Where a disc of a radius has the highest roof all over; z: its lowest point there."""
    reach = int(np.ceil(radius_mm / roof.step_mm))
    i, j = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    disc = i**2 + j**2 <= (radius_mm / roof.step_mm) ** 2
    under = ndimage.grey_erosion(roof.heights_mm, footprint=disc, mode="constant", cval=-np.inf)
    at = np.unravel_index(under.argmax(), under.shape)
    return np.array([*(roof.origin_mm + roof.step_mm * np.array(at)), under[at]])


def _pockets(mesh: Mesh) -> np.ndarray:
    """Where air would be caught: local maxima of the roof."""
    import trimesh

    found = peaks(mesh, mesh.vertices_mm[:, 2], _PROMINENCE_MM)
    normals = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).vertex_normals
    return mesh.vertices_mm[[v for v in found if normals[v, 2] > 0]].reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Halves:
    """The solids (``manifold3d.Manifold``): ``block`` is what both halves were cut from,
    ``channels`` sprue, vents and pin holes, through organ and wall."""

    upper: Any
    lower: Any
    block: Any
    channels: Any
    keys: int
    bolts: int


Segment = tuple[np.ndarray, np.ndarray]  # its ends, (3,), mold frame


def cut_halves(
    layout: Layout, vent_mm: float, pin_mm: float, clearance_mm: float, pins: list[Segment]
) -> Halves:
    """Both halves; keys and bolts keep off the pins' ways."""
    import manifold3d

    top, bottom = layout.top_mm, layout.bottom_mm
    field, body = layout.field, layout.outline.extrude(top - bottom).translate([0, 0, bottom])
    rim = layout.rim.extrude(top - bottom).translate([0, 0, bottom])
    slope = np.maximum(FLANGE_MM - layout.beyond_wall(field.nodes()), 0)
    thick = THICK_MM + np.minimum(slope, FLANGE_MM)
    channels = _channels(layout, vent_mm, pin_mm, pins)
    bolts, keys = _places(layout, pins)
    drilled, pegs, holes = [channels, *(_bolt(layout, place) for place in bolts)], [], []
    for place in keys:
        base = float(field.at(place)[0])
        pegs.append(_cone(place, base, 0.0))
        holes.append(_cone(place, base, clearance_mm))
    organ = solid_of(layout.mesh, "the surface to be cast")
    drills = manifold3d.Manifold.batch_boolean([organ, *drilled], manifold3d.OpType.Add)
    halves = []
    for way, end in ((1, top), (-1, bottom)):
        flange = field.solid(field.heights_mm + way * thick) ^ rim
        halves.append((body ^ field.solid(end + 5.0 * way)) + flange)
    upper, lower = halves
    block = upper + lower
    return Halves(
        manifold3d.Manifold.batch_boolean([upper, drills, *holes], manifold3d.OpType.Subtract),
        manifold3d.Manifold.batch_boolean([lower, *pegs], manifold3d.OpType.Add) - drills,
        block, channels, len(keys), len(bolts),
    )  # fmt: skip


def rod(start: np.ndarray, end: np.ndarray, radius_mm: float, wider: float = 1.0) -> Any:
    """A cylinder or cone between two points; ``wider``: the second end's radius, as a ratio."""
    import manifold3d

    along = end - start
    length = float(np.linalg.norm(along))
    z = along / length
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    pose = np.column_stack([x, np.cross(z, x), z, start])
    return manifold3d.Manifold.cylinder(length, radius_mm, wider * radius_mm, _ROUND).transform(
        pose
    )


def _channels(layout: Layout, vent_mm: float, pin_mm: float, pins: list[Segment]) -> Any:
    import manifold3d

    over = np.array([0, 0, 1.0])
    foot, radius, out = layout.sprue_mm, layout.sprue_radius_mm, layout.top_mm + 5.0
    rods = [rod(foot, np.array([*foot[:2], out]), radius)]
    deep = min(2 * radius, layout.top_mm - foot[2] - 3.0)  # a funnel of 45 degrees
    if deep > 0.5:
        rim, mouth = layout.top_mm - deep, np.array([*foot[:2], layout.top_mm])
        rods.append(rod(np.array([*foot[:2], rim]), mouth, radius, 1 + deep / radius))
    rods += [
        rod(vent - 0.5 * over, np.array([*vent[:2], out]), vent_mm / 2) for vent in layout.vents_mm
    ]
    rods += [rod(start, end, pin_mm / 2 + _PIN_PLAY_MM) for start, end in pins]
    return manifold3d.Manifold.batch_boolean(rods, manifold3d.OpType.Add)


_PIN_PLAY_MM = 0.1  # on the radius: printed holes come out narrower


def _places(layout: Layout, pins: list[Segment]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Where bolts and keys go: in turn round the flange's middle, off the pins."""
    ((ring),) = _offset(layout.outline, FLANGE_MM / 2).to_polygons()
    ring = np.concatenate([ring, ring[:1]])
    run = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    n = max(2 * round(run[-1] / _SPACING_MM / 2), 6)
    found: list[np.ndarray] = []
    for place in range(n):
        for shift in (0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3):
            at = (place + shift) / n * run[-1] % run[-1]
            spot = np.array([np.interp(at, run, ring[:, axis]) for axis in (0, 1)])
            if all(_apart(spot, pin) > _SEAT_MM / 2 + 2.0 for pin in pins):
                found.append(spot)
                break
        else:
            found.append(np.full(2, np.nan))
    bolts = [spot for spot in found[0::2] if np.isfinite(spot).all()]
    return bolts, [spot for spot in found[1::2] if np.isfinite(spot).all()]


def _apart(spot: np.ndarray, pin: Segment) -> float:
    """Between a vertical line and a segment."""
    start, along = pin[0][:2] - spot, (pin[1] - pin[0])[:2]
    share = np.clip(-(start @ along) / max(along @ along, 1e-12), 0, 1)
    return float(np.linalg.norm(start + share * along))


def _bolt(layout: Layout, place: np.ndarray) -> Any:
    """A hole through both flanges and level seats for washers."""
    base = float(layout.field.at(place)[0])
    parts = []
    for way, end in ((1, layout.top_mm + 5), (-1, layout.bottom_mm - 5)):
        seat = base + way * THICK_MM
        middle = np.array([*place, base - way])
        parts.append(rod(middle, np.array([*place, end]), _BOLT_MM / 2))
        if (end - seat) * way > 0.5:
            parts.append(rod(np.array([*place, seat]), np.array([*place, end]), _SEAT_MM / 2))
    return parts[0] + parts[1] + sum(parts[3:], parts[2])


def _cone(place: np.ndarray, base_mm: float, clearance_mm: float) -> Any:
    """A key from 4 mm below the parting surface to its end above it; with clearance, its hole."""
    wide, narrow, height = _KEY_MM
    slope = (wide - narrow) / height
    start = np.array([*place, base_mm - 4.0])
    end = np.array([*place, base_mm + height + clearance_mm])
    low = wide + 4.0 * slope + clearance_mm
    return rod(start, end, low, (narrow + clearance_mm) / low)
