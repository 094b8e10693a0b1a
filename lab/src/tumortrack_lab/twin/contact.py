"""Frictionless contact with rigid obstacles: signed distances and penalty forces.

Contact is evaluated at points of the anatomy's own fine surface, which are embedded in the
tetrahedra: a penalty of stiffness x depth^2 / 2 per area (kPa/mm). The penetration is reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from tumortrack_lab.tets import Embedding

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

_TOUCHING_MM = 1e-6  # what only touches counts in the stiffness

Points = Float64[np.ndarray, "n 3"]
Distances = Float64[np.ndarray, " n"]


@runtime_checkable
class ContactSurface(Protocol):
    """A rigid body; frame and unit are the bench's (mm)."""

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        """Distance (negative inside) and its gradient: outwards, of length 1 where it is true."""


Obstacles = tuple[ContactSurface, ...]


@dataclass(frozen=True, eq=False)
class Support:
    """Everything below z = height: a plane, or packing that bears each point of a surface at the
    height where it lay (one height a point)."""

    height_mm: float | Distances = 0.0

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        return points_mm[:, 2] - self.height_mm, np.tile([0.0, 0.0, 1.0], (len(points_mm), 1))


@dataclass(frozen=True)
class ContactPlate:
    """A box along the axes with rounded edges; ``half_mm`` includes the rounding."""

    centre_mm: tuple[float, float, float]
    half_mm: tuple[float, float, float]
    rounding_mm: float

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        offset = points_mm - np.array(self.centre_mm)
        over = np.abs(offset) - (np.array(self.half_mm) - self.rounding_mm)
        outside = np.maximum(over, 0)
        length = np.linalg.norm(outside, axis=1)
        nearest_face = np.eye(3)[over.argmax(1)]
        normal = np.where(
            length[:, None] > 0, outside / np.maximum(length, 1e-12)[:, None], nearest_face
        )
        distance = length + np.minimum(over.max(1), 0) - self.rounding_mm
        return distance, normal * np.where(offset < 0, -1.0, 1.0)


def three(vector: Float64[np.ndarray, " 3"]) -> tuple[float, float, float]:
    """A point or direction as a ``Rod`` holds it."""
    x, y, z = vector.tolist()
    return x, y, z


@dataclass(frozen=True)
class Rod:
    """A rod with a hemispherical end: the tip touches ``tip_mm``, the unit vector ``axis`` points
    away from it along the rod. For contact it is endless."""

    tip_mm: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius_mm: float
    length_mm: float = 250.0

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        axis = np.array(self.axis)
        offset = points_mm - (np.array(self.tip_mm) + self.radius_mm * axis)
        offset -= np.maximum(offset @ axis, 0)[:, None] * axis
        length = np.linalg.norm(offset, axis=1)
        return length - self.radius_mm, offset / np.maximum(length, 1e-12)[:, None]


@dataclass(frozen=True, eq=False)
class Contact:
    """A surface (embedded points, an area each) that obstacles push back."""

    surface: Embedding
    areas_mm2: Float64[np.ndarray, " m"]
    stiffness_kpa_mm: float

    def energy(self, nodes_mm: Points, obstacles: Obstacles) -> tuple[float, Points]:
        """Penalty energy (uJ) and its gradient at the nodes (mN)."""
        points = self.surface.carry(nodes_mm)
        gradient = np.zeros_like(nodes_mm)
        energy = 0.0
        for obstacle in obstacles:
            distance, normal = obstacle.distance(points)
            hit = np.flatnonzero(distance < 0)
            push = self.stiffness_kpa_mm * self.areas_mm2[hit] * distance[hit]
            energy += float(push @ distance[hit]) / 2
            force = (push[:, None] * normal[hit])[:, None] * self.surface.weights[hit][..., None]
            np.add.at(gradient, self.surface.nodes[hit], force)
        return energy, gradient

    def load_mn(self, nodes_mm: Points, obstacle: ContactSurface) -> Float64[np.ndarray, " 3"]:
        """Total force on the body by one obstacle, mN."""
        distance, normal = obstacle.distance(self.surface.carry(nodes_mm))
        push = self.stiffness_kpa_mm * self.areas_mm2 * np.minimum(distance, 0)
        return -(push @ normal)

    def depth_mm(self, nodes_mm: Points, obstacles: Obstacles) -> float:
        """The deepest penetration of the surface into an obstacle."""
        points = self.surface.carry(nodes_mm)
        return max(0.0, *(-float(o.distance(points)[0].min()) for o in obstacles))

    def stiffness(self, nodes_mm: Points, obstacles: Obstacles) -> csr_matrix:
        """Hessian of the penalty, the obstacles' curvature left out: (3 n, 3 n), mN/mm."""
        from scipy.sparse import coo_matrix

        size = 3 * len(nodes_mm)
        total = coo_matrix((size, size)).tocsr()
        points = self.surface.carry(nodes_mm)
        for obstacle in obstacles:
            distance, normal = obstacle.distance(points)
            hit = np.flatnonzero(distance < _TOUCHING_MM)
            pull = (self.surface.weights[hit][..., None] * normal[hit][:, None]).reshape(-1, 12)
            unknowns = (3 * self.surface.nodes[hit][..., None] + np.arange(3)).reshape(-1, 12)
            rows = np.repeat(np.arange(len(hit)), 12)
            jacobian = coo_matrix((pull.ravel(), (rows, unknowns.ravel())), (len(hit), size))
            weight = self.stiffness_kpa_mm * self.areas_mm2[hit]
            total += (jacobian.T @ jacobian.multiply(weight[:, None])).tocsr()
        return total
