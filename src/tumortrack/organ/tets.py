"""Tetrahedra of positive volume that fill a closed surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64, Int, Int32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import contains, surface_samples
from tumortrack.core.types import Mesh

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # of a tetrahedron, outward


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Nodes (mm) and tetrahedra of positive volume; the variable that holds it names the frame."""

    nodes_mm: Float64[np.ndarray, "n 3"]
    tets: Int32[np.ndarray, "t 4"]

    def __post_init__(self) -> None:
        if len(self.tets) == 0 or not (self.volumes_mm3 > 0).all():
            raise InputError("a tetrahedral mesh needs tetrahedra, all of positive volume.")

    @cached_property
    def volumes_mm3(self) -> Float64[np.ndarray, " t"]:
        return tet_volumes(self.nodes_mm, self.tets)

    def lump(self, per_tet: Float[np.ndarray, " t"]) -> Float64[np.ndarray, " n"]:
        """Per node, the sum of the tetrahedra's values, each divided among its four nodes."""
        return np.bincount(self.tets.ravel(), np.repeat(per_tet / 4, 4), len(self.nodes_mm))


def tet_volumes(
    nodes_mm: Float[np.ndarray, "n 3"], tets: Int[np.ndarray, "t 4"]
) -> Float64[np.ndarray, " t"]:
    """Signed volumes, mm^3."""
    corners = nodes_mm[tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def lattice(surface: Mesh, edge_mm: float) -> TetMesh:
    """Fill a closed surface from a body-centred cubic lattice (edges of ``edge_mm`` and 0.87 of
    it): what has its middle inside is kept, then the outermost nodes are drawn onto the surface as
    far as no tetrahedron loses more than four fifths of its volume. Coarser than fTetWild where the
    organ is thin, and the same to the last bit whenever it is repeated. Raises InputError: nothing
    could be filled."""
    nodes_mm, tets = _cubic(surface.box_mm, edge_mm)
    tets = tets[contains(surface, nodes_mm[tets].mean(1))]
    if len(tets) == 0:
        raise InputError("the surface encloses nothing that tetrahedra could fill; repair it.")
    tets = largest_piece(tets)
    used, tets = np.unique(tets, return_inverse=True)
    nodes_mm, tets = nodes_mm[used], tets.reshape(-1, 4).astype(np.int32)
    turned = tet_volumes(nodes_mm, tets) < 0
    tets[turned, 2:] = tets[turned, :1:-1]
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    sides, times = np.unique(faces, axis=0, return_counts=True)
    outer = np.unique(sides[times == 1])
    samples_mm = surface_samples(surface)[0]
    away = np.zeros_like(nodes_mm)
    away[outer] = samples_mm[cKDTree(samples_mm).query(nodes_mm[outer])[1]] - nodes_mm[outer]
    share, least = np.ones((len(nodes_mm), 1)), tet_volumes(nodes_mm, tets).min() / 5
    while (flat := tet_volumes(nodes_mm + share * away, tets) < least).any():
        share[tets[flat].ravel()] *= 0.5
    return TetMesh(nodes_mm + share * away, tets)


def _cubic(box_mm: np.ndarray, edge_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and tetrahedra of a lattice over a box: of each two cubes that share a face the middles
    and an edge of the face."""
    cubes = np.ceil((box_mm[1] - box_mm[0]) / edge_mm).astype(int) + 2
    origin = box_mm.mean(0) - cubes * edge_mm / 2
    corners, middles = np.indices(cubes + 1), np.indices(cubes) + 0.5
    nodes = np.concatenate([corners.reshape(3, -1).T, middles.reshape(3, -1).T])
    corner = np.arange(corners[0].size).reshape(cubes + 1)
    middle = np.arange(middles[0].size).reshape(cubes) + corner.size
    tets = []
    for axis in range(3):
        cube, face = np.moveaxis(middle, axis, 0), np.moveaxis(corner, axis, 0)[1:-1]
        ring = face[:, :-1, :-1], face[:, 1:, :-1], face[:, 1:, 1:], face[:, :-1, 1:]
        for a, b in zip(ring, (*ring[1:], ring[0]), strict=True):
            tets.append(np.stack([cube[:-1], cube[1:], a, b], axis=-1).reshape(-1, 4))
    return origin + edge_mm * nodes, np.concatenate(tets)


def largest_piece(tets: np.ndarray) -> np.ndarray:
    """The tetrahedra that hang together by nodes, of the piece with most of them."""
    links = np.repeat(tets[:, 0], 3), tets[:, 1:].ravel()
    size = tets.max() + 1
    graph = coo_matrix((np.ones(len(links[0]), bool), links), (size, size))
    piece = connected_components(graph, directed=False)[1][tets[:, 0]]
    return tets[piece == np.bincount(piece).argmax()]
