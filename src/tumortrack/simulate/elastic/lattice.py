"""A regular lattice of nodes over the organ: places, cells, trilinear weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64, Int

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

# The eight corners of a cell, the last axis fastest.
CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, eq=False)
class ElementLattice:
    """Nodes ``origin_mm + spacing_mm * (i, j, k)``; node numbers run with the last axis fastest."""

    origin_mm: Float64[np.ndarray, " 3"]
    spacing_mm: float
    shape: tuple[int, int, int]  # nodes along each axis

    @property
    def cells(self) -> tuple[int, int, int]:
        """Cells along each axis."""
        return self.shape[0] - 1, self.shape[1] - 1, self.shape[2] - 1

    def nodes_mm(self) -> Float64[np.ndarray, "n 3"]:
        """Places of all nodes, in the order of their numbers."""
        return self.origin_mm + self.spacing_mm * np.indices(self.shape).reshape(3, -1).T

    def cell_nodes(self) -> Int[np.ndarray, "c 8"]:
        """Numbers of each cell's corners, in the order of ``CORNERS``."""
        lowest = np.indices(self.cells).reshape(3, -1).T
        return np.ravel_multi_index(tuple(np.moveaxis(lowest[:, None] + CORNERS, 2, 0)), self.shape)

    def weights(self, points_mm: Float[np.ndarray, "p 3"]) -> csr_matrix:
        """Sparse (p, n): value at a point = weights @ values at nodes; beyond the lattice that of
        its nearest border."""
        from scipy.sparse import csr_matrix

        place = np.clip((points_mm - self.origin_mm) / self.spacing_mm, 0, np.array(self.cells))
        lowest = np.minimum(place.astype(int), np.array(self.cells) - 1)
        part = (place - lowest)[:, None]
        weight = np.where(CORNERS, part, 1 - part).prod(2)
        number = np.ravel_multi_index(
            tuple(np.moveaxis(lowest[:, None] + CORNERS, 2, 0)), self.shape
        )
        rows = np.repeat(np.arange(len(points_mm)), 8)
        size = (len(points_mm), int(np.prod(self.shape)))
        return csr_matrix((weight.ravel(), (rows, number.ravel())), size)


def lattice_over(
    box_mm: Float64[np.ndarray, "2 3"], spacing_mm: float, margin: float = 2.0
) -> ElementLattice:
    """The lattice about a box with a margin of so many cells on every side."""
    extent = box_mm[1] - box_mm[0]
    cells = np.ceil(extent / spacing_mm + 2 * margin).astype(int)
    origin = box_mm.mean(0) - cells * spacing_mm / 2
    return ElementLattice(
        origin, spacing_mm, (int(cells[0]) + 1, int(cells[1]) + 1, int(cells[2]) + 1)
    )
