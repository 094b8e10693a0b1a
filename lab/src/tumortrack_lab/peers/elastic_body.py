"""A linear-elastic organ and the ways in which its surface deforms most easily.

Quadratic tetrahedra assembled by scikit-fem. Linear tetrahedra lock near incompressibility (a
constant volume per element leaves too few ways to move); quadratic ones do not at Poisson ratios
up to about 0.49.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int

from tumortrack.core.errors import InputError
from tumortrack_lab.tets import TetMesh, find

_RIGID_MODES = 6


@dataclass(frozen=True, eq=False)
class PeerElasticBody:
    """An organ's quadratic mesh and its modes.

    Attributes:
        corners_mm: of the tetrahedra.
        nodes: (t, 10) node numbers: four corners, then the edges in scikit-fem's order.
        modes: displacement of every node in every mode; their surface mean squares are 1 / area.
        stiffness: strain energy per squared amplitude, times 2, for a Young's modulus of 1.
        area_mm2: of the mesh's surface.
    """

    corners_mm: Float64[np.ndarray, "t 4 3"]
    nodes: Int[np.ndarray, "t 10"]
    modes: Float64[np.ndarray, "n 3 modes"]
    stiffness: Float64[np.ndarray, " modes"]
    area_mm2: float

    def modes_at(self, points_mm: Float[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 3 modes"]:
        """Displacement of the given points (undeformed, mm) in every mode."""
        element, shapes = self._shapes(points_mm)
        out = np.zeros((len(points_mm), *self.modes.shape[1:]))
        for column in range(shapes.shape[1]):
            out += shapes[:, column, None, None] * self.modes[self.nodes[element, column]]
        return out

    def displacement(
        self, points_mm: Float[np.ndarray, "m 3"], amplitudes: Float[np.ndarray, " modes"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Displacement of the given points (undeformed, mm), interpolated in their elements."""
        element, shapes = self._shapes(points_mm)
        moved = self.modes @ amplitudes
        return np.einsum("mk,mkc->mc", shapes, moved[self.nodes[element]])

    def _shapes(
        self, points_mm: Float[np.ndarray, "m 3"]
    ) -> tuple[Int[np.ndarray, " m"], Float64[np.ndarray, "m 10"]]:
        """Each point's element (the nearest for points just outside) and shape functions there."""
        element, weights = find(self.corners_mm, points_mm)
        return element, _quadratic(weights)


def _quadratic(weights: Float64[np.ndarray, "m 4"]) -> Float64[np.ndarray, "m 10"]:
    """Quadratic shape functions of barycentric weights."""
    edges = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    corner = weights * (2 * weights - 1)
    return np.concatenate(
        [corner, np.stack([4 * weights[:, a] * weights[:, b] for a, b in edges], 1)], axis=1
    )


def stiffness_matrix(tets: TetMesh, poisson: float) -> tuple[Any, Any]:
    """The sparse stiffness matrix for a Young's modulus of 1, and scikit-fem's basis over it."""
    from skfem import Basis, ElementTetP2, ElementVector, MeshTet
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    mesh = MeshTet(
        np.ascontiguousarray(tets.nodes_mm.T), np.ascontiguousarray(tets.tets.T, dtype=int)
    )
    basis = Basis(mesh, ElementVector(ElementTetP2()), intorder=2)
    return linear_elasticity(*lame_parameters(1.0, poisson)).assemble(basis), basis


def elastic_body(tets: TetMesh, poisson: float, modes: int) -> PeerElasticBody:
    """The body with its softest surface modes, rigid motions left out.

    Modes solve K u = s M u with K the stiffness and M the mass of the *surface* (Steklov's
    problem): among all fields with a given surface displacement they have the least strain
    energy inside, so a few hundred stand for every way in which forces on the surface deform the
    organ.

    Raises:
        InputError: more modes than the mesh's surface has, or the mesh is in pieces.
    """
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import LinearOperator, eigsh, splu
    from skfem import BilinearForm, FacetBasis
    from skfem.helpers import dot

    K, basis = stiffness_matrix(tets, poisson)
    facets = FacetBasis(basis.mesh, basis.elem, intorder=4)
    M = BilinearForm(lambda u, v, _: dot(u, v)).assemble(facets)
    if modes + _RIGID_MODES >= len(basis.get_dofs().flatten()):
        raise InputError(f"{modes} modes are more than this mesh's surface has; refine the mesh.")
    # K alone is singular; a shift of the size of the softest mode makes it definite.
    area = float(M.sum() / 3)
    shift = 0.1 / np.sqrt(area)
    solve = splu(
        csc_matrix(K + shift * M),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    inverse = LinearOperator(K.shape, matvec=solve.solve, dtype=float)
    start = np.random.default_rng(0).normal(size=K.shape[0])  # else ARPACK's own changes
    values, vectors = eigsh(
        K, k=modes + _RIGID_MODES, M=M, sigma=-shift, OPinv=inverse, v0=start, tol=1e-6
    )
    if values[_RIGID_MODES] < 1e-6 * values[-1]:
        raise InputError("the organ's mesh is in several pieces; one is needed.")
    mesh = basis.mesh
    numbers = np.concatenate([mesh.t, mesh.t2e + mesh.p.shape[1]]).T  # of corners, then of edges
    node_dofs = np.empty((numbers.max() + 1, 3), int)
    for axis in range(3):
        node_dofs[numbers, axis] = basis.element_dofs[axis::3].T
    return PeerElasticBody(
        corners_mm=mesh.p.T[mesh.t.T],
        nodes=numbers,
        modes=vectors[node_dofs][:, :, _RIGID_MODES:],
        stiffness=values[_RIGID_MODES:],
        area_mm2=area,
    )
