"""Tetrahedral meshes of closed surfaces, and points embedded in them."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64, Int, Int32

from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh

if TYPE_CHECKING:
    from scipy.sparse import spmatrix

_CANDIDATES = 24  # tetrahedra round a point among which its own is looked for


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
        """Per node, the sum of what each tetrahedron gives to its four in equal parts."""
        return np.bincount(self.tets.ravel(), np.repeat(per_tet / 4, 4), len(self.nodes_mm))


def tet_volumes(
    nodes_mm: Float[np.ndarray, "n 3"], tets: Int[np.ndarray, "t 4"]
) -> Float64[np.ndarray, " t"]:
    """Signed volumes, mm^3."""
    corners = nodes_mm[tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def tetrahedralise(surface: Mesh, edge_mm: float, envelope: float = 2e-3) -> TetMesh:
    """Fill a closed surface, which the mesh's own leaves by up to ``envelope`` times its diagonal
    (0.002: about 0.3 mm on a kidney); Hu et al. 2020, doi 10.1145/3386569.3392385. fTetWild is not
    reproducible even on one thread: keep the mesh where results must be. Raises InputError: nothing
    could be filled (an open or inverted surface)."""
    import pytetwild

    # fTetWild leaves a file of its own in the working folder.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        nodes_mm, tets = pytetwild.tetrahedralize(
            surface.vertices_mm.copy(),  # the binding takes writable arrays of these types only
            surface.faces.astype(np.uint32),
            edge_length_abs=edge_mm,
            epsilon=envelope,
            num_threads=1,
            loglevel=6,
        )
    if len(tets) == 0:
        raise InputError("the surface encloses nothing that tetrahedra could fill; repair it.")
    tets = np.ascontiguousarray(tets, np.int32)
    turned = tet_volumes(nodes_mm, tets) < 0
    tets[turned, 2:] = tets[turned, :1:-1]
    return TetMesh(np.ascontiguousarray(nodes_mm, np.float64), tets)


def factorised(matrix: spmatrix) -> Callable[[np.ndarray], np.ndarray]:
    """Solves with a symmetric stiffness matrix."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve


@dataclass(frozen=True, eq=False)
class Embedding:
    """Points held by the four nodes of one tetrahedron each, with weights that sum to 1."""

    nodes: Int32[np.ndarray, "m 4"]
    weights: Float64[np.ndarray, "m 4"]

    def carry(self, nodes_mm: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 3"]:
        return np.einsum("mi,mij->mj", self.weights, nodes_mm[self.nodes])


def embed(mesh: TetMesh, points_mm: Float[np.ndarray, "m 3"]) -> Embedding:
    """Find each point's tetrahedron. A point just outside the mesh (its surface is coarser than
    the anatomy's) is held by the nearest one, its weights extrapolated."""
    owner, weights = find(mesh.nodes_mm[mesh.tets], points_mm)
    return Embedding(mesh.tets[owner], weights)


def find(
    corners_mm: Float[np.ndarray, "t 4 3"], points_mm: Float[np.ndarray, "m 3"]
) -> tuple[Int[np.ndarray, " m"], Float64[np.ndarray, "m 4"]]:
    """The tetrahedron that holds each point (the nearest for points just outside), and the
    point's barycentric weights there."""
    from scipy.spatial import cKDTree

    inverse = np.linalg.inv((corners_mm[:, 1:] - corners_mm[:, :1]).transpose(0, 2, 1))
    count = min(_CANDIDATES, len(corners_mm))
    near = cKDTree(corners_mm.mean(1)).query(points_mm, k=count)[1].reshape(-1, count)
    best = np.full(len(points_mm), -np.inf)
    owner = near[:, 0].copy()
    weights = np.zeros((len(points_mm), 4))
    for tet in near.T:
        local = np.einsum("mij,mj->mi", inverse[tet], points_mm - corners_mm[tet, 0])
        here = np.concatenate([1 - local.sum(1, keepdims=True), local], axis=1)
        better = here.min(1) > best
        best[better] = here.min(1)[better]
        owner[better], weights[better] = tet[better], here[better]
    return owner, weights
