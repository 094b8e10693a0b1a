"""One organ on the bench, of one material, perhaps slit, to which loads are applied.

Bench frame, mm: z up, towards the camera; the organ lies on z = 0 as in its CT, its long axis along
x, its middle at x = y = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.raster import label_grid
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.organ.tets import FACES, TetMesh
from tumortrack_benchmarks.physics.equilibrium import Points
from tumortrack_benchmarks.physics.forces import Bed, Obstacle, Springs, Touch, rows_of
from tumortrack_benchmarks.physics.solid import NeoHookeanSolid
from tumortrack_benchmarks.physics.tets import find

_HARD_KPA_MM = 150.0  # of plates, rods

Generator = np.random.Generator
Vector = Float64[np.ndarray, " 3"]


class Slit(NamedTuple):
    """A plane patch across which tetrahedra are parted: a disc about a point of the surface."""

    middle_mm: Vector
    normal: Vector
    radius_mm: float


class Wound(NamedTuple):
    """A mesh that is parted: ``side`` of each tetrahedron (True: where the normal points), and the
    ``walls``: triangles of nodes that were inside and now face the gap, turned outward, those of
    one side before their like on the other."""

    mesh: TetMesh
    side: Bool[np.ndarray, " t"]
    walls: Int[np.ndarray, "w 3"]
    slit: Slit | None = None


def cut_open(mesh: TetMesh, slit: Slit) -> Wound:
    """Part the mesh within a slit. Raises InputError: it meets no face between tetrahedra."""
    side = (mesh.nodes_mm[mesh.tets].mean(1) - slit.middle_mm) @ slit.normal > 0

    def within(corners_mm: np.ndarray) -> Bool[np.ndarray, " f"]:
        return np.linalg.norm(corners_mm.mean(1) - slit.middle_mm, axis=1) < slit.radius_mm

    wound = parted(mesh, side, within)._replace(slit=slit)
    if not len(wound.walls):
        raise InputError("the slit meets no face between tetrahedra; make it larger.")
    return wound


def parted(
    mesh: TetMesh,
    side: Bool[np.ndarray, " t"],
    within: Callable[[Float64[np.ndarray, "f 3 3"]], Bool[np.ndarray, " f"]],
) -> Wound:
    """Part the mesh at those faces between its sides that are ``within``, by their corners: nodes
    inside are doubled."""
    faces = mesh.tets[:, FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(mesh.tets)), 4)
    _, pair = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    order = np.argsort(pair, kind="stable")
    twice = np.flatnonzero(np.diff(pair[order]) == 0)
    first, second = order[twice], order[twice + 1]
    between = np.flatnonzero(side[owner[first]] != side[owner[second]])
    opens = np.zeros(len(first), bool)
    opens[between] = within(mesh.nodes_mm[faces[first[between]]])
    # A corner is one node's in one tetrahedron; whole faces sew the corners of two together.
    tets, corner = mesh.tets, np.arange(mesh.tets.size).reshape(-1, 4)
    a, b = owner[first[~opens]], owner[second[~opens]]
    which, i, j = np.nonzero(tets[a][:, :, None] == tets[b][:, None])
    links = corner[a[which], i], corner[b[which], j]
    graph = coo_matrix((np.ones(len(which), bool), links), (tets.size, tets.size))
    _, node = connected_components(graph, directed=False)
    nodes_mm = np.empty((node.max() + 1, 3))
    nodes_mm[node] = mesh.nodes_mm[tets.ravel()]
    parted_tets = node.reshape(-1, 4).astype(np.int32)
    new = parted_tets[:, FACES].reshape(-1, 3)
    turned = side[owner[first[opens]]]
    walls = (
        np.where(turned, first[opens], second[opens]),
        np.where(turned, second[opens], first[opens]),
    )
    return Wound(TetMesh(nodes_mm, parted_tets), side, new[np.concatenate(walls)])


@dataclass(frozen=True, eq=False)
class Organ:
    """A case on the bench with its tetrahedra."""

    anatomy: Anatomy
    mesh: TetMesh
    bed: Bed
    in_tumor: Float64[np.ndarray, " t"]  # share of each tetrahedron
    points_mm: Points  # of the surface, for contact
    areas_mm2: Float64[np.ndarray, " m"]
    owner: Int[np.ndarray, " m"]  # tetrahedron and weights that hold each point
    weights: Float64[np.ndarray, "m 4"]

    @classmethod
    def from_anatomy(cls, anatomy: Anatomy, mesh: TetMesh, sample_mm: float = 3.0) -> Organ:
        """``sample_mm``: one point of contact per cube of this size."""
        points, areas = contact_points(anatomy.organ, sample_mm)
        share = _tumor_share(mesh, anatomy) if anatomy.tumors else np.zeros(len(mesh.tets))
        held = find(mesh.nodes_mm[mesh.tets], points)
        return cls(anatomy, mesh, Bed.from_organ(anatomy.organ), share, points, areas, *held)

    @property
    def size_mm(self) -> Vector:
        return np.ptp(self.anatomy.organ.box_mm, axis=0)

    @property
    def middle_mm(self) -> Vector:
        return self.anatomy.organ.vertices_mm.mean(0)

    def place(self, rng: Generator, up: float = -1.0) -> Vector:
        """A random point of the surface, whose direction from the middle has at least that z."""
        out = self.points_mm - self.middle_mm
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        return self.points_mm[rng.choice(np.flatnonzero(out[:, 2] >= up))]

    @property
    def hilum_mm(self) -> Vector:
        """Where vessels enter: the place of the surface that lies nearest to the middle."""
        return self.points_mm[np.linalg.norm(self.points_mm - self.middle_mm, axis=1).argmin()]


@dataclass(frozen=True, eq=False)
class Stage:
    """An organ of one material, perhaps slit, before it is loaded."""

    organ: Organ
    solid: NeoHookeanSolid
    wound: Wound | None = None

    def rows(self, points: Any = slice(None)) -> Any:
        """The matrix that carries the solid's nodes to points of the surface."""
        mesh, organ = self.solid.mesh, self.organ
        return rows_of(mesh.tets[organ.owner[points]], organ.weights[points], len(mesh.nodes_mm))

    def touch(self, obstacle: Obstacle, kpa_mm: float = _HARD_KPA_MM, friction: float = 0) -> Touch:
        return Touch(self.rows(), self.organ.areas_mm2, obstacle, kpa_mm, friction)

    def patch(self, middle_mm: Vector, radius_mm: float) -> Int[np.ndarray, " p"]:
        """Points of the surface so near; at least the nearest eight."""
        far = np.linalg.norm(self.organ.points_mm - middle_mm, axis=1)
        return np.flatnonzero(far <= max(radius_mm, np.sort(far)[7]))

    def grip(self, points: np.ndarray, shift_mm: np.ndarray, mn_mm: float) -> Springs:
        """Points of the surface held where a shift (one, or one each) brings them."""
        places = self.organ.points_mm[points] + shift_mm
        return Springs(self.rows(points), places, np.full(len(points), mn_mm / len(points)))


def transformed(anatomy: Anatomy, b_from_a: Float64[np.ndarray, "4 4"]) -> Anatomy:
    """An anatomy in another frame."""
    return anatomy.with_parts(
        part.with_vertices(transform_points(b_from_a, part.vertices_mm)) for part in anatomy.parts
    )


def contact_points(organ: Mesh, cube_mm: float) -> tuple[Points, Float64[np.ndarray, " m"]]:
    """One point of the surface per cube that it passes, and the area there."""
    points_mm, areas_mm2 = surface_samples(organ, cube_mm / 2)
    cubes = np.floor(points_mm / cube_mm)
    _, first, cube = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    return points_mm[first], np.bincount(cube.ravel(), areas_mm2).astype(np.float64)


def _tumor_share(mesh: TetMesh, anatomy: Anatomy) -> Float64[np.ndarray, " t"]:
    """Share of each tetrahedron that lies in a tumor, by a voxel grid of 1 mm."""
    low = np.floor(anatomy.organ.box_mm[0]) - 1
    shape = np.ceil(anatomy.organ.box_mm[1] - low).astype(int) + 2
    labels = label_grid(anatomy, rigid(np.eye(3), low), tuple(shape.tolist()))
    # Fixed points spread over a tetrahedron: corners, edges' middles and centre, pulled inwards.
    spread = np.concatenate(
        [np.eye(4), (np.eye(4)[[0, 0, 0, 1, 1, 2]] + np.eye(4)[[1, 2, 3, 2, 3, 3]]) / 2]
    )
    weights = np.concatenate([0.75 * spread + 0.0625, np.full((1, 4), 0.25)])
    points = np.einsum("pk,tkj->tpj", weights, mesh.nodes_mm[mesh.tets])
    index = np.clip(np.rint(points - low).astype(int), 0, shape - 1)
    return np.asarray((labels[tuple(index.transpose(2, 0, 1))] > 1).mean(1), np.float64)
