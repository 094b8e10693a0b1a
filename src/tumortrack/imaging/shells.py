"""The connected pieces of a surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from tumortrack.core.types import Mesh


def largest_shell(mesh: Mesh) -> Mesh:
    """The piece that encloses most (by the size of its signed volume); shells inside it and
    specks go."""
    if len(mesh.faces) == 0:
        return mesh
    piece = _piece_of_face(mesh)
    a, b, c = (mesh.vertices_mm[mesh.faces[:, n]] - mesh.vertices_mm[0] for n in range(3))
    volumes = np.bincount(piece, np.einsum("ij,ij->i", a, np.cross(b, c)))
    used, compact = np.unique(mesh.faces[piece == np.abs(volumes).argmax()], return_inverse=True)
    return Mesh(mesh.vertices_mm[used], compact.reshape(-1, 3))


def _piece_of_face(mesh: Mesh) -> Int[np.ndarray, " f"]:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b, c = mesh.faces.T
    n = len(mesh.vertices_mm)
    graph = coo_array((np.ones(2 * len(a), np.int8), (np.r_[a, b], np.r_[b, c])), shape=(n, n))
    _, piece = connected_components(graph, directed=False)
    return piece[a]
