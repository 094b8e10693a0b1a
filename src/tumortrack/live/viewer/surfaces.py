"""Surfaces made for the eye: margins round tumors, the organ without its tumors' own surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int32

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulate.occupancy import contains, surface_distance

_CELLS = 32  # of the distance field, along the longest side
_FINEST_MM, _COARSEST_MM = 0.6, 1.5
_SAME_MM = 0.4


def exact_margin(part: Mesh, margin_mm: float) -> Mesh:
    """The closed surface ``margin_mm`` outside a closed one, in its frame: where the distance
    field, worked out on a lattice, has that value (right to 0.2 mm); about a second."""
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
    """The surface pushed outwards along its normals: quick, and right where it bulges less than
    the margin is wide."""
    a, b, c = part.vertices_mm[part.faces].transpose(1, 0, 2)
    normals = np.zeros_like(part.vertices_mm)  # triangles weighted by their area
    np.add.at(normals, part.faces.ravel(), np.repeat(np.cross(b - a, c - a), 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return part.moved(part.vertices_mm + margin_mm * normals)


def bare_faces(anatomy: Anatomy) -> Int32[np.ndarray, "f 3"]:
    """The organ's triangles that are not a tumor's surface too: where a tumor bulges out of the
    organ both have the same surface, and drawn together they flicker."""
    organ = anatomy.organ
    shared = np.zeros(len(organ.vertices_mm), bool)
    for tumor in anatomy.tumors:
        shared |= surface_distance(tumor, organ.vertices_mm) < _SAME_MM
    return organ.faces[~shared[organ.faces].all(1)]
