"""The organ's surface as some hundred patches: where loads act and obstacles are felt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from tumortrack.core.types import Mesh


@dataclass(frozen=True, eq=False)
class Patches:
    """Areas of a closed surface: their middle, area and mean outward normal."""

    points_mm: Float64[np.ndarray, "p 3"]
    areas_mm2: Float64[np.ndarray, " p"]
    normals: Float64[np.ndarray, "p 3"]


def patches_of(mesh: Mesh, count: int, rng: np.random.Generator) -> Patches:
    """At most ``count`` patches: faces go to the nearest of random ones, drawn by area."""
    from scipy.spatial import cKDTree

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
