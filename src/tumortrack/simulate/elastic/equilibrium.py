"""How an organ in its bed takes loads: equilibrium with one-sided contacts in the space of modes.

Unknowns are the modes' coefficients and six rigid ones. The bed is a layer of springs on the
underside, obstacles are stiff springs that only push. Each Newton step solves for the contacts
that the last one left closed. Lengths in mm, stress in N/mm2 (1 kPa = 1e-3).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numba
import numpy as np
from jaxtyping import Float64

from tumortrack.simulate.elastic.finite import LatticeSolid
from tumortrack.simulate.elastic.modes import Patches

KPA = 1e-3  # N/mm2
LEVER_MM = 50.0  # a rotation's unknown is the motion at this lever arm
_FREE = 1e-4  # N/mm: keeps the rigid motions solvable where nothing touches
_MOST_STEPS = 20
_CONVERGED_MM = 1e-2


class ReducedModel:
    """A solid in the space of its modes and six rigid motions (k + 6 unknowns)."""

    def __init__(
        self, solid: LatticeSolid, modes: Float64[np.ndarray, "f k"], patches: Patches
    ) -> None:
        k, n = modes.shape[1], len(solid.nodes)
        self.solid, self.modes, self.patches = solid, modes, patches
        self.n_modes = k
        weights = solid.weights(patches.points_mm)
        bent = (weights @ modes.reshape(n, -1)).reshape(-1, 3, k)
        arms = (patches.points_mm - solid.center_mm) / LEVER_MM
        turned = np.stack([np.cross(axis, arms) for axis in np.eye(3)], -1)
        shifted = np.broadcast_to(np.eye(3), turned.shape)
        self.moves = np.concatenate([bent, shifted, turned], -1)  # (p, 3, k + 6)
        volume = solid.volume_mm3
        mean = np.tensordot(volume, modes.reshape(n, 3, k), 1)
        rigid = np.concatenate([np.eye(3) * volume.sum(), np.zeros((3, 3))], 1)
        self.volume_moves = np.concatenate([mean, rigid], 1)  # (3, k + 6), mm3
        self.swelling = np.append(modes.T @ solid.swelling, np.zeros(6))
        self._tissue = modes.T @ (solid.stiffness(solid.organ) @ modes)
        self._tumors = modes.T @ (solid.stiffness(solid.tumor) @ modes)

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


class Contacts(NamedTuple):
    """Springs that push where ``depth_mm + rows @ z`` is above zero."""

    rows: Float64[np.ndarray, "p m"]
    depth_mm: Float64[np.ndarray, " p"]
    springs: Float64[np.ndarray, " p"]  # N/mm


@dataclass(eq=False)
class ReducedProblem:
    """What acts on the organ, gathered by the loads: energy z' H z / 2 - g z + springs' energy."""

    organ: ReducedModel
    up: Float64[np.ndarray, " 3"]
    modulus: float  # of the tissue, N/mm2
    stiffness: Float64[np.ndarray, "m m"]  # H
    forces: Float64[np.ndarray, " m"]  # g
    contacts: list[Contacts] = field(default_factory=list)

    def touch(self, rows: np.ndarray, depth_mm: np.ndarray, springs: np.ndarray) -> None:
        """Add ``Contacts`` with springs in N/mm."""
        near = springs > 0
        self.contacts.append(Contacts(rows[near], depth_mm[near], springs[near]))

    def tie(self, rows: np.ndarray, target_mm: np.ndarray | float, springs: np.ndarray) -> None:
        """Springs (N/mm) that hold ``rows @ z`` at a target, both ways."""
        _add_springs(self.stiffness, self.forces, rows, springs * target_mm, springs)

    def equilibrium(self) -> Float64[np.ndarray, " m"] | None:
        """The unknowns at rest; None where the contacts do not converge."""
        none = Contacts(np.zeros((0, len(self.forces))), np.zeros(0), np.zeros(0))
        contacts = Contacts(*map(np.concatenate, zip(none, *self.contacts, strict=True)))
        z, converged = _equilibrium(self.stiffness, self.forces, contacts)
        return z if converged else None


# Own loops for small matrices: BLAS would wake every thread for each product, which on a busy
# machine takes many times longer than the product; and most springs are open.
@numba.njit(cache=True, nogil=True)
def _equilibrium(stiffness, forces, contacts):  # type: ignore[no-untyped-def]
    rows, depth, springs = contacts.rows, contacts.depth_mm, contacts.springs
    z = np.zeros(len(forces))
    for step in range(_MOST_STEPS):
        closed, loads = np.zeros(len(rows)), np.zeros(len(rows))
        for p in range(len(rows)):
            sunk = depth[p]
            for a in range(len(z)):
                sunk += rows[p, a] * z[a]
            if sunk > 0:
                closed[p] = springs[p]
                loads[p] = -springs[p] * depth[p]
        matrix, found = stiffness.copy(), forces.copy()
        _add_springs(matrix, found, rows, loads, closed)
        _solve(matrix, found)
        farthest = 0.0
        for a in range(len(z)):
            move = found[a] - z[a]
            farthest = max(farthest, abs(move))
            z[a] += move if step < 6 else 0.6 * move  # contacts that open and close in turns
        if farthest < _CONVERGED_MM:
            return found, True
    return z, False


@numba.njit(cache=True, nogil=True)
def _add_springs(matrix, right, rows, loads, springs):  # type: ignore[no-untyped-def]
    """matrix += rows' diag(springs) rows and right += rows' loads, in place."""
    for p in range(len(rows)):
        if springs[p] == 0.0:
            continue
        for a in range(len(right)):
            force = springs[p] * rows[p, a]
            right[a] += rows[p, a] * loads[p]
            for b in range(len(right)):
                matrix[a, b] += force * rows[p, b]


@numba.njit(cache=True, nogil=True)
def _solve(matrix, right):  # type: ignore[no-untyped-def]
    """right = inverse(matrix) right, by Cholesky; both are overwritten."""
    n = len(right)
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
        total = right[i]
        for k in range(i):
            total -= matrix[i, k] * right[k]
        right[i] = total / matrix[i, i]
    for i in range(n - 1, -1, -1):
        right[i] /= matrix[i, i]
        for k in range(i):
            right[k] -= matrix[i, k] * right[i]
