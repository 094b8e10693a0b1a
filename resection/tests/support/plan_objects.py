"""Organs and tumors whose plans are known: an ellipsoid with a half-sunk sphere, and others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from tumortrack.core.mesh_query import contains
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Mesh
from tumortrack_resection.values import Located

HALF_MM = np.array([55.0, 30.0, 25.0])  # of the organ's axes
MIDDLE_MM = np.array([0.0, 0.0, 145.0])  # its lowest point is 120 mm over the table
TUMOR_MM, RADIUS_MM = np.array([10.0, -27.0, 148.0]), 12.0  # bulges out of the organ's side


def sphere(middle_mm: ArrayLike, radius_mm: ArrayLike, finer: int = 4) -> Mesh:
    """Or an ellipsoid, if each axis has a radius of its own."""
    ball = trimesh.creation.icosphere(finer, 1.0)
    return Mesh(ball.vertices * radius_mm + middle_mm, ball.faces)


def united(*parts: Mesh) -> Mesh:
    whole = solid_of(parts[0], "the first part")
    for part in parts[1:]:
        whole += solid_of(part, "another part")
    return mesh_of(whole)


def organ_with(*tumors: Mesh) -> Mesh:
    """The union of the ellipsoid and its tumors."""
    return united(sphere(MIDDLE_MM, HALF_MM), *tumors)


def located(*tumors: Mesh, n: int = 40_000, seed: int = 0, **bounds_mm: float) -> Located:
    """As an estimate in the table's frame: points evenly in the organ, labelled."""
    if not tumors:
        tumors = (sphere(TUMOR_MM, RADIUS_MM),)
    organ = organ_with(*tumors)
    rng = np.random.default_rng(seed)
    points = rng.uniform(*organ.box_mm, (n, 3))
    labels = (((points - MIDDLE_MM) / HALF_MM) ** 2).sum(1) < 1
    labels = labels.astype(np.uint8)
    for label, tumor in enumerate(tumors, start=2):
        middle = tumor.box_mm.mean(0)
        radius = np.ptp(tumor.box_mm[:, 0]) / 2
        labels[np.linalg.norm(points - middle, axis=1) < radius] = label
    inside = labels > 0
    named = {f"tumor_{k}": tumor for k, tumor in enumerate(tumors, start=1)}
    return Located(points[inside], labels[inside], {"kidney": organ, **named}, bounds_mm)


def located_of(
    body: Mesh, *tumors: Mesh, n: int = 12_000, structures: Mapping[str, Mesh] | None = None
) -> Located:
    """The same of any organ: of a body that is united with tumors of any shape."""
    organ = united(body, *tumors)
    points = np.random.default_rng(0).uniform(*organ.box_mm, (n, 3))
    labels = contains(organ, points).astype(np.uint8)
    for label, tumor in enumerate(tumors, start=2):
        labels[contains(tumor, points)] = label
    named = {f"tumor_{k}": tumor for k, tumor in enumerate(tumors, start=1)}
    inside = labels > 0
    return Located(
        points[inside], labels[inside], {"kidney": organ, **named}, structures=structures or {}
    )


class Deviating:
    """A motion that leaves points where they are, everywhere as unsure along z as the tests say."""

    def __init__(self, deviation_mm: float = 0.5) -> None:
        self.deviation_mm = deviation_mm

    def forward(self, points: np.ndarray) -> np.ndarray:
        return points

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return points

    def std_mm(self, points: np.ndarray) -> np.ndarray:
        return self.largest_std_mm(points) / np.sqrt(3)

    def largest_std_mm(self, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), self.deviation_mm)

    def covariance_mm2(self, points: np.ndarray) -> np.ndarray:
        return self.deviation_mm**2 * np.tile(np.diag([0.0, 0.0, 1.0]), (len(points), 1, 1))
