"""What is done to an organ on the table: one class a load, and the state that several lead to.

A load is drawn (``draw``) for an organ in its bed and adds itself to the problem (``add``). A new
one is a new class and a line in ``LOADS``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.simulate.elastic.settle import KPA, ReducedModel, ReducedProblem, settle

_OBSTACLE = 100 * KPA  # N/mm3, of plates and instruments
_GRIP = 50 * KPA  # N/mm3, of what holds a place
_WEIGHT = 1.05e-6 * 9.81  # N/mm3
_EDGE_MM = 4.0  # over which an obstacle's edge fades
DEEPEST = 0.28  # of the organ's thickness, that a plate goes
FARTHEST_MM = 16.0  # that a place of the surface moves
SWELLING = 0.025  # largest change of volume: leaves room below 3 % for what modes do to it


@runtime_checkable
class Load(Protocol):
    @classmethod
    def draw(
        cls, organ: ReducedModel, up: Float64[np.ndarray, " 3"], rng: np.random.Generator
    ) -> Load: ...

    def add(self, problem: ReducedProblem) -> None: ...


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Something hard that comes from ``outward`` and stops at ``height_mm`` along it, felt by a
    share ``foot`` of each patch."""

    outward: Float64[np.ndarray, " 3"]
    height_mm: float
    foot: Float64[np.ndarray, " p"]

    def add(self, problem: ReducedProblem) -> None:
        patches = problem.organ.patches
        depth = patches.points_mm @ self.outward - self.height_mm
        springs = _OBSTACLE * patches.areas_mm2 * self.foot
        problem.touch(problem.organ.along(self.outward), depth, springs)


class Plate(Obstacle):
    """A plate or strip pressed down on the organ, a little tilted."""

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Plate:
        return cls(*_strip(organ, _tilted(up, 0.15, rng), rng))


class Side(Obstacle):
    """A retractor or plate that presses from the side."""

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Side:
        outward = rng.normal(size=3)
        outward -= up * (outward @ up) * rng.uniform(0.5, 1)
        return cls(*_strip(organ, _unit(outward), rng))


class Poke(Obstacle):
    """A blunt instrument pressed into the surface that does not look down."""

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Poke:
        tip = _reachable(organ, up, rng)
        outward = _tilted_by(organ.patches.normals[tip], 0.25, rng)
        return cls.at(organ, tip, outward, rng.uniform(3, 10), rng.uniform(1, 14))

    @classmethod
    def at(
        cls,
        organ: ReducedModel,
        patch: int,
        outward: Float64[np.ndarray, " 3"],
        radius_mm: float,
        depth_mm: float,
    ) -> Poke:
        """An instrument so wide that goes in so deep at a patch, against a unit vector."""
        points, normals = organ.patches.points_mm, organ.patches.normals
        offset = points - points[patch]
        aside = np.linalg.norm(offset - np.outer(offset @ outward, outward), axis=1)
        foot = _faded(radius_mm - aside) * (normals @ outward > 0)
        return cls(outward, float(points[patch] @ outward - depth_mm), foot)


@dataclass(frozen=True, eq=False)
class Grip:
    """A region held at a place some way off."""

    hold: Float64[np.ndarray, " p"]  # springs per patch, N/mm
    shift_mm: Float64[np.ndarray, " 3"]

    def add(self, problem: ReducedProblem) -> None:
        for axis, shift in zip(np.eye(3), self.shift_mm, strict=True):
            problem.tie(problem.organ.along(axis), shift, self.hold)


class Pull(Grip):
    """Forceps draw at the surface."""

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Pull:
        place = _reachable(organ, up, rng)
        hold = _region(organ, place, rng.uniform(4, 9))
        along = _tilted_by(organ.patches.normals[place], 0.6, rng)
        return cls(hold, along * rng.uniform(1, 12))


class Lift(Grip):
    """A pole is raised or led aside, mostly upwards."""

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Lift:
        outward = rng.normal(size=3)
        outward -= 0.7 * up * (outward @ up)
        place = int(np.argmax(organ.patches.points_mm @ outward))
        hold = _region(organ, place, rng.uniform(8, 20))
        return cls(hold, _unit(rng.normal(size=3) + 0.7 * up) * rng.uniform(1, 12))


@dataclass(frozen=True, eq=False)
class Sag:
    """Weight that the tissue bore in the CT and no longer does: softened, or cut open and with
    its turgor lost."""

    down: Float64[np.ndarray, " 3"]
    share: float  # of the weight

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Sag:
        return cls(_tilted(-up, 0.15, rng), float(rng.uniform(0.2, 1)))

    def add(self, problem: ReducedProblem) -> None:
        problem.forces += self.share * _WEIGHT * (self.down @ problem.organ.volume_moves)


@dataclass(frozen=True, eq=False)
class Swell:
    """The organ takes up or loses fluid."""

    strain: float  # of the volume, if nothing hinders it

    @classmethod
    def draw(cls, organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> Swell:
        return cls(float(rng.uniform(-SWELLING, SWELLING)))

    def add(self, problem: ReducedProblem) -> None:
        problem.forces += problem.modulus * self.strain * problem.organ.swelling


LOADS: tuple[tuple[type[Load], float], ...] = (
    (Plate, 0.32),
    (Side, 0.11),
    (Poke, 0.16),
    (Pull, 0.12),
    (Lift, 0.10),
    (Sag, 0.14),
    (Swell, 0.05),
)


def bedded(
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
    one = _unit(np.cross(up, np.eye(3)[np.argmin(np.abs(up))]))
    for aside in (one, np.cross(up, one)):
        problem.tie(organ.along(aside), 0.0, grip * springs)
    return problem


def random_state(
    organ: ReducedModel, up: Float64[np.ndarray, " 3"], anywhere: float, rng: np.random.Generator
) -> Float64[np.ndarray, " k"] | None:
    """Coefficients of the modes after one or two random loads; None for states that do not come
    to rest or move a place by more than 24 mm. What moves by 16 to 24 mm is scaled to 16.

    Args:
        anywhere: share of states with the bed on any side, instead of opposite to ``up``.
    """
    if rng.uniform() < anywhere:
        up = _unit(rng.normal(size=3))
    problem = bedded(organ, _tilted(up, 0.12, rng), rng)
    shares = np.array([share for _, share in LOADS])
    for n in rng.choice(len(LOADS), 1 + (rng.uniform() < 0.35), p=shares / shares.sum()):
        LOADS[n][0].draw(organ, problem.up, rng).add(problem)
    found = settle(problem)
    if found is None:
        return None
    state = found[: organ.n_modes]
    farthest = np.linalg.norm(organ.moves[:, :, : organ.n_modes] @ state, axis=1).max()
    if farthest > 1.5 * FARTHEST_MM:
        return None
    return state * min(1.0, FARTHEST_MM / farthest)


def _strip(
    organ: ReducedModel, outward: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, float, np.ndarray]:
    """A strip 10-70 mm wide across a random line, pressed in by up to ``DEEPEST``."""
    points = organ.patches.points_mm
    across = points @ _unit(np.cross(outward, rng.normal(size=3)))
    low, high = np.percentile(across, [15, 85])
    middle, width = rng.uniform(low, high), rng.uniform(10, 70)
    foot = _faded(width / 2 - np.abs(across - middle)) * (organ.patches.normals @ outward > 0)
    height = points @ outward
    depth = rng.uniform(0.02, DEEPEST) * np.ptp(height)
    touched = height[foot > 0] if (foot > 0).any() else height
    return outward, float(touched.max() - depth), foot


def _faded(inward_mm: np.ndarray) -> np.ndarray:
    """1 well within an edge, 0 beyond it."""
    return np.clip(inward_mm / _EDGE_MM + 0.5, 0, 1)


def _region(organ: ReducedModel, place: int, radius_mm: float) -> np.ndarray:
    square = ((organ.patches.points_mm - organ.patches.points_mm[place]) ** 2).sum(1)
    return _GRIP * organ.patches.areas_mm2 * np.exp(-0.5 * square / radius_mm**2)


def _reachable(organ: ReducedModel, up: np.ndarray, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(organ.patches.normals @ up > -0.2)))


def _tilted(direction: np.ndarray, std_rad: float, rng: np.random.Generator) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0, std_rad, 3)).apply(direction)


def _tilted_by(direction: np.ndarray, std: float, rng: np.random.Generator) -> np.ndarray:
    return _unit(direction + rng.normal(0, std, 3))


def _log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
