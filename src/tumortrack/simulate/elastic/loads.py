"""What is done to an organ on the table: one function a load, and the state that several lead to.

A function draws a load for an organ in its bed; the load adds itself to the problem (``add``). A
new one is a new function and a line in ``LOADS``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import perpendicular, unit
from tumortrack.simulate.elastic.equilibrium import KPA, ReducedModel, ReducedProblem

_OBSTACLE = 100 * KPA  # N/mm3, of plates and instruments
_GRIP = 50 * KPA  # N/mm3, of what holds a place
_WEIGHT = 1.05e-6 * 9.81  # N/mm3
_EDGE_MM = 4.0  # over which an obstacle's edge fades
_DEEPEST = 0.28  # of the organ's thickness, that a plate goes
_FARTHEST_MM = 16.0  # that a place of the surface moves
_SWELLING = 0.025  # largest change of volume: leaves room below 3 % for what modes do to it


class Load(Protocol):
    def add(self, problem: ReducedProblem) -> None: ...


Draw = Callable[[ReducedModel, np.ndarray, np.random.Generator], Load]  # organ, up, rng


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Something hard that comes from ``outward`` and stops at ``height_mm`` along it, felt by a
    fraction ``foot`` of each patch."""

    outward: Float64[np.ndarray, " 3"]
    height_mm: float
    foot: Float64[np.ndarray, " p"]

    def add(self, problem: ReducedProblem) -> None:
        patches = problem.organ.patches
        depth = patches.points_mm @ self.outward - self.height_mm
        springs = _OBSTACLE * patches.areas_mm2 * self.foot
        problem.touch(problem.organ.along(self.outward), depth, springs)


@dataclass(frozen=True, eq=False)
class Grip:
    """A region held at a place some way off."""

    hold: Float64[np.ndarray, " p"]  # springs per patch, N/mm
    shift_mm: Float64[np.ndarray, " 3"]

    @classmethod
    def around(
        cls, organ: ReducedModel, patch: int, radius_mm: float, shift_mm: np.ndarray
    ) -> Grip:
        square = ((organ.patches.points_mm - organ.patches.points_mm[patch]) ** 2).sum(1)
        hold = _GRIP * organ.patches.areas_mm2 * np.exp(-0.5 * square / radius_mm**2)
        return cls(hold, shift_mm)

    def add(self, problem: ReducedProblem) -> None:
        for axis, shift in zip(np.eye(3), self.shift_mm, strict=True):
            problem.tie(problem.organ.along(axis), shift, self.hold)


@dataclass(frozen=True, eq=False)
class Sag:
    """Weight that the tissue bore in the CT and no longer does: softened, or cut open and with
    its turgor lost."""

    down: Float64[np.ndarray, " 3"]
    fraction: float  # of the weight

    def add(self, problem: ReducedProblem) -> None:
        problem.forces += self.fraction * _WEIGHT * (self.down @ problem.organ.volume_moves)


@dataclass(frozen=True, eq=False)
class Swell:
    """The organ takes up or loses fluid."""

    strain: float  # of the volume, if nothing hinders it

    def add(self, problem: ReducedProblem) -> None:
        problem.forces += problem.modulus * self.strain * problem.organ.swelling


def plate(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Obstacle:
    """A plate or strip pressed down on the organ, a little tilted."""
    return _strip(organ, _turned(up, 0.15, rng), rng)


def side(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Obstacle:
    """A retractor or plate that presses from the side."""
    outward = rng.normal(size=3)
    outward -= up * (outward @ up) * rng.uniform(0.5, 1)
    return _strip(organ, unit(outward), rng)


def poke(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Obstacle:
    """A blunt instrument pressed into the surface that does not face down."""
    tip = _reachable(organ, up, rng)
    outward = unit(organ.patches.normals[tip] + rng.normal(0, 0.25, 3))
    return indenter(organ, tip, outward, rng.uniform(3, 10), rng.uniform(1, 14))


def indenter(
    organ: ReducedModel,
    patch: int,
    outward: Float64[np.ndarray, " 3"],
    radius_mm: float,
    depth_mm: float,
) -> Obstacle:
    """An instrument of a radius, pressed to a depth at a patch, against a unit vector."""
    points, normals = organ.patches.points_mm, organ.patches.normals
    offset = points - points[patch]
    aside = np.linalg.norm(offset - np.outer(offset @ outward, outward), axis=1)
    foot = _faded(radius_mm - aside) * (normals @ outward > 0)
    return Obstacle(outward, float(points[patch] @ outward - depth_mm), foot)


def pull(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Grip:
    """Forceps pull at the surface."""
    place, radius_mm = _reachable(organ, up, rng), rng.uniform(4, 9)
    along = unit(organ.patches.normals[place] + rng.normal(0, 0.6, 3))
    return Grip.around(organ, place, radius_mm, along * rng.uniform(1, 12))


def lift(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Grip:
    """A pole is raised or moved aside, mostly upwards."""
    outward = rng.normal(size=3)
    outward -= 0.7 * up * (outward @ up)
    place, radius_mm = int(np.argmax(organ.patches.points_mm @ outward)), rng.uniform(8, 20)
    shift_mm = unit(rng.normal(size=3) + 0.7 * up) * rng.uniform(1, 12)
    return Grip.around(organ, place, radius_mm, shift_mm)


def sag(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Sag:
    """Tissue softened or cut open."""
    return Sag(_turned(-up, 0.15, rng), float(rng.uniform(0.2, 1)))


def swell(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Swell:
    """Fluid taken up or lost."""
    return Swell(float(rng.uniform(-_SWELLING, _SWELLING)))


# Each with its probability.
LOADS: tuple[tuple[Draw, float], ...] = (
    (plate, 0.32),
    (side, 0.11),
    (poke, 0.16),
    (pull, 0.12),
    (lift, 0.10),
    (sag, 0.14),
    (swell, 0.05),
)


def in_bed(
    organ: ReducedModel, up: Float64[np.ndarray, " 3"], rng: np.random.Generator
) -> ReducedProblem:
    """An organ of random tissue (3-30 kPa, tumors 0.8-8 times that) in a random bed: springs of
    0.5-20 kPa/mm on the underside, in some states only against sinking, in others both ways."""
    modulus = KPA * _log_uniform(3, 30, rng)
    stiffness = organ.stiffness(modulus, _log_uniform(0.8, 8, rng))
    problem = ReducedProblem(organ, up, modulus, stiffness, np.zeros(len(stiffness)))
    patches = organ.patches
    below = np.clip(-(patches.normals @ up), 0, 1) * patches.areas_mm2
    springs = below * KPA * _log_uniform(0.5, 20, rng)
    down = organ.along(-up)
    if rng.uniform() < 0.6:
        problem.touch(down, np.zeros(len(down)), springs)
        problem.tie(down, 0.0, 1e-3 * springs)  # keeps it over the bed
    else:
        problem.tie(down, 0.0, springs)
    grip = rng.uniform(0, 0.3)
    one = perpendicular(up)
    for aside in (one, np.cross(up, one)):
        problem.tie(organ.along(aside), 0.0, grip * springs)
    return problem


def random_state(
    organ: ReducedModel, up: Float64[np.ndarray, " 3"], anywhere: float, rng: np.random.Generator
) -> Float64[np.ndarray, " k"] | None:
    """Coefficients of the modes after one or two random loads; None for states that find no
    equilibrium or move a place by more than 24 mm. Motions of 16 to 24 mm are scaled to 16.

    Args:
        anywhere: fraction of states with the bed on any side, instead of opposite to ``up``.
    """
    if rng.uniform() < anywhere:
        up = unit(rng.normal(size=3))
    problem = in_bed(organ, _turned(up, 0.12, rng), rng)
    shares = np.array([share for _, share in LOADS])
    for n in rng.choice(len(LOADS), 1 + (rng.uniform() < 0.35), p=shares / shares.sum()):
        LOADS[n][0](organ, problem.up, rng).add(problem)
    found = problem.equilibrium()
    if found is None:
        return None
    state = found[: organ.n_modes]
    farthest = np.linalg.norm(organ.moves[:, :, : organ.n_modes] @ state, axis=1).max()
    if farthest > 1.5 * _FARTHEST_MM:
        return None
    return state * min(1.0, _FARTHEST_MM / farthest)


def _strip(organ: ReducedModel, outward: np.ndarray, rng: np.random.Generator) -> Obstacle:
    """A strip 10-70 mm wide across a random line, pressed in by up to ``_DEEPEST``."""
    points = organ.patches.points_mm
    across = points @ unit(np.cross(outward, rng.normal(size=3)))
    low, high = np.percentile(across, [15, 85])
    middle, width = rng.uniform(low, high), rng.uniform(10, 70)
    foot = _faded(width / 2 - np.abs(across - middle)) * (organ.patches.normals @ outward > 0)
    height = points @ outward
    depth = rng.uniform(0.02, _DEEPEST) * np.ptp(height)
    touched = height[foot > 0] if (foot > 0).any() else height
    return Obstacle(outward, float(touched.max() - depth), foot)


def _faded(inward_mm: np.ndarray) -> np.ndarray:
    """1 well within an edge, 0 beyond it."""
    return np.clip(inward_mm / _EDGE_MM + 0.5, 0, 1)


def _reachable(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(organ.patches.normals @ up > -0.2)))


def _turned(direction: np.ndarray, std_rad: float, rng: np.random.Generator) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0, std_rad, 3)).apply(direction)


def _log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
