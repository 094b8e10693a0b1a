"""The equilibrium of a loaded solid: the minimum of its energy among rigid obstacles.

Quasi-Newton (L-BFGS) on top of the factorised rest stiffness (Liu, Bouaziz and Kavan 2017, doi
10.1145/2990496), with the contact stiffness of the start: a few dozen iterations a load step. The
forces are those of ``forces``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.sparse import csr_matrix, eye
from scipy.sparse.linalg import splu

from tumortrack.core.errors import TumortrackError

TOLERANCE = 1e-3  # largest unbalanced force (2-norm over nodes), share of the load
_LEAST_LOAD_MN = 1.0  # a tenth of a gram: less is no load
_ITERATIONS = 1500
_REFRESH_AFTER = 60  # iterations, after which the contact points have changed
_MEMORY = 10
_LONGEST_MM, _SHORTEST_MM = 2.0, 1e-9  # step of any node

Points = Float64[np.ndarray, "n 3"]
Nodes = Float64[np.ndarray, "n 3"]
Distances = Float64[np.ndarray, " n"]
Pairs = deque[tuple[np.ndarray, np.ndarray]]  # steps, and what the gradient changed by
Solve = Callable[[np.ndarray], np.ndarray]


# Rigid bodies in the bench's frame, mm. Each gives its ``distance`` (negative inside) and that
# one's gradient: outwards, of length 1 where it is true.
@dataclass(frozen=True, eq=False)
class Support:
    """Everything below z = height: a plane, or packing (one height a point)."""

    height_mm: float | Distances = 0.0

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        return points_mm[:, 2] - self.height_mm, np.tile([0.0, 0.0, 1.0], (len(points_mm), 1))


@dataclass(frozen=True)
class ContactPlate:
    """A box along the axes with rounded edges; ``half_mm`` includes the rounding."""

    centre_mm: tuple[float, float, float]
    half_mm: tuple[float, float, float]
    rounding_mm: float

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        offset = points_mm - np.array(self.centre_mm)
        over = np.abs(offset) - (np.array(self.half_mm) - self.rounding_mm)
        outside = np.maximum(over, 0)
        length = np.linalg.norm(outside, axis=1)
        outwards = outside / np.maximum(length, 1e-12)[:, None]
        normal = np.where(length[:, None] > 0, outwards, np.eye(3)[over.argmax(1)])
        distance = length + np.minimum(over.max(1), 0) - self.rounding_mm
        return distance, normal * np.where(offset < 0, -1.0, 1.0)


@dataclass(frozen=True, eq=False)
class Rod:
    """A rod with a hemispherical end: the tip touches ``tip_mm``, the unit vector ``axis`` points
    away from it along the rod. For contact it is endless."""

    tip_mm: Float64[np.ndarray, " 3"]
    axis: Float64[np.ndarray, " 3"]
    radius_mm: float
    length_mm: float = 250.0

    def distance(self, points_mm: Points) -> tuple[Distances, Points]:
        offset = points_mm - (self.tip_mm + self.radius_mm * self.axis)
        offset -= np.maximum(offset @ self.axis, 0)[:, None] * self.axis
        length = np.linalg.norm(offset, axis=1)
        return length - self.radius_mm, offset / np.maximum(length, 1e-12)[:, None]


@runtime_checkable
class Equilibrium(Protocol):
    """The problem of ``find_equilibrium``: an energy (uJ) with its gradient (mN), an approximate
    Hessian (3 n, 3 n; mN/mm), and the load (mN) that unbalanced forces are measured against."""

    def energy(self, nodes_mm: Nodes) -> tuple[float, Nodes]: ...
    def stiffness(self, nodes_mm: Nodes) -> csr_matrix: ...
    def load_mn(self, nodes_mm: Nodes) -> float: ...


@dataclass(frozen=True)
class Convergence:
    iterations: int
    evaluations: int
    residual: float  # unbalanced force / load


def find_equilibrium(
    problem: Equilibrium, start_mm: Nodes, most: int = _ITERATIONS
) -> tuple[Nodes, Convergence]:
    """Nodes in equilibrium, from a start without inverted elements. Raises TumortrackError: none
    within ``most`` iterations."""
    nodes, evaluations = start_mm, 0
    energy, gradient = problem.energy(nodes)
    precondition = _factorised(problem, nodes)
    pairs: Pairs = deque(maxlen=_MEMORY)
    for iteration in range(most):
        residual = float(np.linalg.norm(gradient)) / max(problem.load_mn(nodes), _LEAST_LOAD_MN)
        if residual < TOLERANCE:
            return nodes, Convergence(iteration, evaluations, residual)
        if iteration and iteration % _REFRESH_AFTER == 0:
            precondition = _factorised(problem, nodes)
            pairs.clear()
        step = -_two_loop(gradient.ravel(), pairs, precondition).reshape(-1, 3)
        slope = float((gradient * step).sum())
        longest = float(np.abs(step).max())
        share = min(1.0, _LONGEST_MM / longest)
        while True:
            evaluations += 1
            trial = nodes + share * step
            trial_energy, trial_gradient = problem.energy(trial)
            # Near the minimum, energy differences drown in rounding: an increase of 1e-12 passes.
            if trial_energy <= energy + 1e-4 * share * slope + 1e-12 * abs(energy):
                break
            share /= 2
            if share * longest < _SHORTEST_MM:
                raise _stuck(iteration, residual)
        moved, turned = (share * step).ravel(), (trial_gradient - gradient).ravel()
        if moved @ turned > 1e-10 * np.linalg.norm(moved) * np.linalg.norm(turned):
            pairs.append((moved, turned))
        nodes, energy, gradient = trial, trial_energy, trial_gradient
    raise _stuck(most, residual)


def _two_loop(gradient: np.ndarray, pairs: Pairs, precondition: Solve) -> np.ndarray:
    """Inverse Hessian times gradient (Nocedal and Wright, Numerical Optimization, alg. 7.4)."""
    out = gradient.copy()
    amounts = []
    for moved, turned in reversed(pairs):
        amounts.append((moved @ out) / (moved @ turned))
        out -= amounts[-1] * turned
    out = precondition(out)
    for (moved, turned), amount in zip(pairs, reversed(amounts), strict=True):
        out += (amount - (turned @ out) / (moved @ turned)) * moved
    return out


def _factorised(problem: Equilibrium, nodes: Nodes) -> Solve:
    """Solves with the stiffness as it is now."""
    matrix = problem.stiffness(nodes)
    # A small diagonal stands for the hold, without which rigid motions are free of force.
    ground = 1e-3 * matrix.diagonal().mean()
    matrix = (matrix + ground * eye(matrix.shape[0])).tocsc()
    options = {"SymmetricMode": True}
    return splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve


def _stuck(iteration: int, residual: float) -> TumortrackError:
    return TumortrackError(
        f"the finite-element solver found no equilibrium: after {iteration} iterations "
        f"{residual:.1e} of the load is unbalanced (wanted: {TOLERANCE:g}). Load in smaller steps, "
        "or take a finer mesh."
    )
