"""Points against closed surfaces: inside or not, labels of an anatomy, distances."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from tumortrack.core.types import Anatomy, Mesh

Points = Float[np.ndarray, "n 3"]
_WITHIN_MM = 0.1  # of ``surface_distance``


def contains(mesh: Mesh, points_mm: Points) -> Bool[np.ndarray, " n"]:
    """True for points inside a closed mesh, by the parity of its faces beyond each point."""
    from scipy.spatial.transform import Rotation

    from tumortrack.core.mesh_kernels import contained

    # Rotated, so that no edge of a mesh or grid drawn along the axes passes a point exactly.
    askew = Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix()
    points, vertices = np.asarray(points_mm, float) @ askew, mesh.vertices_mm @ askew
    return contained(points, vertices, np.ascontiguousarray(mesh.faces, np.int64))


def labels_of(anatomy: Anatomy, points_mm: Points) -> UInt8[np.ndarray, " n"]:
    """Labels of points in the anatomy's frame: a tumor wins over the organ, a later tumor over
    an earlier one."""
    labels = np.zeros(len(points_mm), np.uint8)
    for label, part in enumerate(anatomy.parts, start=1):
        labels[contains(part, points_mm)] = label
    return labels


def surface_distance(mesh: Mesh, points_mm: Points) -> Float32[np.ndarray, " n"]:
    """Distance to the surface in mm by the nearest of dense surface points: about 0.1 mm too long
    at most, so no metric."""
    corners = mesh.vertices_mm[mesh.faces]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(initial=0))
    distance = _nearest_of(mesh.vertices_mm, points_mm)
    # Farther away, vertices alone are exact to edge^2 / 6 d, in a fifth of the time.
    near = distance < edge**2 / 6 / _WITHIN_MM + edge
    weights = [(1, 1, 1), (4, 1, 1), (1, 4, 1), (1, 1, 4), (1, 1, 0), (0, 1, 1), (1, 0, 1)]
    dense = [np.einsum("fkx,k->fx", corners, np.array(w) / sum(w)) for w in weights]
    distance[near] = _nearest_of(np.concatenate([mesh.vertices_mm, *dense]), points_mm[near])
    return distance


def _nearest_of(samples_mm: np.ndarray, points_mm: Points) -> Float32[np.ndarray, " n"]:
    from scipy.spatial import cKDTree

    # Points far from a surface have many almost nearest ones: large, loose leaves are six times
    # faster here than scipy's usual tree, with the same distances.
    tree = cKDTree(samples_mm, leafsize=100, balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(points_mm, workers=-1)[0], np.float32)
