"""Tetrahedral meshes of closed surfaces, and points embedded in them."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Int
from safetensors.numpy import load_file, save
from scipy.spatial import cKDTree

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Mesh
from tumortrack.organ.tets import TetMesh, largest_piece, tet_volumes

TETS = "tets.safetensors"  # a folder's, since filling an organ is not reproducible
_CANDIDATES = 24


def tetrahedralise(
    surface: Mesh, edge_mm: float, envelope: float = 2e-3, inner: Mesh | None = None
) -> TetMesh:
    """Fill a closed surface, which the mesh's own leaves by up to ``envelope`` times its diagonal
    (0.002: about 0.3 mm on a kidney); Hu et al. 2020, doi 10.1145/3386569.3392385. fTetWild is not
    reproducible even on one thread: keep the mesh where results must be. ``inner``: a surface that
    no tetrahedron crosses. Raises InputError: nothing could be filled (an open or inverted
    surface)."""
    import pytetwild

    parts = [surface] if inner is None else [surface, inner]
    starts = np.cumsum([0, *(len(part.vertices_mm) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]

    # fTetWild leaves a file of its own in the working folder.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        nodes_mm, tets = pytetwild.tetrahedralize(
            np.concatenate([part.vertices_mm for part in parts]),  # the binding takes writable
            np.concatenate(faces).astype(np.uint32),  # arrays of these types only
            edge_length_abs=edge_mm,
            epsilon=envelope,
            num_threads=1,
            loglevel=6,
            disable_filtering=inner is not None,
        )
    if inner is not None:
        tets = tets[contains(surface, nodes_mm[tets].mean(1))]
        used, compact = np.unique(largest_piece(tets), return_inverse=True)
        nodes_mm, tets = nodes_mm[used], compact.reshape(-1, 4).astype(np.int32)
    if len(tets) == 0:
        raise InputError("the surface encloses nothing that tetrahedra could fill; repair it.")
    tets = np.ascontiguousarray(tets, np.int32)
    turned = tet_volumes(nodes_mm, tets) < 0
    tets[turned, 2:] = tets[turned, :1:-1]
    return TetMesh(np.ascontiguousarray(nodes_mm, np.float64), tets)


def kept(path: Path, make: Callable[[], TetMesh]) -> TetMesh:
    """The mesh in a file, which is made and written if there is none."""
    if path.exists():
        return TetMesh(**load_file(path))
    mesh = make()
    store.write_atomically(path, save({"nodes_mm": mesh.nodes_mm, "tets": mesh.tets}))
    return mesh


def find(
    corners_mm: Float[np.ndarray, "t 4 3"],
    points_mm: Float[np.ndarray, "m 3"],
    candidates: int = _CANDIDATES,
) -> tuple[Int[np.ndarray, " m"], Float64[np.ndarray, "m 4"]]:
    """The tetrahedron that holds each point (the nearest for points just outside), and the
    point's barycentric weights there. ``candidates``: tetrahedra, nearest by their middles, among
    which each point's own is searched."""
    inverse = np.linalg.inv((corners_mm[:, 1:] - corners_mm[:, :1]).transpose(0, 2, 1))
    count = min(candidates, len(corners_mm))
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
