"""A nearly incompressible hyperelastic solid on linear tetrahedra: energy, forces, stiffness.

Neo-Hookean: W = mu/2 (J^(-2/3) tr(F^T F) - 3) + kappa/2 (J - 1)^2. Linear tetrahedra lock when
volume is kept in each of them, so J is averaged at the nodes (Bonet and Burton 1998, doi
10.1002/(SICI)1099-0887(199805)14:5<437::AID-CNM162>3.0.CO;2-W), with a small share kept per
tetrahedron against the spurious modes of nodal averages (Puso and Solberg 2006, doi
10.1002/nme.1681). The first term grows without bound as J falls to 0: no element turns over.

Units: mm, kPa, hence mN and uJ.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int32
from scipy.sparse import csr_matrix, diags

from tumortrack.core.compiled import njit
from tumortrack_lab.tets import TetMesh

PER_TET = 0.05  # share of the bulk modulus that is kept per tetrahedron

Nodes = Float64[np.ndarray, "n 3"]


class _RestElements(NamedTuple):
    """What the energy needs of the unloaded mesh. ``inner``: rows say how the corners 1, 2, 3 move
    the field's gradient (1/mm); corner 0 balances them."""

    tets: Int32[np.ndarray, "t 4"]
    inner: Float64[np.ndarray, "t 3 3"]
    volumes_mm3: Float64[np.ndarray, " t"]
    node_volumes_mm3: Float64[np.ndarray, " n"]
    shear_kpa: Float64[np.ndarray, " t"]
    bulk_kpa: Float64[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class NeoHookeanSolid:
    mesh: TetMesh  # at rest, free of stress
    shear_kpa: Float[np.ndarray, " t"]  # of each tetrahedron: Young's modulus / (2 (1 + poisson))
    poisson: float = 0.49  # near 0.5; 0.49 makes the bulk modulus 50 times the shear modulus

    @cached_property
    def node_volumes_mm3(self) -> Float64[np.ndarray, " n"]:
        return self.mesh.lump(self.mesh.volumes_mm3)

    @cached_property
    def bulk_kpa(self) -> Float64[np.ndarray, " n"]:
        """Bulk modulus at each node: the mean over what it holds."""
        ratio = 2 * (1 + self.poisson) / (3 * (1 - 2 * self.poisson))
        held = self.mesh.lump(ratio * self.shear_kpa * self.mesh.volumes_mm3)
        return held / self.node_volumes_mm3

    @cached_property
    def _rest(self) -> _RestElements:
        corners = self.mesh.nodes_mm[self.mesh.tets]
        edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
        inner, shear = np.ascontiguousarray(np.linalg.inv(edges)), np.asarray(self.shear_kpa, float)
        volumes = self.mesh.volumes_mm3, self.node_volumes_mm3
        return _RestElements(self.mesh.tets, inner, *volumes, shear, self.bulk_kpa)

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        """Elastic energy (uJ) and its gradient (mN); infinite where an element has turned over."""
        gradient = np.zeros_like(nodes_mm)
        return _neo_hookean(nodes_mm, self._rest, gradient), gradient

    def stretch(self, nodes_mm: Nodes) -> Float64[np.ndarray, " t"]:
        """J of each tetrahedron: present over rest volume."""
        return TetMesh(nodes_mm, self.mesh.tets).volumes_mm3 / self.mesh.volumes_mm3

    @cached_property
    def rest_stiffness(self) -> csr_matrix:
        """The energy's Hessian at rest, (3 n, 3 n), mN/mm, unknowns node by node."""
        tets, volumes = self.mesh.tets, self.mesh.volumes_mm3
        inner = self._rest.inner
        shape = np.concatenate([-inner.sum(1, keepdims=True), inner], axis=1)  # (t, 4, 3)
        mu = self.shear_kpa * volumes
        bulk = PER_TET * self.bulk_kpa[tets].mean(1) * volumes
        # eps : C : eps with the deviatoric part of twice mu, and the bulk part.
        block = np.einsum("t,tai,tbj->taibj", bulk - 2 / 3 * mu, shape, shape)
        block += np.einsum("t,taj,tbi->taibj", mu, shape, shape)
        same = np.einsum("t,tak,tbk->tab", mu, shape, shape)
        block += same[:, :, None, :, None] * np.eye(3)[None, None, :, None, :]
        unknowns = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
        size = 3 * len(self.mesh.nodes_mm)
        rows, columns = np.repeat(unknowns, 12, axis=1), np.tile(unknowns, (1, 12))
        places = rows.reshape(-1), columns.reshape(-1)
        stiffness = csr_matrix((block.reshape(-1), places), shape=(size, size))
        share = (volumes[:, None, None] / 4 * shape).reshape(-1, 12)
        places = np.repeat(tets, 12, axis=1).reshape(-1), np.tile(unknowns, (1, 4)).reshape(-1)
        shares = np.tile(share, (1, 4)).reshape(-1)
        swelling = csr_matrix((shares, places), shape=(size // 3, size))
        held = diags((1 - PER_TET) * self.bulk_kpa / self.node_volumes_mm3)
        return (stiffness + swelling.T @ held @ swelling).tocsr()


@njit()
def _deformation(nodes, tet, inner, out):  # type: ignore[no-untyped-def]
    """Fill the deformation gradient, return its determinant."""
    for i in range(3):
        start = nodes[tet[0], i]
        u, v, w = nodes[tet[1], i] - start, nodes[tet[2], i] - start, nodes[tet[3], i] - start
        for j in range(3):
            out[i, j] = u * inner[0, j] + v * inner[1, j] + w * inner[2, j]
    return (
        out[0, 0] * (out[1, 1] * out[2, 2] - out[1, 2] * out[2, 1])
        - out[0, 1] * (out[1, 0] * out[2, 2] - out[1, 2] * out[2, 0])
        + out[0, 2] * (out[1, 0] * out[2, 1] - out[1, 1] * out[2, 0])
    )


@njit()
def _neo_hookean(nodes, rest, gradient):  # type: ignore[no-untyped-def]
    """The energy; fills its gradient."""
    tets, inner, volume, node_volume, shear, bulk = rest
    F, P = np.empty((3, 3)), np.empty((3, 3))
    pressure = np.zeros(len(nodes))  # first the present volume of each node
    for t in range(len(tets)):
        J = _deformation(nodes, tets[t], inner[t], F)
        if not J > 0:
            return np.inf
        for k in range(4):
            pressure[tets[t, k]] += J * volume[t] / 4
    energy = 0.0
    for n in range(len(nodes)):
        swelling = pressure[n] / node_volume[n] - 1
        pressure[n] = (1 - PER_TET) * bulk[n] * swelling
        energy += pressure[n] * swelling * node_volume[n] / 2
    for t in range(len(tets)):
        tet = tets[t]
        J = _deformation(nodes, tet, inner[t], F)
        trace = (F * F).sum()
        scale = J ** (-2 / 3)
        own = PER_TET * (bulk[tet[0]] + bulk[tet[1]] + bulk[tet[2]] + bulk[tet[3]]) / 4
        energy += volume[t] * (shear[t] * (scale * trace - 3) + own * (J - 1) ** 2) / 2
        p = (pressure[tet[0]] + pressure[tet[1]] + pressure[tet[2]] + pressure[tet[3]]) / 4
        p += own * (J - 1) - shear[t] * scale * trace / (3 * J)
        for i in range(3):  # first Piola-Kirchhoff stress; dJ/dF is the cofactor matrix
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                cofactor = F[a, c] * F[b, d] - F[a, d] * F[b, c]
                P[i, j] = volume[t] * (shear[t] * scale * F[i, j] + p * cofactor)
        for k in range(3):
            for i in range(3):
                force = P[i, 0] * inner[t, k, 0] + P[i, 1] * inner[t, k, 1]
                force += P[i, 2] * inner[t, k, 2]
                gradient[tet[k + 1], i] += force
                gradient[tet[0], i] -= force
    return energy
