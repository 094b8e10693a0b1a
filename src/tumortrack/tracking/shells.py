"""Margins as surfaces: shells at a margin's distance outside a closed surface."""

from __future__ import annotations

import numpy as np

from tumortrack.core.geometry import triangles_of
from tumortrack.core.mesh_query import contains, surface_distance
from tumortrack.core.types import Mesh

_CELLS = 32  # of the lattice along the longest side
_FINEST_MM, _COARSEST_MM = 0.6, 1.5


def exact_margin(part: Mesh, margin_mm: float) -> Mesh:
    """The closed surface ``margin_mm`` outside a closed one: an isosurface of its distance field on
    a lattice, right to 0.2 mm; about a second."""
    from skimage.measure import marching_cubes

    lower, upper = part.box_mm
    size = float((upper - lower).max()) + 2 * margin_mm
    step = float(np.clip(size / _CELLS, _FINEST_MM, _COARSEST_MM))
    origin = lower - margin_mm - 2 * step
    shape = tuple(np.ceil((upper - lower + 2 * margin_mm) / step).astype(int) + 5)
    nodes = origin + step * np.indices(shape).reshape(3, -1).T
    distance = surface_distance(part, nodes)
    near = np.flatnonzero(((nodes > lower) & (nodes < upper)).all(1))
    distance[near[contains(part, nodes[near])]] *= -1
    vertices, faces, _, _ = marching_cubes(
        distance.reshape(shape), margin_mm, gradient_direction="descent"
    )
    return Mesh(origin + step * vertices, faces)


def rough_margin(part: Mesh, margin_mm: float) -> Mesh:
    """The surface moved outwards along its normals: quick, and right unless concavities are
    narrower than the margin."""
    weighted = triangles_of(part.vertices_mm, part.faces)[1]
    normals = np.zeros_like(part.vertices_mm)
    np.add.at(normals, part.faces.ravel(), np.repeat(weighted, 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return part.moved(part.vertices_mm + margin_mm * normals)
