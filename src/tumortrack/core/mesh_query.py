"""Points against surfaces: inside or not, labels of an anatomy, nearest places, distances; points
on them; and surfaces at a distance."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, triangles_of, turned_by
from tumortrack.core.mesh_kernels import contained, nearest_on_faces
from tumortrack.core.types import Anatomy, Mesh

_WITHIN_MM = 0.1  # of ``surface_distance``
_CELLS = 32  # of a margin's lattice along the longest side
_FINEST_MM, _COARSEST_MM = 0.6, 1.5
_FAR_STEPS = 3.5  # two diagonals of a cell: from a third node, and to a cell's other corners
# Vertices are sampled too, so the maximum misses at most s^2 / (8 R) where a flat piece of size s
# lies over a surface of radius R: 0.025 mm at R = 5 mm.
SPACING_MM = 1.0


def contains(mesh: Mesh, points_mm: Points) -> Bool[np.ndarray, " n"]:
    """True for points inside a closed mesh, by the parity of its faces beyond each point."""
    # Rotated, so that no edge of a mesh or grid drawn along the axes passes a point exactly.
    askew = turned_by(np.array([0.3, 0.5, 0.7]))
    points, vertices = np.asarray(points_mm, float) @ askew, mesh.vertices_mm @ askew
    return contained(points, vertices, mesh.faces)


def labels_of(anatomy: Anatomy, points_mm: Points) -> UInt8[np.ndarray, " n"]:
    """Labels of points in the anatomy's frame: a tumor wins over the organ and earlier tumors."""
    labels = np.zeros(len(points_mm), np.uint8)
    for label, part in enumerate(anatomy.parts, start=1):
        labels[contains(part, points_mm)] = label
    return labels


def surface_samples(
    mesh: Mesh, spacing_mm: float = SPACING_MM
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Points on a surface and the area each stands for, mm^2.

    Deterministic: every triangle is cut into n^2 equal ones with edges <= spacing, whose centroids
    carry the area. The vertices follow with area 0, so that extremes are included.
    """
    corners = mesh.vertices_mm[mesh.faces]
    edges_mm = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    cuts = np.ceil(edges_mm.max(1) / spacing_mm).clip(1, 2**20).astype(int)  # of each edge
    ends = np.cumsum(cuts**2)
    points = np.empty((sum(ends[-1:]), 3))
    for n in np.unique(cuts):
        chosen = np.flatnonzero(cuts == n)
        row = np.repeat(np.arange(n), 2 * np.arange(n) + 1)
        place = np.arange(n * n) - row**2  # in the row; triangles point up and down in turn
        third = np.where(place % 2, 2 / 3, 1 / 3)
        u, v = (row - (place + 1) // 2 + third) / n, (place // 2 + third) / n
        p, q, r = corners[chosen].swapaxes(0, 1)[:, :, None]
        points[ends[chosen, None] - n * n + np.arange(n * n)] = (
            p + u[:, None] * (q - p) + v[:, None] * (r - p)
        )
    doubled = np.linalg.norm(triangles_of(mesh.vertices_mm, mesh.faces)[1], axis=1)
    areas = np.repeat(doubled / 2 / cuts**2, cuts**2)
    used = np.unique(mesh.faces)
    points = np.concatenate([points, mesh.vertices_mm[used]])
    return points, np.append(areas, np.zeros(len(used)))


def nearest_places(mesh: Mesh, points_mm: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """The place of a surface that is nearest to each point, mm; exact. InputError: it has no
    faces."""
    if not len(mesh.faces):
        raise InputError("distances to a surface need triangles; it has none.")
    points = np.ascontiguousarray(points_mm, np.float64)
    return nearest_on_faces(points, mesh.vertices_mm[mesh.faces])


def surface_distance(mesh: Mesh, points_mm: Points) -> Float32[np.ndarray, " n"]:
    """Distance to the surface in mm, by dense points of it: up to 0.1 mm too long, so no metric."""
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


def signed_distances(
    mesh: Mesh, origin_mm: Float[np.ndarray, " 3"], step_mm: float, shape: tuple[int, ...]
) -> Float32[np.ndarray, "i j k"]:
    """``surface_distance`` at the nodes of a lattice, negative inside a closed mesh."""
    nodes = origin_mm + step_mm * np.indices(shape).reshape(3, -1).T
    return _signed(mesh, nodes, surface_distance(mesh, nodes)).reshape(shape)


def _signed(mesh: Mesh, nodes: np.ndarray, distance: np.ndarray) -> np.ndarray:
    near = np.flatnonzero(((nodes > mesh.box_mm[0]) & (nodes < mesh.box_mm[1])).all(1))
    distance[near[contains(mesh, nodes[near])]] *= -1
    return distance


def exact_margin(part: Mesh, margin_mm: float) -> Mesh:
    """The closed surface ``margin_mm`` outside a closed one: an isosurface of its distance field on
    a lattice, right to 0.2 mm."""
    from skimage.measure import marching_cubes

    lower, upper = part.box_mm
    size = float((upper - lower).max()) + 2 * margin_mm
    step = float(np.clip(size / _CELLS, _FINEST_MM, _COARSEST_MM))
    origin = lower - margin_mm - 2 * step
    shape = 3 * np.ceil(((upper - lower + 2 * margin_mm) / step + 5) / 3).astype(int)
    nodes = np.moveaxis(origin[:, None, None, None] + step * np.indices(shape), 0, -1)

    def signed(nodes: np.ndarray) -> np.ndarray:
        return _signed(part, nodes, np.linalg.norm(nearest_places(part, nodes) - nodes, axis=1))

    # Every third node's distance, and the exact one where the surface may be: between neighbours it
    # differs by a step at most.
    distance = signed(nodes[1::3, 1::3, 1::3].reshape(-1, 3)).reshape(shape // 3)
    for axis in range(3):
        distance = distance.repeat(3, axis)
    near = np.abs(distance - margin_mm) < _FAR_STEPS * step
    distance[near] = signed(nodes[near])
    vertices, faces, _, _ = marching_cubes(distance, margin_mm, gradient_direction="descent")
    return Mesh(origin + step * vertices, faces)


def rough_margin(part: Mesh, margin_mm: float) -> Mesh:
    """The surface moved outwards along its normals: quick, and right unless concavities are
    narrower than the margin."""
    weighted = triangles_of(part.vertices_mm, part.faces)[1]
    normals = np.zeros_like(part.vertices_mm)
    np.add.at(normals, part.faces.ravel(), np.repeat(weighted, 3, axis=0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return part.with_vertices(part.vertices_mm + margin_mm * normals)


def thinned(mesh: Mesh, cell_mm: float) -> Mesh:
    """A coarser mesh to draw: the vertices in a cubic cell are replaced by their mean."""
    cells = np.floor(mesh.vertices_mm / cell_mm).astype(np.int64)
    group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)[1:]
    means = [np.bincount(group, mesh.vertices_mm[:, axis]) / count for axis in range(3)]
    a, b, c = group[mesh.faces].T
    faces = group[mesh.faces][(a != b) & (b != c) & (c != a)]
    # A thin fold collapses to two sheets with the same corners: drop faces that occur in pairs.
    _, kind, times = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return Mesh(np.stack(means, axis=1), faces[times[kind] % 2 == 1])
