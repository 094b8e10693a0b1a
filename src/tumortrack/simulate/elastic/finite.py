"""Linear elasticity of an organ on a regular lattice of cubes.

A cell counts by the share of it that the organ fills; outside is a fictitious medium, so soft that
it only carries the displacement on, and no mesh has to follow the surface (finite cell method:
Parvizian, Duester and Rank 2007, doi 10.1007/s00466-007-0173-y). Each cube has the mean of its
dilatation instead of its course (B-bar: Hughes 1980, doi 10.1002/nme.1620150914), so that tissue
that keeps its volume does not lock.

Forces are in N, lengths in mm, stiffness for a Young's modulus of 1 N/mm2 unless said.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64, Int

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulate.elastic.lattice import CORNERS, ElementLattice
from tumortrack.simulate.elastic.slabs import SlabCholesky
from tumortrack.simulate.occupancy import contains

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

VOID = 1e-2  # stiffness of the medium outside, of the organ's
_SUBCELLS = 3  # along each axis, to measure how full a cell is
_ANCHOR = 1e-6  # of the stiffness: holds the rigid motions, which no load here excites


def cube_stiffness(
    poisson: float,
) -> tuple[Float64[np.ndarray, "24 24"], Float64[np.ndarray, " 24"]]:
    """Of a unit cube with Young's modulus 1: stiffness, and mean dilatation per displacement.

    Unknowns: x, y, z of the corners in the order of ``CORNERS``. A cube of edge h has h times
    this stiffness, and 1 / h times this dilatation.
    """
    shear = 1 / (2 * (1 + poisson))
    bulk = 1 / (3 * (1 - 2 * poisson))
    gauss = 0.5 + CORNERS_SIGN / (2 * np.sqrt(3))
    strains = np.stack([_strain(x) for x in gauss])  # (8, 6, 24)
    traces = strains[:, :3].sum(1)
    deviators = strains.copy()
    deviators[:, :3] -= traces[:, None] / 3
    weight = shear * np.array([2.0, 2, 2, 1, 1, 1])
    dilatation = traces.mean(0)
    stiffness = np.einsum("gsa,s,gsb->ab", deviators, weight, deviators) / 8
    return stiffness + bulk * np.outer(dilatation, dilatation), dilatation


CORNERS_SIGN = 2.0 * CORNERS - 1


def _strain(x: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "6 24"]:
    """Strain (xx, yy, zz, xy, yz, zx; the last three doubled) at a place of the unit cube."""
    factors = np.where(CORNERS, x, 1 - x)
    rest = np.stack([factors[:, [1, 2]], factors[:, [0, 2]], factors[:, [0, 1]]], 1).prod(2)
    slope = CORNERS_SIGN * rest  # of each corner's shape function
    strain = np.zeros((6, 8, 3))
    for a, b, row in ((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 1, 3), (1, 2, 4), (2, 0, 5)):
        strain[row, :, a] = slope[:, b]
        strain[row, :, b] = slope[:, a]
    return strain.reshape(6, 24)


def filled(mesh: Mesh, lattice: ElementLattice) -> Float64[np.ndarray, " c"]:
    """The share of each cell that lies in a closed surface."""
    n, s = np.array(lattice.cells), _SUBCELLS
    fine = np.indices(tuple(n * s)).reshape(3, -1).T
    points = lattice.origin_mm + lattice.spacing_mm * (fine + 0.5) / s
    lower, upper = mesh.box_mm
    near = ((points > lower) & (points < upper)).all(1)
    inside = np.zeros(len(points))
    inside[near] = contains(mesh, points[near])
    return inside.reshape(n[0], s, n[1], s, n[2], s).mean((1, 3, 5)).ravel()


@dataclass(frozen=True, eq=False)
class LatticeSolid:
    """An organ on its lattice. Cells far from it are left out; arrays run over the ``nodes``
    that remain, ordered in slabs along the lattice's longest axis."""

    lattice: ElementLattice
    poisson: float
    organ: Float64[np.ndarray, " c"]  # share of each cell that is left
    tumor: Float64[np.ndarray, " c"]
    cells: Int[np.ndarray, "c 8"]  # numbers among ``nodes``
    nodes: Int[np.ndarray, " n"]  # numbers in the lattice
    bounds: list[int]  # first node of each slab, and the end

    @cached_property
    def volume_mm3(self) -> Float64[np.ndarray, " n"]:
        """The organ's volume, shared out to the nodes."""
        share = np.repeat(self.organ * self.lattice.spacing_mm**3 / 8, 8)
        return np.bincount(self.cells.ravel(), share, len(self.nodes))

    @cached_property
    def nodes_mm(self) -> Float64[np.ndarray, "n 3"]:
        return self.lattice.nodes_mm()[self.nodes]

    @cached_property
    def center_mm(self) -> Float64[np.ndarray, " 3"]:
        """The organ's centre of mass."""
        return self.volume_mm3 @ self.nodes_mm / self.volume_mm3.sum()

    @cached_property
    def swelling(self) -> Float64[np.ndarray, " f"]:
        """Forces of a volume strain of 1 that is held back, at a Young's modulus of 1."""
        _, dilatation = cube_stiffness(self.poisson)
        force = self.organ * self.lattice.spacing_mm**2 / (3 * (1 - 2 * self.poisson))
        return np.bincount(
            self._unknowns.ravel(), np.outer(force, dilatation).ravel(), 3 * len(self.nodes)
        )

    def stiffness(self, moduli: Float[np.ndarray, " c"]) -> csr_matrix:
        """The stiffness matrix for a Young's modulus (N/mm2) in each cell."""
        from scipy.sparse import coo_matrix

        cube, _ = cube_stiffness(self.poisson)
        values = (moduli * self.lattice.spacing_mm)[:, None] * cube.ravel()
        rows, columns = np.repeat(self._unknowns, 24, 1), np.tile(self._unknowns, (1, 24))
        size = 3 * len(self.nodes)
        entries = (values.ravel(), (rows.ravel(), columns.ravel()))
        return coo_matrix(entries, (size, size)).tocsr()

    def factor(self, contrast: float) -> SlabCholesky:
        """Of the stiffness with tumors so many times stiffer than the organ; its rigid motions
        are held by next to nothing."""
        from scipy.sparse import diags

        stiffness = self.stiffness(np.maximum(self.organ, VOID) + (contrast - 1) * self.tumor)
        inertia = np.repeat(self.volume_mm3 / self.volume_mm3.max(), 3)
        held = stiffness + diags(_ANCHOR * stiffness.diagonal().max() * inertia)
        return SlabCholesky(held.tocsr(), [3 * b for b in self.bounds])

    def spread(self, values: Float[np.ndarray, "f k"]) -> Float[np.ndarray, "i j l 3 k"]:
        """Values of the unknowns on the whole lattice: a node that was left out takes those of
        its nearest neighbour."""
        from scipy.ndimage import distance_transform_edt

        absent = np.ones(self.lattice.shape, bool)
        absent.ravel()[self.nodes] = False
        nearest = distance_transform_edt(absent, return_distances=False, return_indices=True)
        number = np.empty(self.lattice.shape, int)
        number.ravel()[self.nodes] = np.arange(len(self.nodes))
        return values.reshape(len(self.nodes), 3, -1)[number[tuple(nearest)]]

    @property
    def _unknowns(self) -> Int[np.ndarray, "c 24"]:
        return (3 * self.cells[:, :, None] + np.arange(3)).reshape(len(self.cells), 24)


def solid_of(anatomy_ct: Anatomy, lattice: ElementLattice, poisson: float) -> LatticeSolid:
    """The organ and its tumors on a lattice; cells that do not touch a filled one are left out."""
    from scipy.ndimage import binary_dilation

    organ = filled(anatomy_ct.organ, lattice)
    tumor = np.zeros_like(organ)
    for part in anatomy_ct.tumors:
        tumor = np.maximum(tumor, filled(part, lattice))
    near = binary_dilation((organ > 0).reshape(lattice.cells), np.ones((3, 3, 3))).ravel()
    corners = lattice.cell_nodes()[near]
    axis = int(np.argmax(lattice.shape))
    used = np.unique(corners)
    slab = np.unravel_index(used, lattice.shape)[axis]
    order = np.argsort(slab, kind="stable")
    nodes = used[order]
    number = np.empty(int(np.prod(lattice.shape)), int)
    number[nodes] = np.arange(len(nodes))
    first = np.flatnonzero(np.diff(slab[order], prepend=-1))
    return LatticeSolid(
        lattice,
        poisson,
        organ[near],
        np.minimum(tumor, organ)[near],
        number[corners],
        nodes,
        [*first.tolist(), len(nodes)],
    )
