"""Linear elasticity of an organ on a regular lattice of cubes.

An element is weighted by the fraction of it that the organ fills. Outside is a fictitious medium,
so soft that it only extends the displacement; no mesh has to follow the surface (finite cell
method: Parvizian, Duester and Rank 2007, doi 10.1007/s00466-007-0173-y). The dilatation is averaged
over each cube (B-bar: Hughes 1980, doi 10.1002/nme.1620150914), so that nearly incompressible
tissue does not lock.

Forces are in N, lengths in mm, stiffness for a Young's modulus of 1 N/mm2 unless stated otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.linalg import cholesky, solve_triangular
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.sparse import coo_matrix, csr_matrix, diags

from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Anatomy, Mesh

Points = Float[np.ndarray, "p 3"]
VOID = 1e-2  # stiffness of the medium outside, relative to the organ's
CONTRAST = 3.0  # of tumors for the compliance, the middle one of the library's responses
_SUBCELLS = 3  # samples along each axis of a cell for its filled fraction
_ANCHOR = 1e-6  # relative stiffness that holds the rigid motions, which no load here excites

# The eight corners of a cell, the last axis fastest.
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_CORNER_SIGNS = 2.0 * CORNERS - 1


@dataclass(frozen=True, eq=False)
class ElementLattice:
    """Nodes ``origin_mm + spacing_mm * (i, j, k)``; node numbers run with the last axis fastest."""

    origin_mm: Float64[np.ndarray, " 3"]
    spacing_mm: float
    shape: tuple[int, ...]  # nodes along each axis

    @classmethod
    def around(cls, box_mm: Float64[np.ndarray, "2 3"], spacing_mm: float) -> ElementLattice:
        """The lattice around a box, with a margin of two cells on every side."""
        cells = np.ceil((box_mm[1] - box_mm[0]) / spacing_mm + 4.0).astype(int)
        origin_mm = box_mm.mean(0) - cells * spacing_mm / 2
        return cls(origin_mm, spacing_mm, tuple((cells + 1).tolist()))

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along each axis."""
        return tuple(nodes - 1 for nodes in self.shape)

    def nodes_mm(self) -> Float64[np.ndarray, "n 3"]:
        """All nodes, in the order of their numbers."""
        return self.origin_mm + self.spacing_mm * np.indices(self.shape).reshape(3, -1).T

    def weights(self, points_mm: Points) -> csr_matrix:
        """Sparse (p, n): trilinear values at points = weights @ values at nodes; points beyond the
        lattice are clamped to its border."""
        place = np.clip((points_mm - self.origin_mm) / self.spacing_mm, 0, np.array(self.cells))
        lowest = np.minimum(place.astype(int), np.array(self.cells) - 1)
        fraction = (place - lowest)[:, None]
        weight = np.where(CORNERS, fraction, 1 - fraction).prod(2)
        entries = (np.repeat(np.arange(len(points_mm)), 8), self.corner_nodes(lowest).ravel())
        return csr_matrix((weight.ravel(), entries), (len(points_mm), int(np.prod(self.shape))))

    def corner_nodes(self, lowest: Int[np.ndarray, "c 3"]) -> Int[np.ndarray, "c 8"]:
        """Node numbers of cells' corners, in the order of ``CORNERS``."""
        return np.ravel_multi_index(tuple(np.moveaxis(lowest[:, None] + CORNERS, 2, 0)), self.shape)


def cube_stiffness(poisson: float) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness (24, 24), and mean dilatation per displacement (24,), of a unit cube with Young's
    modulus 1. Unknowns: x, y, z of the corners in the order of ``CORNERS``. A cube of edge h has h
    times this stiffness, and 1 / h times this dilatation."""
    shear = 1 / (2 * (1 + poisson))
    bulk = 1 / (3 * (1 - 2 * poisson))
    gauss = 0.5 + _CORNER_SIGNS / (2 * np.sqrt(3))
    strains = np.stack([_strain(x) for x in gauss])  # (8, 6, 24)
    traces = strains[:, :3].sum(1)
    deviators = strains.copy()
    deviators[:, :3] -= traces[:, None] / 3
    weight = shear * np.array([2.0, 2, 2, 1, 1, 1])
    dilatation = traces.mean(0)
    stiffness = np.einsum("gsa,s,gsb->ab", deviators, weight, deviators) / 8
    return stiffness + bulk * np.outer(dilatation, dilatation), dilatation


def _strain(x: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "6 24"]:
    """Strain (xx, yy, zz, xy, yz, zx; the last three doubled) at a position in the unit cube."""
    factors = np.where(CORNERS, x, 1 - x)
    rest = np.stack([factors[:, [1, 2]], factors[:, [0, 2]], factors[:, [0, 1]]], 1).prod(2)
    slope = _CORNER_SIGNS * rest  # of each corner's shape function
    strain = np.zeros((6, 8, 3))
    for a, b, row in ((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 1, 3), (1, 2, 4), (2, 0, 5)):
        strain[row, :, a] = slope[:, b]
        strain[row, :, b] = slope[:, a]
    return strain.reshape(6, 24)


def _filled(mesh: Mesh, lattice: ElementLattice) -> Float64[np.ndarray, " c"]:
    """The fraction of each cell that lies inside a closed surface."""
    n, s = np.array(lattice.cells), _SUBCELLS
    subcells = np.indices(tuple(n * s)).reshape(3, -1).T
    points = lattice.origin_mm + lattice.spacing_mm * (subcells + 0.5) / s
    lower, upper = mesh.box_mm
    in_box = ((points > lower) & (points < upper)).all(1)
    inside = np.zeros(len(points))
    inside[in_box] = contains(mesh, points[in_box])
    return inside.reshape(n[0], s, n[1], s, n[2], s).mean((1, 3, 5)).ravel()


class LatticeSolid:
    """An organ and its tumors on a lattice. Cells that do not touch a filled one are left out; the
    nodes are ordered by layers along the lattice's longest axis."""

    def __init__(self, anatomy_ct: Anatomy, lattice: ElementLattice, poisson: float) -> None:
        organ = _filled(anatomy_ct.organ, lattice)
        tumor = np.zeros_like(organ)
        for part in anatomy_ct.tumors:
            tumor = np.maximum(tumor, _filled(part, lattice))
        near = binary_dilation((organ > 0).reshape(lattice.cells), np.ones((3, 3, 3))).ravel()
        self.lattice, self.poisson = lattice, poisson
        self.cells = np.argwhere(near.reshape(lattice.cells))  # those kept
        # The filled fraction of each cell kept.
        self.organ, self.tumor = organ[near], np.minimum(tumor, organ)[near]
        corners = lattice.corner_nodes(np.indices(lattice.cells).reshape(3, -1).T[near])
        used = np.unique(corners)
        layer = np.unravel_index(used, lattice.shape)[int(np.argmax(lattice.shape))]
        order = np.argsort(layer, kind="stable")
        self.nodes = used[order]  # their numbers in the lattice
        starts = np.flatnonzero(np.diff(layer[order], prepend=-1))
        self.bounds = [*starts.tolist(), len(self.nodes)]  # of the layers
        number = np.empty(int(np.prod(lattice.shape)), int)
        number[self.nodes] = np.arange(len(self.nodes))
        cells = number[corners]
        self.unknowns = (3 * cells[:, :, None] + np.arange(3)).reshape(-1, 24)  # by cell
        volume = np.repeat(self.organ * lattice.spacing_mm**3 / 8, 8)  # distributed over the nodes
        self.volume_mm3 = np.bincount(cells.ravel(), volume, len(self.nodes))
        self.nodes_mm = lattice.nodes_mm()[self.nodes]
        self.center_mm = self.volume_mm3 @ self.nodes_mm / self.volume_mm3.sum()

    @cached_property
    def swelling(self) -> Float64[np.ndarray, " f"]:
        """Forces of a suppressed volume strain of 1, at a Young's modulus of 1."""
        _, dilatation = cube_stiffness(self.poisson)
        force = self.organ * self.lattice.spacing_mm**2 / (3 * (1 - 2 * self.poisson))
        weights = np.outer(force, dilatation).ravel()
        return np.bincount(self.unknowns.ravel(), weights, 3 * len(self.nodes))

    def weights(self, points_mm: Points) -> csr_matrix:
        """Sparse (p, n): values at points from values at the solid's nodes."""
        return self.lattice.weights(points_mm)[:, self.nodes]

    def at(self, points_mm: Points, values: Float[np.ndarray, "f k"]) -> Float[np.ndarray, "p 3 k"]:
        """Values of the unknowns at points."""
        by_node = values.reshape(len(self.nodes), -1)
        return (self.weights(points_mm) @ by_node).reshape(len(points_mm), 3, -1)

    def stiffness(self, moduli: Float[np.ndarray, " c"]) -> csr_matrix:
        """The stiffness matrix for a Young's modulus (N/mm2) in each cell."""
        cube, _ = cube_stiffness(self.poisson)
        values = (moduli * self.lattice.spacing_mm)[:, None] * cube.ravel()
        rows, columns = np.repeat(self.unknowns, 24, 1), np.tile(self.unknowns, (1, 24))
        size = 3 * len(self.nodes)
        entries = (values.ravel(), (rows.ravel(), columns.ravel()))
        return coo_matrix(entries, (size, size)).tocsr()

    @cached_property
    def usual_factor(self) -> BlockCholesky:
        """The factor for ``CONTRAST``, kept: responses and compliance ask for it."""
        return self.factor_of(self.moduli(CONTRAST))

    def factor(self, contrast: float) -> BlockCholesky:
        """Factor of the stiffness with tumors ``contrast`` times as stiff as the organ; the rigid
        motions are held very softly."""
        if contrast == CONTRAST:
            return self.usual_factor
        return self.factor_of(self.moduli(contrast))

    def moduli(self, contrast: float) -> Float64[np.ndarray, " c"]:
        """Of each cell, over the organ's, with tumors ``contrast`` times as stiff."""
        return np.maximum(self.organ, VOID) + (contrast - 1) * self.tumor

    def factor_of(self, moduli: Float64[np.ndarray, " c"]) -> BlockCholesky:
        """As ``factor``, for any stiffness of the cells."""
        stiffness = self.stiffness(moduli)
        inertia = np.repeat(self.volume_mm3 / self.volume_mm3.max(), 3)
        held = stiffness + diags(_ANCHOR * stiffness.diagonal().max() * inertia)
        return BlockCholesky(held.tocsr(), [3 * b for b in self.bounds])

    def spread(self, values: Float[np.ndarray, "f k"]) -> Float[np.ndarray, "i j l 3 k"]:
        """Values of the unknowns on the whole lattice; nodes that were left out take those of
        their nearest neighbour."""
        absent = np.ones(self.lattice.shape, bool)
        absent.ravel()[self.nodes] = False
        nearest = distance_transform_edt(absent, return_distances=False, return_indices=True)
        number = np.empty(self.lattice.shape, int)
        number.ravel()[self.nodes] = np.arange(len(self.nodes))
        return values.reshape(len(self.nodes), 3, -1)[number[tuple(nearest)]]


class BlockCholesky:
    """Cholesky factor of a symmetric positive definite, block tridiagonal matrix.

    A lattice cut across its longest axis has such a stiffness. Every block is dense after
    elimination, so BLAS works on whole blocks and all right-hand sides at once: for an organ of
    about 10,000 unknowns this is many times faster than sparse factorisations with a general
    ordering. Block s holds the unknowns ``bounds[s] : bounds[s + 1]``; entries between blocks that
    are not adjacent must be zero.
    """

    def __init__(self, matrix: csr_matrix, bounds: list[int]) -> None:
        self._blocks = [slice(a, b) for a, b in pairwise(bounds)]
        self._diagonal: list[np.ndarray] = []  # lower factor of each block
        self._coupling: list[np.ndarray] = []  # of block s with s + 1
        for s, block in enumerate(self._blocks):
            diagonal = matrix[block, block].toarray()
            if s:
                diagonal -= self._coupling[-1].T @ self._coupling[-1]
            factor = cholesky(diagonal, lower=True, overwrite_a=True, check_finite=False)
            self._diagonal.append(factor)
            if s + 1 < len(self._blocks):
                coupling = matrix[block, self._blocks[s + 1]].toarray()
                self._coupling.append(self._solve(s, coupling))

    def solve(self, right: Float64[np.ndarray, "n r"]) -> Float64[np.ndarray, "n r"]:
        """Solutions for all right-hand sides."""
        x, blocks = np.empty_like(right), self._blocks
        for s, block in enumerate(blocks):
            part = right[block]
            if s:
                part = part - self._coupling[s - 1].T @ x[blocks[s - 1]]
            x[block] = self._solve(s, part)
        for s in reversed(range(len(blocks))):
            part = x[blocks[s]]
            if s + 1 < len(blocks):
                part = part - self._coupling[s] @ x[blocks[s + 1]]
            x[blocks[s]] = self._solve(s, part, trans="T")
        return x

    def _solve(self, s: int, right: np.ndarray, trans: str = "N") -> np.ndarray:
        factor = self._diagonal[s]
        return solve_triangular(factor, right, lower=True, trans=trans, check_finite=False)
