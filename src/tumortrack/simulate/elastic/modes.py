"""Displacement modes: the principal components of an organ's responses to many random loads.

Reduced bases of elastic bodies from their responses, in the inner product of the mass: Barbic and
James 2005, doi 10.1145/1073204.1073300. Loads balance themselves (inertia relief), so responses
and modes are free of rigid motion, which belongs to the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import unit
from tumortrack.core.types import Mesh
from tumortrack.simulate.elastic.finite import LatticeSolid


@dataclass(frozen=True, eq=False)
class Patches:
    """The organ's surface as some hundred areas, where loads act and obstacles are felt: their
    centroid, area and mean outward normal."""

    points_mm: Float64[np.ndarray, "p 3"]
    areas_mm2: Float64[np.ndarray, " p"]
    normals: Float64[np.ndarray, "p 3"]


def patches_of(mesh: Mesh, count: int, rng: np.random.Generator) -> Patches:
    """At most ``count`` patches: faces go to the nearest of random ones, drawn by area."""
    corners = mesh.vertices_mm[mesh.faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas, middles = np.linalg.norm(doubled, axis=1) / 2, corners.mean(1)
    drawn = rng.choice(len(areas), min(count, len(areas)), replace=False, p=areas / areas.sum())
    patch = cKDTree(middles[drawn]).query(middles)[1]

    def total(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(patch, column, len(drawn)) for column in values.T], 1)

    area = np.bincount(patch, areas, len(drawn))
    normals = total(doubled)
    length = np.linalg.norm(normals, axis=1)
    some = (area > 0) & (length > 0)
    points = total(areas[:, None] * middles)[some] / area[some][:, None]
    return Patches(points, area[some], normals[some] / length[some][:, None])


class _RigidMotions:
    """The rigid motions of a solid and the projections that remove them."""

    def __init__(self, solid: LatticeSolid) -> None:
        arms = solid.nodes_mm - solid.center_mm
        turns = [np.cross(axis, arms).ravel() for axis in np.eye(3)]
        shifts = [np.tile(axis, len(arms)) for axis in np.eye(3)]
        self._motions = np.stack([*shifts, *turns], 1)
        self._mass = np.repeat(solid.volume_mm3, 3)
        self._inverse = np.linalg.inv(self._motions.T @ (self._mass[:, None] * self._motions))

    def relieved(self, forces: np.ndarray) -> np.ndarray:
        """Forces (f, n) made to balance themselves by inertia."""
        spread = self._motions @ (self._inverse @ (self._motions.T @ forces))
        return forces - self._mass[:, None] * spread

    def removed(self, displacements: np.ndarray) -> np.ndarray:
        """Displacements (f, n) without their mean translation and rotation."""
        moments = self._motions.T @ (self._mass[:, None] * displacements)
        return displacements - self._motions @ (self._inverse @ moments)


def modes_of(
    solid: LatticeSolid,
    patches: Patches,
    count: int,
    contrasts: tuple[float, ...],
    loads: Float64[np.ndarray, "f n"],
) -> Float64[np.ndarray, "f k"]:
    """``count`` modes of the responses to loads, which alternate between the tumors' contrasts.

    Returns:
        Displacements of the solid's nodes: a unit coefficient moves the organ by 1 mm rms. The
        last mode swells the organ; the others keep its volume.
    """
    rigid = _RigidMotions(solid)
    forces = rigid.relieved(np.column_stack([loads, solid.swelling]))
    responses = np.empty_like(forces[:, :-1])
    for turn, contrast in enumerate(contrasts):
        factor = solid.factor(contrast)
        taken = slice(turn, None, len(contrasts))
        responses[:, taken] = factor.solve(forces[:, :-1][:, taken])
        if turn == 0:
            swelling = rigid.removed(factor.solve(forces[:, -1:]))
    responses = rigid.removed(responses)
    weights = solid.weights(patches.points_mm)
    moved = (weights @ responses.reshape(len(solid.nodes), -1)).reshape(-1, 3, responses.shape[1])
    responses /= np.linalg.norm(moved, axis=1).max(0)  # each moves its farthest patch by 1 mm

    mass = np.repeat(solid.volume_mm3, 3)[:, None]
    energies, mixes = np.linalg.eigh(responses.T @ (mass * responses))
    energies, mixes = energies[::-1], mixes[:, ::-1]
    kept = responses @ (mixes[:, : count - 1] / np.sqrt(energies[: count - 1]))
    swelling -= kept @ (kept.T @ (mass * swelling))
    shapes = np.column_stack([kept, swelling / np.sqrt((mass * swelling**2).sum())])
    shapes *= np.sqrt(solid.volume_mm3.sum())
    return shapes


def random_loads(
    solid: LatticeSolid, patches: Patches, up: Float64[np.ndarray, " 3"], count: int,
    rng: np.random.Generator,
) -> Float64[np.ndarray, "f n"]:  # fmt: skip
    """Forces at the nodes, one column a load: squeezed, poked, pulled, hanging, bent, sheared.

    They only have to be diverse: magnitudes, and how an organ in its bed responds, are decided
    for every state by itself (``loads.random_state``).
    """
    draw = _Tractions(patches, solid.center_mm, up, rng)
    kinds = (draw.squeeze, draw.poke, draw.hang, draw.bend, draw.shear)
    shares = np.array([0.36, 0.28, 0.12, 0.16, 0.08])
    chosen = rng.choice(len(kinds), count, p=shares / shares.sum())
    surface = np.stack([kinds[n]() for n in chosen], -1)  # (p, 3, n)
    weights = solid.weights(patches.points_mm)
    return (weights.T @ surface.reshape(len(surface), -1)).reshape(-1, count)


class _Tractions:
    """Draws forces on patches (p, 3)."""

    def __init__(
        self, patches: Patches, center: np.ndarray, up: np.ndarray, rng: np.random.Generator
    ) -> None:
        self._points, self._areas = patches.points_mm, patches.areas_mm2
        self._normals, self._center, self._up, self._rng = patches.normals, center, up, rng
        self._size = np.ptp(patches.points_mm, axis=0).max() / 2

    def squeeze(self) -> np.ndarray:
        """A pad presses, a bed or a second pad holds against it."""
        rng, along = self._rng, self._direction()
        facing = self._facing(along)
        place = self._points[rng.choice(len(facing), p=facing / facing.sum())]
        radius = rng.uniform(0.15, 0.7) * self._size
        pad = self._spot(place, radius) * facing
        bed = self._facing(-along)
        if rng.uniform() > 0.6:
            below = place - 0.6 * self._size * along
            bed = bed * (self._spot(below, 1.5 * radius) + 1e-6)
        return _total(bed, along) - _total(pad, along)

    def poke(self) -> np.ndarray:
        """An instrument presses or pulls in one place; inertia alone, or the far side, holds."""
        rng = self._rng
        patch = rng.choice(len(self._areas), p=self._areas / self._areas.sum())
        along = unit(self._normals[patch] + rng.normal(0, 0.3, 3))
        force = _total(self._spot(self._points[patch], rng.uniform(4, 10)) * self._areas, along)
        return force - _total(self._facing(-along), along) if rng.uniform() < 0.6 else force

    def hang(self) -> np.ndarray:
        """Borne in one place; weight, which is all that inertia relief is, pulls elsewhere."""
        along = self._direction()
        radius = self._rng.uniform(0.4, 2) * self._size
        middle = self._points[self._rng.integers(len(self._points))]
        return _total(self._facing(-along) * self._spot(middle, radius) + 1e-12, along)

    def bend(self) -> np.ndarray:
        """The ends go one way, the middle the other."""
        along, across, _ = Rotation.random(rng=self._rng).as_matrix()
        square = ((self._points - self._center) @ along / self._size) ** 2
        mean = self._areas @ square / self._areas.sum()
        return (self._areas * np.clip(square - mean, -1, 1))[:, None] * across

    def shear(self) -> np.ndarray:
        """Two regions are pulled in opposite directions."""
        rng = self._rng
        spots = [
            self._spot(self._points[rng.integers(len(self._points))], r * self._size) * self._areas
            for r in rng.uniform(0.3, 0.6, 2)
        ]
        along = unit(rng.normal(size=3))
        return _total(spots[0], along) - _total(spots[1], along)

    def _direction(self) -> np.ndarray:
        """Half of the time roughly up, else anywhere."""
        rng = self._rng
        if rng.uniform() < 0.5:
            return unit(rng.normal(size=3))
        return Rotation.from_rotvec(rng.normal(0, 0.3, 3)).apply(self._up)

    def _facing(self, along: np.ndarray) -> np.ndarray:
        return np.clip(self._normals @ along, 0, None) * self._areas

    def _spot(self, middle: np.ndarray, radius: float) -> np.ndarray:
        return np.exp(-0.5 * ((self._points - middle) ** 2).sum(1) / radius**2)


def _total(weights: np.ndarray, along: np.ndarray) -> np.ndarray:
    """A total force of 1 along a direction, distributed by weights."""
    return (weights / weights.sum())[:, None] * along
