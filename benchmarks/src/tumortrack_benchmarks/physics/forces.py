"""Forces on an organ of the twin or the wider world, each an energy (uJ) with its gradient (mN) and
an approximate Hessian (mN/mm); and the organ under them, whose equilibrium is found by
``equilibrium``. Units: mm, kPa, mN.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.sparse import bsr_matrix, csr_matrix, eye, kron

from tumortrack.core.mesh_query import contains, surface_distance
from tumortrack.core.types import Mesh
from tumortrack.native import F64, kernel
from tumortrack.organ.tets import FACES, TetMesh
from tumortrack_benchmarks.physics.equilibrium import Nodes, Points
from tumortrack_benchmarks.physics.solid import NeoHookeanSolid

_STEADY_MN_MM = 2e4
_STICK_MM = 0.2  # a smaller slip meets less than full friction: keeps the energy smooth
_GRID_MM, _GRID_ROOM_MM = 2.5, 25.0

# Values of a grid, places in its steps -> cubic B-spline and its gradient.
_spline = kernel(
    "bed_spline", F64["i", "j", "k"].any_value, F64["m", 3], F64["m"].out, F64["m", 3].out
)


@runtime_checkable
class Force(Protocol):
    """``energy`` with its gradient (n, 3); ``stiffness``: (3 n, 3 n)."""

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]: ...
    def stiffness(self, nodes_mm: Nodes) -> csr_matrix: ...


@runtime_checkable
class Obstacle(Protocol):
    """A rigid body: the distance of points (negative inside), and its gradient, outwards."""

    def distance(self, points_mm: Points) -> tuple[Float64[np.ndarray, " m"], Points]: ...


def rows_of(
    nodes: Int[np.ndarray, "m k"], weights: Float[np.ndarray, "m k"], n_nodes: int
) -> csr_matrix:
    """The matrix that carries nodes (n, 3) to points (m, 3), each held by some of them."""
    row = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    return csr_matrix((weights.ravel(), (row, nodes.ravel())), (len(nodes), n_nodes))


def spread(rows: csr_matrix, blocks: Float64[np.ndarray, "m 3 3"]) -> csr_matrix:
    """The nodes' Hessian of those of single points."""
    m, n = rows.shape
    if m == 0:
        return csr_matrix((3 * n, 3 * n))
    wide = kron(rows, eye(3), format="csr")
    middle = bsr_matrix((blocks, np.arange(m), np.arange(m + 1)), shape=(3 * m, 3 * m))
    return (wide.T @ middle @ wide).tocsr()


@dataclass(eq=False)
class Touch:
    """A surface (rows of points, an area each) that an obstacle pushes back: stiffness x depth^2 /
    2 per area. Friction is Coulomb's, smoothed, by the pressure and from the places of the last
    load step (Li et al. 2020, doi 10.1145/3386569.3392425)."""

    rows: csr_matrix
    areas_mm2: Float64[np.ndarray, " m"]
    obstacle: Obstacle
    stiffness_kpa_mm: float
    friction: float = 0.0
    _last: tuple[Points, Points, np.ndarray] | None = None

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        points = self.rows @ nodes_mm
        distance, normal = self.obstacle.distance(points)
        depth = np.minimum(distance, 0)
        push = self.stiffness_kpa_mm * self.areas_mm2 * depth
        energy, force = float(push @ depth) / 2, push[:, None] * normal
        if self._last is not None:
            before, upright, limit = self._last
            slip = points - before
            slip -= (slip * upright).sum(1, keepdims=True) * upright
            length = np.linalg.norm(slip, axis=1)
            sticks = length < _STICK_MM
            work = np.where(sticks, length**2 / (2 * _STICK_MM), length - _STICK_MM / 2)
            energy += float(limit @ work)
            force += (limit / np.maximum(length, _STICK_MM))[:, None] * slip
        return energy, self.rows.T @ force

    def remember(self, nodes_mm: Nodes) -> None:
        """The end of a load step: points in contact have friction in the next one."""
        points = self.rows @ nodes_mm
        distance, normal = self.obstacle.distance(points)
        limit = self.friction * self.stiffness_kpa_mm * self.areas_mm2 * np.maximum(-distance, 0)
        upright = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self._last = (points, upright, limit) if self.friction > 0 else None

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        distance, normal = self.obstacle.distance(self.rows @ nodes_mm)
        hit = np.flatnonzero(distance < 1e-6)
        springs = self.stiffness_kpa_mm * self.areas_mm2[hit]
        blocks = springs[:, None, None] * normal[hit][:, :, None] * normal[hit][:, None]
        if self._last is not None:
            _, upright, limit = (part[hit] for part in self._last)
            flat = np.eye(3) - upright[:, :, None] * upright[:, None]
            blocks = blocks + (limit / _STICK_MM)[:, None, None] * flat
        return spread(self.rows[hit], blocks)


@dataclass(frozen=True, eq=False)
class Springs:
    """Points tied to places (a grip, a vessel), mN/mm each."""

    rows: csr_matrix
    places_mm: Points
    springs_mn_mm: Float64[np.ndarray, " m"]

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        off = self.rows @ nodes_mm - self.places_mm
        force = self.springs_mn_mm[:, None] * off
        return float((force * off).sum()) / 2, self.rows.T @ force

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        return spread(self.rows, self.springs_mn_mm[:, None, None] * np.eye(3))


@dataclass(frozen=True, eq=False)
class Capsule:
    """Springs along the surface's edges (pairs of nodes) that only pull."""

    edges: Int[np.ndarray, "e 2"]
    rest_mm: Float64[np.ndarray, " e"]
    springs_mn_mm: float

    @classmethod
    def from_mesh(cls, mesh: TetMesh, springs_mn_mm: float) -> Capsule:
        faces = mesh.tets[:, FACES].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        skin = faces[first[count == 1]]
        edges = np.unique(np.sort(skin[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        ends = mesh.nodes_mm[edges]
        return cls(edges, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), springs_mn_mm)

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        a, b = self.edges.T
        way = nodes_mm[b] - nodes_mm[a]
        length = np.linalg.norm(way, axis=1)
        longer = np.maximum(length - self.rest_mm, 0)
        force = (self.springs_mn_mm * longer / length)[:, None] * way
        gradient = np.zeros_like(nodes_mm)
        for axis in range(3):
            gradient[:, axis] = np.bincount(b, force[:, axis], len(nodes_mm))
            gradient[:, axis] -= np.bincount(a, force[:, axis], len(nodes_mm))
        return self.springs_mn_mm * float(longer @ longer) / 2, gradient

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        way = nodes_mm[self.edges[:, 1]] - nodes_mm[self.edges[:, 0]]
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        e, row = len(self.edges), np.arange(len(self.edges))
        ends = np.repeat([-1.0, 1.0], e), (np.tile(row, 2), self.edges.T.ravel())
        rows = csr_matrix(ends, (e, len(nodes_mm)))
        return spread(rows, self.springs_mn_mm * way[:, :, None] * way[:, None])


class _Soft:
    """Adds nothing to the approximate Hessian."""

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        return csr_matrix((nodes_mm.size, nodes_mm.size))


@dataclass(frozen=True, eq=False)
class Weight(_Soft):
    """Constant forces on the nodes, mN."""

    force_mn: Nodes

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        return -float((self.force_mn * nodes_mm).sum()), -self.force_mn


@dataclass(frozen=True, eq=False)
class Steady(_Soft):
    """Prevents sliding sideways and rolling to the next stable side without deforming the body:
    stiff springs hold the mean sideways displacement and the mean rotation, with forces spread over
    the whole mass as in a rigid motion (inertia relief)."""

    rest_mm: Nodes
    share: Float64[np.ndarray, " n"]  # of the volume at each node

    @classmethod
    def from_solid(cls, solid: NeoHookeanSolid) -> Steady:
        return cls(solid.mesh.nodes_mm, solid.node_volumes_mm3 / solid.node_volumes_mm3.sum())

    @cached_property
    def _modes(self) -> Float64[np.ndarray, "5 n 3"]:
        arm = self.rest_mm - self.share @ self.rest_mm
        arm /= np.sqrt(self.share @ (arm**2).sum(1))  # rotations in mm at the radius of gyration
        slides = np.tile(np.eye(3)[:2, None], (1, len(arm), 1))
        turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)])
        return np.concatenate([slides, turns]) * self.share[:, None]

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        amounts = np.einsum("mni,ni->m", self._modes, nodes_mm - self.rest_mm)
        gradient = _STEADY_MN_MM * np.einsum("m,mni->ni", amounts, self._modes)
        return _STEADY_MN_MM * float(amounts @ amounts) / 2, gradient


@dataclass(frozen=True, eq=False)
class LoadedBody:
    """A solid under forces; see ``equilibrium.Equilibrium``."""

    solid: NeoHookeanSolid
    forces: tuple[Force, ...]

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        energy, gradient = self.solid.energy(nodes_mm)
        if np.isfinite(energy):
            for force in self.forces:
                more, slope = force.energy(nodes_mm)
                energy, gradient = energy + more, gradient + slope
        return energy, gradient

    def stiffness(self, nodes_mm: Nodes) -> csr_matrix:
        matrix = self.solid.rest_stiffness
        for force in self.forces:
            matrix = matrix + force.stiffness(nodes_mm)
        return matrix

    def load_mn(self, nodes_mm: Nodes) -> float:
        slopes = (force.energy(nodes_mm)[1] for force in self.forces)
        return float(sum(np.linalg.norm(slope, axis=1).sum() for slope in slopes))


@dataclass(frozen=True)
class Turned:
    """An obstacle in a frame of its own: ``axes`` are that frame's, as columns."""

    obstacle: Obstacle
    axes: Float64[np.ndarray, "3 3"]
    origin_mm: Float64[np.ndarray, " 3"]

    def distance(self, points_mm: Points) -> tuple[Float64[np.ndarray, " m"], Points]:
        distance, normal = self.obstacle.distance((points_mm - self.origin_mm) @ self.axes)
        return distance, normal @ self.axes.T


@dataclass(frozen=True, eq=False)
class Bed:
    """The tissue round the organ at rest, up to a rim: everything outside the organ and below z =
    ``rim_mm``. Distances to the organ: a cubic B-spline over a grid, smooth enough for quasi-Newton
    steps."""

    values: Float64[np.ndarray, "i j k"]  # distance to the organ at rest, mm, negative inside
    origin_mm: Float64[np.ndarray, " 3"]
    rim_mm: float = 0.0
    sunk_mm: Float[np.ndarray, " m"] | float = 0.0  # of each point at rest, by rough meshes alone

    def __post_init__(self) -> None:
        if min(self.values.shape) < 4:
            raise ValueError(f"a cubic spline of {self.values.shape} values; 4 along each axis")

    @classmethod
    def from_organ(cls, organ: Mesh) -> Bed:
        low, high = organ.box_mm + [[-_GRID_ROOM_MM], [_GRID_ROOM_MM]]
        shape = np.ceil((high - low) / _GRID_MM).astype(int) + 1
        nodes = low + _GRID_MM * np.indices(tuple(shape)).reshape(3, -1).T
        distance = np.asarray(surface_distance(organ, nodes), float)
        distance[contains(organ, nodes)] *= -1
        return cls(distance.reshape(tuple(shape)), low)

    def under(self, rest_mm: Points, rim_mm: float) -> Bed:
        """The bed for these points, none of which it pushes at rest."""
        bare = replace(self, rim_mm=rim_mm, sunk_mm=0.0)
        return replace(bare, sunk_mm=np.minimum(bare.distance(rest_mm)[0], 0))

    def outside(self, points_mm: Points) -> tuple[Float64[np.ndarray, " m"], Points]:
        """Distance to the organ at rest and its gradient; beyond the grid as at its border."""
        distance, slope = np.empty(len(points_mm)), np.empty((len(points_mm), 3))
        _spline(self.values, (points_mm - self.origin_mm) / _GRID_MM, distance, slope)
        return distance, slope / _GRID_MM

    def distance(self, points_mm: Points) -> tuple[Float64[np.ndarray, " m"], Points]:
        outside, slope = self.outside(points_mm)
        above = points_mm[:, 2] - self.rim_mm
        over = above > -outside
        normal = np.where(over[:, None], [0.0, 0.0, 1.0], -slope)
        return np.where(over, above, -outside) - self.sunk_mm, normal
