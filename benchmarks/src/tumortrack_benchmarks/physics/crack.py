"""A piece with a tumor while it is cut out of an organ: a crack along a surface round the tumor, of
which a share is cut; walls that touch; a flap that sags, and that a suction cup lifts and turns.

The mesh is fitted to the surface and parted where it is cut. The electrode leaves a gap of
``KERF_MM``: walls touch, and are seen, at half of it to either side. Bench frame, mm: ``organ``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.special import logsumexp, softmax

from tumortrack.core.geometry import perpendicular, transform_points, turned_by, unit
from tumortrack.core.mesh_query import surface_distance
from tumortrack.core.rigid_fit import kabsch
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.tets import TetMesh, lattice, tet_volumes
from tumortrack_benchmarks.physics import families, forces
from tumortrack_benchmarks.physics.equilibrium import Nodes, Points
from tumortrack_benchmarks.physics.organ import Organ, Stage, Vector, Wound, contact_points, parted
from tumortrack_benchmarks.physics.tets import find, kept, tetrahedralise

KERF_MM, MARGIN_MM = 1.5, 5.75
CUP_MM = 8.0  # radius
SPACING_MM = 1.5  # between points of what is cut
_EDGE_MM = 6.0  # of the tetrahedra
_GRID_MM, _FINE_MM = 2.0, 0.75  # of grids from which the surface and the kerf are drawn
_ROUGH_MM, _AROUND_MM = 8.0, 12.0  # of the tissue round a tumor
# So far outside the hull is so much wider than the tumor: the piece comes out.
_OUTSIDE_MM, _OPENS = 60.0, 1.3
_CORNER_MM = 1.0  # planes meet over this width
_LEVEL = 0.1  # a normal with less across the way out is of a plane below the piece
_WALL_KPA_MM = 150.0
_NEAR_MM = 14.0  # of the surface: tissue into which the other wall may come
_LEAST_VOLUME = 0.2  # of a tetrahedron, when its nodes are moved onto the surface
_STEP_MM = 2.5  # of a load, at a time

Values = Float64[np.ndarray, " n"]
Depths = Float64[np.ndarray, " p"]
Distance = Callable[[Points], tuple[Values, Points]]


class CutSurface(NamedTuple):
    """Where a piece is cut out: ``distance`` with its gradient, negative in the piece. Of the
    surface that is cut first where ``order`` is least. ``out``: of the organ; ``along``: across it,
    from where the cut begins to where the flap hangs last."""

    distance: Distance
    order: Callable[[Points], Values]
    out: Vector
    along: Vector


def way_out(anatomy: Anatomy, tumor: int) -> Vector:
    """From the middle of the tissue round a tumor through that of the tumor."""
    part, mesh = anatomy.tumors[tumor].vertices_mm, lattice(anatomy.organ, _ROUGH_MM)
    middle, tets = part.mean(0), mesh.nodes_mm[mesh.tets].mean(1)
    deep_mm = float(surface_distance(anatomy.organ, middle[None])[0])
    reach = _AROUND_MM + max(deep_mm, float(np.linalg.norm(part - middle, axis=1).max()))
    near = np.linalg.norm(tets - middle, axis=1) < reach
    return unit(middle - np.average(tets[near], axis=0, weights=mesh.volumes_mm3[near]))


def shell(
    tumor: Mesh, out: Vector, along: Vector, deep: float, margin_mm: float = MARGIN_MM
) -> CutSurface:
    """At a margin from the hull of the tumor and of a wider one outside the organ; cut from side to
    side (``deep``: 0), or from the organ's surface to the base (90 degrees)."""
    from manifold3d import Manifold

    points, middle = tumor.vertices_mm, tumor.vertices_mm.mean(0)
    wider = middle + _OPENS * (points - middle) + _OUTSIDE_MM * out
    hull = Manifold.hull_points(np.concatenate([points, wider])).refine_to_length(4.0)
    field = forces.Bed.from_organ(mesh_of(hull))

    def distance(points_mm: Points) -> tuple[Values, Points]:
        off, slope = field.outside(np.ascontiguousarray(points_mm))
        return off - margin_mm, slope

    way = np.cos(np.deg2rad(deep)) * along - np.sin(np.deg2rad(deep)) * out
    return CutSurface(distance, lambda points_mm: points_mm @ way, out, along)


def facets(planes: Float64[np.ndarray, "k 4"], out: Vector) -> CutSurface:
    """The inner sides of planes (outward normal, offset), cut one after the other."""
    normals, offsets = planes[:, :3], planes[:, 3]
    level = normals[-1] - (normals[-1] @ out) * out
    along = unit(level) if np.linalg.norm(level) > _LEVEL else perpendicular(out)

    def distance(points_mm: Points) -> tuple[Values, Points]:
        off = (points_mm @ normals.T - offsets) / _CORNER_MM
        return _CORNER_MM * logsumexp(off, axis=1), softmax(off, axis=1) @ normals

    def order(points_mm: Points) -> Values:
        return 1e4 * (points_mm @ normals.T - offsets).argmax(1) + points_mm @ along

    return CutSurface(distance, order, out, along)


@dataclass(frozen=True, eq=False)
class Incision:
    """An organ with a mesh that is fitted to the surface of a cut round one of its tumors.
    ``side``: tetrahedra of the piece."""

    organ: Organ
    surface: CutSurface
    tumor: int
    side: Bool[np.ndarray, " t"]

    @classmethod
    def of(cls, anatomy: Anatomy, surface: CutSurface, tumor: int, tets: Path) -> Incision:
        """``tets``: file of the tetrahedra, which is written if there is none. Raises InputError:
        nothing could be filled."""
        mesh = kept(tets, lambda: _fitted(anatomy.organ, surface.distance))
        side = surface.distance(mesh.nodes_mm[mesh.tets].mean(1))[0] < 0
        return cls(Organ.from_anatomy(anatomy, mesh), surface, tumor, side)

    def opened(self, share: float) -> tuple[Wound, Points]:
        """With this share of the surface's area cut, and the middles of triangles of the rest, the
        first that would be cut first."""
        left = [np.zeros((0, 3))]

        def within(corners_mm: np.ndarray) -> Bool[np.ndarray, " f"]:
            a, b, c = corners_mm.swapaxes(0, 1)
            areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
            rank = np.argsort(self.surface.order(corners_mm.mean(1)))
            count = int((np.cumsum(areas[rank]) <= share * areas.sum()).sum())
            left[0] = corners_mm.mean(1)[rank[count:]]
            return np.isin(np.arange(len(rank)), rank[:count])

        return parted(self.organ.mesh, self.side, within), left[0]


def _fitted(organ: Mesh, distance: Distance) -> TetMesh:
    """Tetrahedra none of which crosses the surface where a distance is 0."""
    room = np.array([[-2.0], [2.0]]) * _GRID_MM
    inner = _level(lambda points: distance(points)[0], organ.box_mm + room, _GRID_MM)
    mesh = tetrahedralise(organ, _EDGE_MM, inner=inner)
    nodes, tets, away = mesh.nodes_mm, mesh.tets, np.zeros_like(mesh.nodes_mm)
    side = distance(nodes[tets].mean(1))[0] < 0
    wall = np.intersect1d(tets[side], tets[~side])
    away[wall] = _onto(nodes[wall], distance) - nodes[wall]
    shift, least = np.ones((len(nodes), 1)), _LEAST_VOLUME * mesh.volumes_mm3
    while (flat := tet_volumes(nodes + shift * away, tets) < least).any():
        shift[tets[flat].ravel()] *= 0.5
    return TetMesh(nodes + shift * away, tets)


def _onto(points_mm: Points, distance: Distance, at_mm: float = 0.0) -> Points:
    """Points near a surface where the distance has a value."""
    off, slope = distance(points_mm)
    return points_mm + ((at_mm - off) / np.maximum((slope**2).sum(1), 0.25))[:, None] * slope


def _level(distance: Callable[[Points], Values], box_mm: np.ndarray, step_mm: float) -> Mesh:
    """The closed surface of what has a negative distance in a box."""
    from skimage.measure import marching_cubes

    shape = tuple((np.ceil((box_mm[1] - box_mm[0]) / step_mm).astype(int) + 1).tolist())
    nodes = box_mm[0] + step_mm * np.indices(shape).reshape(3, -1).T
    values = np.pad(distance(nodes).reshape(shape), 1, constant_values=step_mm)
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent")
    return Mesh(box_mm[0] + step_mm * (vertices - 1), faces)


@dataclass(frozen=True, eq=False)
class Walls:
    """Points of a wall that the tissue beyond the other wall pushes back: stiffness x depth^2 / 2
    per area. How deep a point is, is read where the tissue that it has come into lay at rest."""

    rows: csr_matrix  # carries nodes to the points
    areas_mm2: Depths
    rest_mm: Nodes
    tets: Int[np.ndarray, "k 4"]  # beyond the other wall
    depth: Distance  # of places at rest below the other wall

    @classmethod
    def of(cls, incision: Incision, wound: Wound, of_piece: bool) -> Walls:
        nodes, tets, distance = wound.mesh.nodes_mm, wound.mesh.tets, incision.surface.distance
        near = np.abs(distance(nodes[tets].mean(1))[0]) < _NEAR_MM
        mine, others = (tets[near & (wound.side == side)] for side in (of_piece, not of_piece))
        sign, wall = (1.0, 0) if of_piece else (-1.0, 1)
        points, areas = contact_points(Mesh(nodes, np.split(wound.walls, 2)[wall]), SPACING_MM)
        owner, weights = find(nodes[mine], _onto(points, distance, -sign * KERF_MM / 2))
        held = weights.min(1) > -0.05  # not beyond the organ's skin
        rows = forces.rows_of(mine[owner[held]], weights[held], len(nodes))

        def depth(points_mm: Points) -> tuple[Values, Points]:
            off, slope = distance(points_mm)
            skin, outward = incision.organ.bed.outside(points_mm)
            nearer = -skin < sign * off - KERF_MM / 2
            slope = np.where(nearer[:, None], -outward, sign * slope)
            return np.where(nearer, -skin, sign * off - KERF_MM / 2), slope

        return cls(rows, areas[held], nodes, others, depth)

    def sunk(
        self, nodes_mm: Nodes
    ) -> tuple[csr_matrix, Depths, Depths, Float64[np.ndarray, "p 3"]]:
        """Of points in contact: rows of them less those of the tissue there, stiffnesses (mN/mm),
        depths (mm), and their slopes."""
        points, corners = self.rows @ nodes_mm, nodes_mm[self.tets]
        middles = corners.mean(1)
        reach = 1.1 * float(np.linalg.norm(corners - middles[:, None], axis=2).max())
        close = cKDTree(middles).query(points, distance_upper_bound=reach)[0]
        at = np.flatnonzero(np.isfinite(close))
        owner, weights = find(corners, points[at], 8)
        inside = weights.min(1) > -1e-9
        at, tets, weights = at[inside], self.tets[owner[inside]], weights[inside]
        places = np.einsum("mi,mij->mj", weights, self.rest_mm[tets])
        deep, slope = self.depth(np.ascontiguousarray(places))
        hit = deep > 0
        at, tets, weights, deep, slope = at[hit], tets[hit], weights[hit], deep[hit], slope[hit]
        rest, now = (x[tets][:, 1:] - x[tets][:, :1] for x in (self.rest_mm, nodes_mm))
        slope = np.linalg.solve(now, rest @ slope[:, :, None])[:, :, 0]
        rows = self.rows[at] - forces.rows_of(tets, weights, len(nodes_mm))
        return rows, _WALL_KPA_MM * self.areas_mm2[at], deep, slope

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        rows, springs, deep, slope = self.sunk(nodes_mm)
        return float(springs @ deep**2) / 2, rows.T @ ((springs * deep)[:, None] * slope)

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        rows, springs, _, slope = self.sunk(nodes_mm)
        return forces.spread(rows, springs[:, None, None] * slope[:, :, None] * slope[:, None])


class Lift(NamedTuple):
    """How far the cup goes along the way out, and about the hinge, where the flap still hangs."""

    mm: float = 0.0
    degrees: float = 0.0


@dataclass(frozen=True, eq=False)
class Opened:
    """A state: the organ with so much cut, under load. ``cup_mm``: the place of the skin under the
    middle of the cup, at rest; ``axis``: the way out there now; ``rim_mm``: of the bed."""

    incision: Incision
    wound: Wound
    nodes_mm: Nodes
    rim_mm: float
    cup_mm: Vector
    axis: Vector
    about: dict[str, Any]

    def forward(self, points_mm: Points) -> Points:
        """Points in or on the organ at rest at their place now, each with its own side."""
        rest, tets = self.incision.organ.mesh.nodes_mm, self.incision.organ.mesh.tets
        piece, out = self.incision.surface.distance(points_mm)[0] < 0, np.array(points_mm, float)
        for side in (True, False):
            mine, chosen = np.flatnonzero(self.wound.side == side), piece == side
            owner, weights = find(rest[tets[mine]], out[chosen])
            weights = np.maximum(weights, 0)  # no extrapolation from strained edges
            weights /= weights.sum(1, keepdims=True)
            moved = self.nodes_mm[self.wound.mesh.tets] - rest[tets]
            out[chosen] += np.einsum("mi,mij->mj", weights, moved[mine[owner]])
        return out

    @property
    def swept_mm(self) -> Points:
        """Places of what is cut, at rest."""
        wall = np.split(self.wound.walls, 2)[0]
        return contact_points(Mesh(self.wound.mesh.nodes_mm, wall), SPACING_MM)[0]

    @cached_property
    def organ_mm(self) -> Mesh:
        """The organ's surface now, with the groove's walls."""
        wall = Mesh(self.wound.mesh.nodes_mm, np.split(self.wound.walls, 2)[0])
        tree, most = cKDTree(contact_points(wall, 0.5)[0]), 2 * KERF_MM

        def distance(points_mm: Points) -> Values:
            far = tree.query(points_mm, distance_upper_bound=most)[0]
            return np.minimum(far, most) - KERF_MM / 2

        rest = solid_of(self.incision.organ.anatomy.organ, "the organ")
        if len(wall.faces):
            used = self.wound.mesh.nodes_mm[wall.faces.ravel()]
            box = np.array([used.min(0) - most, used.max(0) + most])
            rest -= solid_of(_level(distance, box, _FINE_MM), "the kerf")
        whole = max(rest.decompose(), key=lambda part: part.volume())
        mesh = mesh_of(whole.simplify(0.05).refine_to_length(4.0))
        return mesh.with_vertices(self.forward(mesh.vertices_mm))


def solve(incision: Incision, share: float, lift: Lift, seed: int) -> Opened:
    """So much of the surface cut and the flap lifted; tissue, bed and weight are drawn from the
    seed. ``about``: of the tumor and the flap, how far they moved in the organ; of the walls of
    piece and organ, how deep they are in each other. Raises TumortrackError: no equilibrium was
    found, or the organ's volume changed by more than tissue's does."""
    rng, organ, surface = np.random.default_rng([seed, 0xC7]), incision.organ, incision.surface
    wound, left = incision.opened(share)
    material, solid = families.random_tissue(organ, wound.mesh, rng)
    stage, rim = Stage(organ, solid, wound), float(rng.uniform(0.1, 0.4) * organ.size_mm[2])
    bed_kpa, friction = families.log_uniform(rng, 4.0, 40.0), rng.uniform(0.0, 0.8)
    down = np.array([*rng.normal(0, 0.3, 2), -1.0]) * families.log_uniform(rng, 0.3, 2.0)
    fat = np.flatnonzero((organ.points_mm[:, 2] < rim) & ~wound.side[organ.owner])
    kpa_mm, bed = bed_kpa / families.BED_DEPTH_MM, organ.bed.under(organ.points_mm, rim)
    steady: list[forces.Force] = [
        stage.touch(bed, kpa_mm, friction),
        # Fat holds the organ down while the flap is lifted.
        forces.Springs(stage.rows(fat), organ.points_mm[fat], kpa_mm * organ.areas_mm2[fat]),
        forces.Weight(families.GRAVITY_MN_MM3 * solid.node_volumes_mm3[:, None] * down),
        forces.Steady.from_solid(solid),
        Walls.of(incision, wound, of_piece=True),
    ]
    skin = np.flatnonzero(wound.side[organ.owner])
    over = organ.points_mm[skin] - organ.anatomy.tumors[incision.tumor].vertices_mm.mean(0)
    aside = np.linalg.norm(np.cross(over, surface.out), axis=1)
    cup = organ.points_mm[skin[np.where(over @ surface.out > 0, aside, np.inf).argmin()]]
    far = np.linalg.norm(organ.points_mm[skin] - cup, axis=1)
    patch = skin[far <= max(CUP_MM, np.sort(far)[7])]
    arm, axis = organ.points_mm[patch] - left.mean(0), np.cross(surface.out, surface.along)
    angle = np.deg2rad(lift.degrees)
    steps = int((abs(lift.mm) + angle * np.linalg.norm(arm, axis=1).max()) / _STEP_MM) + 1

    def held(part: float) -> list[forces.Force]:
        turned = arm @ turned_by(part * angle * axis).T - arm
        shift = turned + part * lift.mm * surface.out
        return [stage.grip(patch, shift, families.GRIP_MN_MM)] if any(lift) else []

    loads = ((*steady, *held(step / steps)) for step in range(1, steps + 1))
    keys, iterations = families.equilibria(solid, loads)
    nodes, walls = keys[-1], (Walls.of(incision, wound, of) for of in (True, False))
    about = {
        "share": share, "lift_mm": lift.mm, "degrees": lift.degrees, "weight": float(-down[2]),
        "material": {**material, "bed_kpa": bed_kpa, "friction": friction, "rim_mm": rim},
        "volume_change": families.volume_change(solid, nodes), "iterations": iterations,
        "least_stretch": float(solid.stretch(nodes).min()),
        "sunk_in_mm": [float(wall.sunk(nodes)[2].max(initial=0.0)) for wall in walls],
    }  # fmt: skip
    out = turned_by(angle * axis) @ surface.out
    state = Opened(incision, wound, nodes, rim, cup, out, about)
    about |= _moved(state)
    return state


def _moved(state: Opened) -> dict[str, float]:
    """How far the tumor has gone in the organ, and the flap turned."""
    mesh, piece = state.incision.organ.mesh, state.wound.side
    rest, now = mesh.nodes_mm[mesh.tets].mean(1), state.nodes_mm[state.wound.mesh.tets].mean(1)
    flap, there = (kabsch(rest[s], now[s], mesh.volumes_mm3[s]) for s in (piece, ~piece))
    tumor = state.incision.organ.anatomy.tumors[state.incision.tumor].vertices_mm
    moved = (state.forward(tumor) - transform_points(there, tumor)).mean(0)
    cosine = (np.trace(there[:3, :3].T @ flap[:3, :3]) - 1) / 2
    return {
        "tumor_moved_mm": float(np.linalg.norm(moved)),
        "flap_turned_degrees": float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))),
    }
