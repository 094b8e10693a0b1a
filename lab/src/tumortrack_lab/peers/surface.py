"""The patient's surface as points with normals, what a camera sees of it, and how a cloud fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from tumortrack.core.types import Mesh
from tumortrack.sense.render import Visibility


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points spread evenly over a surface and its outward unit normals there."""

    points_mm: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]

    def faces(self, eye_mm: Float64[np.ndarray, " 3"]) -> Bool[np.ndarray, " n"]:
        """Which points are turned towards an eye."""
        return np.einsum("ij,ij->i", self.normals, eye_mm - self.points_mm) > 0


def vertex_normals(mesh: Mesh) -> Float64[np.ndarray, "v 3"]:
    """Outward unit normals, each the mean of its triangles' by area."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    total = np.zeros_like(mesh.vertices_mm)
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def surface_points(mesh: Mesh, spacing_mm: float) -> SurfacePoints:
    """Vertices thinned to about one per cube of ``spacing_mm`` (the first by index)."""
    cube = np.floor(mesh.vertices_mm / spacing_mm).astype(np.int64)
    _, first = np.unique(cube, axis=0, return_index=True)
    kept = np.sort(first)
    return SurfacePoints(mesh.vertices_mm[kept], vertex_normals(mesh)[kept])


def seen_from(
    visibility: Visibility, surface: SurfacePoints, camera_from_ct: Float64[np.ndarray, "4 4"]
) -> Bool[np.ndarray, " n"]:
    """Which surface points the camera sees: turned towards it and not hidden by the organ."""
    eye_ct = np.linalg.inv(camera_from_ct)[:3, 3]
    towards = surface.faces(eye_ct)
    seen = np.zeros(len(towards), bool)
    seen[towards] = visibility(surface.points_mm[towards], eye_ct)
    return seen


def trimmed_mean(values: Float[np.ndarray, " n"], kept_share: float) -> float:
    """The mean of the smallest ``kept_share`` of the values."""
    count = max(1, round(kept_share * len(values)))
    return float(np.partition(values, count - 1)[:count].mean())
