"""Displacement modes, the principal components of an organ's responses to random loads, and the
organ reduced to them.

Reduced bases from responses, in the mass inner product: Barbic and James 2005, doi
10.1145/1073204.1073300. Loads are balanced by inertia (inertia relief), so responses and modes are
free of rigid motion, which belongs to the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import triangles_of, unit
from tumortrack.core.mesh_kernels import farthest
from tumortrack.core.process import parallel_map
from tumortrack.core.types import Mesh
from tumortrack.organ.finite import BlockCholesky, LatticeSolid

LEVER_MM = 50.0  # a rotation's unknown is the motion at this lever arm
FORCED = 150  # places of forces for the compliance; 80 leave nearly the same errors
_FREE = 1e-4  # N/mm: keeps rigid motions solvable without contacts


@dataclass(frozen=True, eq=False)
class Patches:
    """The organ's surface as several hundred areas, on which loads and obstacles act."""

    points_mm: Float64[np.ndarray, "p 3"]  # centroids
    areas_mm2: Float64[np.ndarray, " p"]
    normals: Float64[np.ndarray, "p 3"]  # mean, outward

    def spot(self, middle_mm: np.ndarray, radius_mm: float) -> Float64[np.ndarray, " p"]:
        """A Gaussian weight around a place."""
        return np.exp(-0.5 * ((self.points_mm - middle_mm) ** 2).sum(1) / radius_mm**2)

    def facing(self, along: np.ndarray) -> Float64[np.ndarray, " p"]:
        """Areas as seen from a direction, mm2."""
        return np.clip(self.normals @ along, 0, None) * self.areas_mm2


def patches_of(mesh: Mesh, count: int, rng: np.random.Generator) -> Patches:
    """At most ``count`` patches: each face joins the nearest of random ones, drawn by area."""
    middles, doubled = triangles_of(mesh.vertices_mm, mesh.faces)
    areas = np.linalg.norm(doubled, axis=1) / 2
    drawn = rng.choice(len(areas), min(count, len(areas)), replace=False, p=areas / areas.sum())
    patch = cKDTree(middles[drawn]).query(middles)[1]

    def total(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(patch, column, len(drawn)) for column in values.T], 1)

    area = np.bincount(patch, areas, len(drawn))
    normals = total(doubled)
    length = np.linalg.norm(normals, axis=1)
    valid = (area > 0) & (length > 0)
    points = total(areas[:, None] * middles)[valid] / area[valid][:, None]
    return Patches(points, area[valid], normals[valid] / length[valid][:, None])


def modes_of(
    solid: LatticeSolid, patches: Patches, count: int, contrasts: Sequence[float], loads: np.ndarray
) -> Float64[np.ndarray, "f k"]:
    """``count`` modes of the responses to loads (f, n) with the tumors' contrasts in turn, as
    displacements of the solid's nodes: a unit coefficient moves the organ by 1 mm rms. The last
    mode swells the organ; the others keep its volume."""
    rigid = RigidMotions.from_solid(solid)
    mass, forces = rigid.mass, rigid.balanced(np.column_stack([loads, solid.swelling]))
    responses = np.empty_like(forces)

    def respond(number: int) -> None:
        factor, columns = solid.factor(contrasts[number]), slice(number, -1, len(contrasts))
        responses[:, columns] = factor.solve(forces[:, columns])
        if number == 0:
            responses[:, -1:] = factor.solve(forces[:, -1:])

    parallel_map(respond, range(len(contrasts)))
    responses = rigid.removed(responses)
    responses, swelling = responses[:, :-1], responses[:, -1:]
    moves = solid.at(patches.points_mm, responses)
    responses /= np.linalg.norm(moves, axis=1).max(0)  # the farthest patch moves by 1 mm

    energies, mixes = np.linalg.eigh(responses.T @ (mass * responses))
    energies, mixes = energies[::-1], mixes[:, ::-1]
    kept = responses @ (mixes[:, : count - 1] / np.sqrt(energies[: count - 1]))
    swelling -= kept @ (kept.T @ (mass * swelling))
    shapes = np.column_stack([kept, swelling / np.sqrt((mass * swelling**2).sum())])
    return shapes * np.sqrt(solid.volume_mm3.sum())


def compliance_modes(
    solid: LatticeSolid,
    patches: Patches,
    count: int,
    factor: BlockCholesky | None = None,
    forced: int = FORCED,
) -> Float64[np.ndarray, "f k"]:
    """How the organ yields to forces anywhere on its surface, as displacements of the solid's
    nodes: the ``count`` principal components of its responses to independent forces along three
    axes at ``forced`` places, balanced by inertia. With independent coefficients N(0, 1) of all
    components the surface moves by 1 mm rms along each axis. ``factor``: of another stiffness than
    the usual one. Source: forces anywhere, without boundary conditions, as in BCF-FEM (Yang et al.
    2024, arXiv 2403.09964)."""
    points_mm, areas = patches.points_mm, patches.areas_mm2
    chosen = np.empty((1, min(forced, len(areas))), np.int64)
    farthest(np.ascontiguousarray(points_mm.T[None], np.float32), np.zeros(1, np.int64), chosen)
    radius_mm = np.sqrt(areas.sum() / chosen.size) / 2
    spots = np.stack([patches.spot(place, radius_mm) * areas for place in points_mm[chosen[0]]], 1)
    forces = np.einsum("pn,de->pdne", spots / spots.sum(0), np.eye(3)).reshape(len(areas), 3, -1)
    rigid = RigidMotions.from_solid(solid)
    balanced = rigid.balanced(_at_nodes(forces, solid, patches))
    responses = rigid.removed((factor or solid.usual_factor).solve(balanced))
    shares = np.sqrt(areas / areas.sum())[:, None, None]
    moved = (solid.at(points_mm, responses) * shares).reshape(3 * len(areas), -1)
    squares, mixes = np.linalg.eigh(moved.T @ moved)
    return responses @ mixes[:, : -count - 1 : -1] / np.sqrt(squares.sum() / 3)


@dataclass(frozen=True, eq=False)
class RigidMotions:
    """Of a solid's nodes."""

    motions: Float64[np.ndarray, "f 6"]
    mass: Float64[np.ndarray, "f 1"]  # of each unknown: its node's volume
    inverse: Float64[np.ndarray, "6 6"]  # of the motions' inner products

    @classmethod
    def from_solid(cls, solid: LatticeSolid) -> RigidMotions:
        arms, axes = solid.nodes_mm - solid.center_mm, np.eye(3)
        turns = [np.cross(axis, arms).ravel() for axis in axes]
        motions = np.stack([*(np.tile(axis, len(arms)) for axis in axes), *turns], 1)
        mass = np.repeat(solid.volume_mm3, 3)[:, None]
        return cls(motions, mass, np.linalg.inv(motions.T @ (mass * motions)))

    def removed(self, displacements: np.ndarray) -> np.ndarray:
        """Displacements without their rigid part."""
        part = self.inverse @ (self.motions.T @ (self.mass * displacements))
        return displacements - self.motions @ part

    def balanced(self, forces: np.ndarray) -> np.ndarray:
        """Forces with the inertia that balances them."""
        return forces - self.mass * (self.motions @ (self.inverse @ (self.motions.T @ forces)))


def _at_nodes(
    forces: Float64[np.ndarray, "p 3 n"], solid: LatticeSolid, patches: Patches
) -> Float64[np.ndarray, "f n"]:
    """Forces on patches as forces at the solid's nodes."""
    spread = solid.weights(patches.points_mm).T @ forces.reshape(len(forces), -1)
    return spread.reshape(-1, forces.shape[2])


def random_loads(
    solid: LatticeSolid, patches: Patches, up: np.ndarray, count: int, rng: np.random.Generator
) -> Float64[np.ndarray, "f n"]:
    """Forces at the nodes, one column per load. They only have to be diverse: magnitudes, and the
    response of an organ in its bed, are decided for each state (``loads.state_of``)."""
    draw = _Tractions(patches, solid.center_mm, up, rng)
    kinds = (draw.squeeze, draw.poke, draw.hang, draw.bend, draw.shear)
    shares = np.array([0.36, 0.28, 0.12, 0.16, 0.08])
    chosen = rng.choice(len(kinds), count, p=shares / shares.sum())
    return _at_nodes(np.stack([kinds[n]() for n in chosen], -1), solid, patches)


@dataclass(frozen=True, eq=False)
class _Tractions:
    """Draws forces on patches (p, 3)."""

    patches: Patches
    center_mm: np.ndarray
    up: np.ndarray
    rng: np.random.Generator

    def squeeze(self) -> np.ndarray:
        """A pad presses; a bed or a second pad supports the other side."""
        rng, patches, along = self.rng, self.patches, self._direction()
        facing = patches.facing(along)
        place = patches.points_mm[rng.choice(len(facing), p=facing / facing.sum())]
        radius = rng.uniform(0.15, 0.7) * self._size_mm
        pad, bed = patches.spot(place, radius) * facing, patches.facing(-along)
        if rng.uniform() > 0.6:
            bed = bed * (patches.spot(place - 0.6 * self._size_mm * along, 1.5 * radius) + 1e-6)
        return _total(bed, along) - _total(pad, along)

    def poke(self) -> np.ndarray:
        """An instrument presses or pulls in one place; inertia or the far side balances it."""
        rng, patches = self.rng, self.patches
        areas = patches.areas_mm2
        patch = rng.choice(len(areas), p=areas / areas.sum())
        along = unit(patches.normals[patch] + rng.normal(0, 0.3, 3))
        spot = patches.spot(patches.points_mm[patch], rng.uniform(4, 10))
        force = _total(spot * areas, along)
        return force - _total(patches.facing(-along), along) if rng.uniform() < 0.6 else force

    def hang(self) -> np.ndarray:
        """Supported in one place; the weight, to which inertia relief amounts, pulls on the
        rest."""
        along, points = self._direction(), self.patches.points_mm
        radius = self.rng.uniform(0.4, 2) * self._size_mm
        support = self.patches.spot(points[self.rng.integers(len(points))], radius)
        return _total(self.patches.facing(-along) * support + 1e-12, along)

    def bend(self) -> np.ndarray:
        """The ends go one way, the middle the other."""
        along, across, _ = Rotation.random(rng=self.rng).as_matrix()
        areas = self.patches.areas_mm2
        square = ((self.patches.points_mm - self.center_mm) @ along / self._size_mm) ** 2
        mean = areas @ square / areas.sum()
        return (areas * np.clip(square - mean, -1, 1))[:, None] * across

    def shear(self) -> np.ndarray:
        """Two regions are pulled in opposite directions."""
        rng, patches = self.rng, self.patches
        radii = rng.uniform(0.3, 0.6, 2) * self._size_mm
        middles = (patches.points_mm[rng.integers(len(patches.points_mm))] for _ in radii)
        spots = (patches.spot(*place) for place in zip(middles, radii, strict=True))
        first, second = (spot * patches.areas_mm2 for spot in spots)
        along = unit(rng.normal(size=3))
        return _total(first, along) - _total(second, along)

    def _direction(self) -> np.ndarray:
        """Roughly up half of the time, else any direction."""
        if self.rng.uniform() < 0.5:
            return unit(self.rng.normal(size=3))
        return Rotation.from_rotvec(self.rng.normal(0, 0.3, 3)).apply(self.up)

    @property
    def _size_mm(self) -> float:
        return np.ptp(self.patches.points_mm, axis=0).max() / 2


def _total(weights: np.ndarray, along: np.ndarray) -> np.ndarray:
    """A total force of 1 along a direction, distributed by weights."""
    return (weights / weights.sum())[:, None] * along


class ReducedModel:
    """A solid in the space of its modes and six rigid motions: k + 6 unknowns. ``scale``: its
    length over that of the kidney for which the loads' lengths are meant."""

    def __init__(
        self,
        solid: LatticeSolid,
        modes: Float64[np.ndarray, "f k"],
        patches: Patches,
        scale: float = 1.0,
    ) -> None:
        self.scale = scale
        k, n = modes.shape[1], len(solid.nodes)
        self.solid, self.modes, self.patches, self.n_modes = solid, modes, patches, k
        deformed = solid.at(patches.points_mm, modes)
        arms = (patches.points_mm - solid.center_mm) / LEVER_MM
        turned = np.stack([np.cross(axis, arms) for axis in np.eye(3)], -1)
        shifted = np.broadcast_to(np.eye(3), turned.shape)
        # Displacement per unknown: of each patch (p, 3, k + 6); over the volume (3, k + 6), mm3.
        self.moves = np.concatenate([deformed, shifted, turned], -1)
        volume = solid.volume_mm3
        mean = np.tensordot(volume, modes.reshape(n, 3, k), 1)
        rigid = np.concatenate([np.eye(3) * volume.sum(), np.zeros((3, 3))], 1)
        self.volume_moves = np.concatenate([mean, rigid], 1)
        self.swelling = np.append(modes.T @ solid.swelling, np.zeros(6))  # as the solid's
        self._tissue = modes.T @ (solid.stiffness(solid.organ) @ modes)
        self._tumors = modes.T @ (solid.stiffness(solid.tumor) @ modes)

    def stiffness(self, modulus: float, contrast: float) -> Float64[np.ndarray, "m m"]:
        """For the tissue's Young's modulus (N/mm2), with tumors ``contrast`` times as stiff."""
        k, stiffness = self.n_modes, _FREE * np.eye(self.n_modes + 6)
        stiffness[:k, :k] = modulus * (self._tissue + (contrast - 1) * self._tumors)
        return stiffness

    def along(self, direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "p m"]:
        """Displacement of each patch along a direction, per unknown."""
        return np.einsum("d,pdm->pm", direction, self.moves)
