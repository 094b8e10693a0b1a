"""How an organ in its bed takes loads: equilibrium with one-sided contacts in the space of modes.

Unknowns are the modes' coefficients and six rigid ones. The bed is a layer of springs on the
underside, obstacles are stiff springs that only push. Each Newton step solves for the contacts
that the last one left closed. Lengths in mm, stress in N/mm2 (1 kPa = 1e-3).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numba
import numpy as np
from jaxtyping import Float64

from tumortrack.simulate.elastic.finite import Solid
from tumortrack.simulate.elastic.modes import Modes
from tumortrack.simulate.elastic.surface import Patches

KPA = 1e-3  # N/mm2
_LEVER_MM = 50.0  # a rigid turn's unknown is the motion at this arm
_FREE = 1e-4  # N/mm: keeps the rigid motions solvable where nothing touches
_MOST_STEPS = 20
_SETTLED_MM = 1e-2


class Reduced:
    """A solid in the space of its modes and six rigid motions (k + 6 unknowns)."""

    def __init__(self, solid: Solid, modes: Modes, patches: Patches) -> None:
        k, n = modes.shapes.shape[1], len(solid.nodes)
        self.patches = patches
        self.n_modes = k
        weights = solid.lattice.weights(patches.points_mm)[:, solid.nodes]
        bent = (weights @ modes.shapes.reshape(n, -1)).reshape(-1, 3, k)
        arms = (patches.points_mm - solid.center_mm) / _LEVER_MM
        turned = np.stack([np.cross(axis, arms) for axis in np.eye(3)], -1)
        shifted = np.broadcast_to(np.eye(3), turned.shape)
        self.moves = np.concatenate([bent, shifted, turned], -1)  # (p, 3, k + 6)
        volume = solid.volume_mm3
        mean = np.tensordot(volume, modes.shapes.reshape(n, 3, k), 1)
        rigid = np.concatenate([np.eye(3) * volume.sum(), np.zeros((3, 3))], 1)
        self.volume_moves = np.concatenate([mean, rigid], 1)  # (3, k + 6), mm3
        self.swelling = np.append(modes.shapes.T @ solid.swelling, np.zeros(6))
        self._tissue = modes.shapes.T @ (solid.stiffness(solid.organ) @ modes.shapes)
        self._tumors = modes.shapes.T @ (solid.stiffness(solid.tumor) @ modes.shapes)

    def stiffness(self, modulus: float, contrast: float) -> Float64[np.ndarray, "m m"]:
        """For the tissue's Young's modulus (N/mm2) and how many times stiffer the tumors are."""
        whole = np.zeros((self.n_modes + 6, self.n_modes + 6))
        bent = modulus * (self._tissue + (contrast - 1) * self._tumors)
        whole[: self.n_modes, : self.n_modes] = bent
        whole[self.n_modes :, self.n_modes :] = _FREE * np.eye(6)
        return whole

    def along(self, direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "p m"]:
        """How far each patch moves along a direction, per unknown."""
        return np.einsum("d,pdm->pm", direction, self.moves)


@dataclass(eq=False)
class Problem:
    """What acts on the organ, gathered by the loads: energy z' H z / 2 - g z + springs' energy."""

    organ: Reduced
    up: Float64[np.ndarray, " 3"]
    modulus: float  # of the tissue, N/mm2
    stiffness: Float64[np.ndarray, "m m"]  # H
    forces: Float64[np.ndarray, " m"]  # g
    one_sided: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)

    def touch(self, rows: np.ndarray, depth_mm: np.ndarray, springs: np.ndarray) -> None:
        """Springs (N/mm) that push where ``depth_mm + rows @ z`` is above zero."""
        near = springs > 0
        self.one_sided.append((rows[near], depth_mm[near], springs[near]))

    def tie(self, rows: np.ndarray, target_mm: np.ndarray | float, springs: np.ndarray) -> None:
        """Springs (N/mm) that hold ``rows @ z`` at a target, both ways."""
        add_springs(self.stiffness, self.forces, rows, springs * target_mm, springs)


def settle(problem: Problem) -> Float64[np.ndarray, " m"] | None:
    """The unknowns at rest; None where the contacts do not come to rest."""
    if not problem.one_sided:
        return np.linalg.solve(problem.stiffness, problem.forces)
    rows = np.concatenate([part[0] for part in problem.one_sided])
    depth = np.concatenate([part[1] for part in problem.one_sided])
    springs = np.concatenate([part[2] for part in problem.one_sided])
    z = np.zeros(len(problem.forces))
    for step in range(_MOST_STEPS):
        closed = np.where(depth + rows @ z > 0, springs, 0.0)
        matrix, right = problem.stiffness.copy(), problem.forces.copy()
        add_springs(matrix, right, rows, -closed * depth, closed)
        found = np.linalg.solve(matrix, right)
        move = found - z
        if np.abs(move).max() < _SETTLED_MM:
            return found
        z = z + (1.0 if step < 6 else 0.6) * move  # contacts that open and close in turns
    return None


# Own loops, since springs are mostly zero, and since BLAS would ask all threads to such small
# products, which on a busy machine takes many times longer than the product.
@numba.njit(cache=True, nogil=True)
def add_springs(matrix, right, rows, loads, springs):  # type: ignore[no-untyped-def]
    """matrix += rows' diag(springs) rows and right += rows' loads, in place."""
    m = rows.shape[1]
    for p in range(len(rows)):
        if springs[p] == 0.0:
            continue
        for a in range(m):
            force = springs[p] * rows[p, a]
            right[a] += rows[p, a] * loads[p]
            for b in range(m):
                matrix[a, b] += force * rows[p, b]
