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
from jaxtyping import Float, Float64
from scipy.sparse import csr_matrix, diags

from tumortrack.organ.tets import TetMesh

PER_TET = 0.05  # share of the bulk modulus that is kept per tetrahedron

Nodes = Float64[np.ndarray, "n 3"]


class _RestElements(NamedTuple):
    """What the energy needs of the unloaded mesh. ``inner``: rows say how the corners 1, 2, 3 move
    the field's gradient (1/mm); corner 0 balances them. ``slopes`` @ nodes is that gradient, the
    first axis of all tetrahedra before the second; ``quarters`` @ nodes the mean over corners."""

    inner: Float64[np.ndarray, "t 3 3"]
    slopes: csr_matrix  # (3 t, n)
    slopes_back: csr_matrix  # the transpose
    quarters: csr_matrix  # (t, n)
    quarters_back: csr_matrix


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
    def _own_kpa(self) -> Float64[np.ndarray, " t"]:
        """Bulk modulus that is kept per tetrahedron."""
        return PER_TET * self.bulk_kpa[self.mesh.tets].mean(1)

    @cached_property
    def _rest(self) -> _RestElements:
        tets, n, t = self.mesh.tets, len(self.mesh.nodes_mm), len(self.mesh.tets)
        corners = self.mesh.nodes_mm[tets]
        inner = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
        shape = np.concatenate([-inner.sum(1, keepdims=True), inner], axis=1)  # (t, 4, 3)
        values, columns = shape.transpose(2, 0, 1).ravel(), np.tile(tets.ravel(), 3)
        slopes = csr_matrix((values, columns, np.arange(0, 12 * t + 1, 4)), (3 * t, n))
        starts = np.arange(0, 4 * t + 1, 4)
        quarters = csr_matrix((np.full(4 * t, 0.25), tets.ravel(), starts), (t, n))
        return _RestElements(inner, slopes, slopes.T.tocsr(), quarters, quarters.T.tocsr())

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]:
        """Elastic energy (uJ) and its gradient (mN); infinite where an element has turned over."""
        rest, volumes, t = self._rest, self.mesh.volumes_mm3, len(self.mesh.tets)
        F = np.ascontiguousarray((rest.slopes @ nodes_mm).T).reshape(3, 3, t)
        cofactors = _cofactors(F)
        J = (F[0] * cofactors[0]).sum(0)
        if not (J > 0).all():
            return np.inf, np.zeros_like(nodes_mm)
        swelling = rest.quarters_back @ (J * volumes) / self.node_volumes_mm3 - 1
        pressure = (1 - PER_TET) * self.bulk_kpa * swelling
        scale, trace = self.shear_kpa * np.cbrt(J) ** -2, (F * F).sum((0, 1))
        own = self._own_kpa * (J - 1)
        energy = pressure * self.node_volumes_mm3 @ swelling
        energy += volumes @ (scale * trace - 3 * self.shear_kpa + own * (J - 1))
        p = rest.quarters @ pressure + own - scale * trace / (3 * J)
        # First Piola-Kirchhoff stress; dJ/dF is the cofactor matrix.
        stress = (volumes * scale) * F + (volumes * p) * cofactors
        return float(energy) / 2, rest.slopes_back @ stress.reshape(3, 3 * t).T

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


def _cofactors(matrices: Float64[np.ndarray, "3 3 t"]) -> Float64[np.ndarray, "3 3 t"]:
    """The determinants' slopes."""
    one, two = matrices[[1, 2, 0]], matrices[[2, 0, 1]]
    next_, last = [1, 2, 0], [2, 0, 1]
    return one[:, next_] * two[:, last] - one[:, last] * two[:, next_]
