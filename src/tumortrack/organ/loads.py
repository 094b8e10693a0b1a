"""Loads on an organ in its bed: equilibrium with unilateral contacts in the space of its modes.

Unknowns are the modes' coefficients and six rigid ones. The bed is a layer of springs on the
underside, obstacles are stiff springs that only push. Each Newton step solves with the contacts
that the last one closed. Lengths in mm, stress in N/mm2 (1 kPa = 1e-3).

A random load is a function in ``LOADS`` that adds itself to the problem of an organ in its bed.
Its lengths are a kidney's, scaled with the organ's length (``ReducedModel.scale``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import perpendicular, unit
from tumortrack.core.process import parallel_map
from tumortrack.native import F64, kernel
from tumortrack.organ.modes import ReducedModel

KPA = 1e-3  # N/mm2
TISSUE_KPA = (3.0, 30.0)  # Young's modulus of a random organ's tissue
DENSITY = 1.05e-6  # kg/mm3
Vector = Float64[np.ndarray, " 3"]
_OBSTACLE = 100 * KPA  # N/mm3, of plates and instruments
_GRIP = 50 * KPA  # N/mm3, of a held region
_WEIGHT = DENSITY * 9.81  # N/mm3
_EDGE_MM = 4.0  # width over which an obstacle's edge fades
_DEEPEST = 0.28  # largest depth of a plate, over the organ's thickness
_FARTHEST_MM = 16.0  # largest motion of a place on a kidney's surface
_TOGETHER = 32  # problems solved in one batch, of about 2 MB each
_SWELLING = 0.025  # largest strain of the volume, which modes change further, to 3 % at most


@dataclass(eq=False)
class ReducedProblem:
    """What acts on the organ: energy z' H z / 2 - g z + the springs' energy. Loads add to it."""

    organ: ReducedModel
    up: Vector
    modulus: float  # of the tissue, N/mm2
    stiffness: Float64[np.ndarray, "m m"]  # H
    forces: Float64[np.ndarray, " m"]  # g
    # (rows, depth_mm, springs): they push where depth_mm + rows @ z is above zero
    contacts: list[tuple[np.ndarray, ...]] = field(default_factory=list)
    # Additions to H and g, made by the thread that solves the problem.
    additions: list[Callable[[], object]] = field(default_factory=list)

    def touch(self, rows: np.ndarray, depth_mm: np.ndarray, springs: np.ndarray) -> None:
        """Add contacts with springs in N/mm."""
        active = springs > 0
        self.contacts.append((rows[active], depth_mm[active], springs[active]))

    def tie(self, along: Vector, target_mm: float, springs: Float64[np.ndarray, " p"]) -> None:
        """Add springs (N/mm) that hold the patches at a target along a direction, both ways."""

        def add() -> None:
            rows = np.ascontiguousarray(self.organ.along(along))
            _add_springs(self.stiffness, self.forces, rows, springs * target_mm, springs)

        self.additions.append(add)

    def press(self, outward: Vector, height_mm: float, foot: Float64[np.ndarray, " p"]) -> None:
        """A rigid obstacle comes from the direction ``outward`` (unit vector) and stops at
        ``height_mm`` along it; it touches a fraction ``foot`` of each patch."""
        patches = self.organ.patches
        depth = patches.points_mm @ outward - height_mm
        self.touch(self.organ.along(outward), depth, _OBSTACLE * patches.areas_mm2 * foot)

    def indent(self, patch: int, outward: Vector, radius_mm: float, depth_mm: float) -> None:
        """An instrument is pressed in at a patch, against the unit vector ``outward``."""
        points, normals = self.organ.patches.points_mm, self.organ.patches.normals
        offset = points - points[patch]
        aside = np.linalg.norm(offset - np.outer(offset @ outward, outward), axis=1)
        foot = _faded(radius_mm - aside) * (normals @ outward > 0)
        self.press(outward, float(points[patch] @ outward - depth_mm), foot)

    def hold(self, patch: int, radius_mm: float, shift_mm: Vector) -> None:
        """A region around a patch is held at a displacement."""
        patches = self.organ.patches
        springs = _GRIP * patches.areas_mm2 * patches.spot(patches.points_mm[patch], radius_mm)
        for axis, shift in zip(np.eye(3), shift_mm, strict=True):
            self.tie(axis, float(shift), springs)

    def weigh(self, down: Vector, fraction: float) -> None:
        """The tissue no longer supports a fraction of the weight that it did in the CT."""
        self._add_forces(fraction * _WEIGHT * (down @ self.organ.volume_moves))

    def expand(self, strain: float) -> None:
        """The organ takes up or loses fluid: a strain of its volume, if nothing resists."""
        self._add_forces(self.modulus * strain * self.organ.swelling)

    def _add_forces(self, forces: Float64[np.ndarray, " m"]) -> None:
        self.additions.append(lambda: np.add(self.forces, forces, out=self.forces))

    def equilibrium(self) -> Float64[np.ndarray, " m"] | None:
        """The unknowns at rest; None if the contacts do not converge."""
        while self.additions:
            self.additions.pop(0)()
        none = np.zeros((0, len(self.forces))), np.zeros(0), np.zeros(0)
        contacts = map(np.concatenate, zip(none, *self.contacts, strict=True))
        z, converged = _equilibrium(self.stiffness, self.forces, *contacts)
        return z if converged else None


# The room that they work in comes from here; see native/exact/loads.c.
_MATRIX, _SPRINGS = F64["m", "m"], (F64["p", "m"], F64["p"], F64["p"])
# In place: matrix += rows' diag(springs) rows, its lower triangle; right += rows' loads.
_add_springs = kernel("add_springs", _MATRIX.out, F64["m"].out, *_SPRINGS)
_solve_contacts = kernel(
    "equilibrium", _MATRIX, F64["m"], *_SPRINGS, _MATRIX.out, *[F64["p"].out] * 2,
    *[F64["m"].out] * 2, result=int,
)  # fmt: skip


def _equilibrium(
    stiffness: np.ndarray,
    forces: np.ndarray,
    rows: np.ndarray,
    depth_mm: np.ndarray,
    springs: np.ndarray,
) -> tuple[np.ndarray, bool]:
    """The unknowns, and whether the contacts came to rest."""
    n, p = len(forces), len(rows)
    work = np.empty((n, n)), np.empty(p), np.empty(p)
    z, solution = np.empty(n), np.empty(n)
    contacts = np.ascontiguousarray(rows), depth_mm, springs
    converged = _solve_contacts(stiffness, forces, *contacts, *work, z, solution)
    return (solution, True) if converged else (z, False)


def plate(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """A plate or strip pressed down on the organ, slightly tilted."""
    _press_strip(problem, _turned(problem.up, 0.15, rng), rng)


def side(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """A retractor or plate pressing from the side."""
    outward = rng.normal(size=3)
    outward -= problem.up * (outward @ problem.up) * rng.uniform(0.5, 1)
    _press_strip(problem, unit(outward), rng)


def poke(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """A blunt instrument pressed into a part of the surface that does not face down."""
    tip = _reachable(problem, rng)
    outward = unit(problem.organ.patches.normals[tip] + rng.normal(0, 0.25, 3))
    scale = problem.organ.scale
    problem.indent(tip, outward, scale * rng.uniform(3, 10), scale * rng.uniform(1, 14))


def pull(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """Forceps pulling at the surface."""
    scale, patch, radius_mm = problem.organ.scale, _reachable(problem, rng), rng.uniform(4, 9)
    along = unit(problem.organ.patches.normals[patch] + rng.normal(0, 0.6, 3))
    problem.hold(patch, scale * radius_mm, along * (scale * rng.uniform(1, 12)))


def lift(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """A pole raised or moved aside, mostly upwards."""
    outward, up = rng.normal(size=3), problem.up
    outward -= 0.7 * up * (outward @ up)
    patch, radius_mm = int(np.argmax(problem.organ.patches.points_mm @ outward)), rng.uniform(8, 20)
    scale, along = problem.organ.scale, unit(rng.normal(size=3) + 0.7 * up)
    problem.hold(patch, scale * radius_mm, along * (scale * rng.uniform(1, 12)))


def sag(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """Tissue softened, or cut open and so without turgor."""
    problem.weigh(_turned(-problem.up, 0.15, rng), float(rng.uniform(0.2, 1)))


def swell(problem: ReducedProblem, rng: np.random.Generator) -> None:
    """Fluid taken up or lost."""
    problem.expand(float(rng.uniform(-_SWELLING, _SWELLING)))


# Loads with their probabilities.
LOADS: tuple[tuple[Callable[[ReducedProblem, np.random.Generator], None], float], ...] = (
    (plate, 0.32),
    (side, 0.11),
    (poke, 0.16),
    (pull, 0.12),
    (lift, 0.10),
    (sag, 0.14),
    (swell, 0.05),
)


def in_bed(organ: ReducedModel, up: Vector, rng: np.random.Generator) -> ReducedProblem:
    """An organ of random tissue (3-30 kPa, tumors 0.8-8 times that) in a random bed: springs of
    0.5-20 kPa/mm on the underside, in some states against sinking only, in others both ways."""
    modulus = KPA * _log_uniform(*TISSUE_KPA, rng)
    stiffness = organ.stiffness(modulus, _log_uniform(0.8, 8, rng))
    problem = ReducedProblem(organ, up, modulus, stiffness, np.zeros(len(stiffness)))
    patches = organ.patches
    below = np.clip(-(patches.normals @ up), 0, 1) * patches.areas_mm2
    springs = below * KPA * _log_uniform(0.5, 20, rng)
    if rng.uniform() < 0.6:
        problem.touch(organ.along(-up), np.zeros(len(springs)), springs)
        problem.tie(-up, 0.0, 1e-3 * springs)  # keeps it over the bed
    else:
        problem.tie(-up, 0.0, springs)
    grip, x_axis = rng.uniform(0, 0.3), perpendicular(up)
    for aside in (x_axis, np.cross(up, x_axis)):
        problem.tie(aside, 0.0, grip * springs)
    return problem


def random_states(
    organ: ReducedModel, up: Vector, anywhere: float, rng: np.random.Generator, count: int
) -> list[Float64[np.ndarray, " k"]]:
    """The first ``count`` states (``state_of``) of at most twice as many problems; fewer if too few
    come to rest. Problems are drawn in sequence and solved on two threads."""
    states: list[Float64[np.ndarray, " k"]] = []
    for first in range(0, 2 * count, _TOGETHER):
        batch = range(first, min(first + _TOGETHER, 2 * count))
        problems = [random_problem(organ, up, anywhere, rng) for _ in batch]
        states += [state for state in parallel_map(state_of, problems) if state is not None]
        if len(states) >= count:
            break
    return states[:count]


def random_problem(
    organ: ReducedModel, up: Vector, anywhere: float, rng: np.random.Generator
) -> ReducedProblem:
    """An organ in a random bed under one or two random loads. ``anywhere``: fraction of problems
    with the bed on any side, instead of opposite to ``up``."""
    if rng.uniform() < anywhere:
        up = unit(rng.normal(size=3))
    problem = in_bed(organ, _turned(up, 0.12, rng), rng)
    shares = np.array([share for _, share in LOADS])
    for n in rng.choice(len(LOADS), 1 + (rng.uniform() < 0.35), p=shares / shares.sum()):
        LOADS[n][0](problem, rng)
    return problem


def state_of(problem: ReducedProblem) -> Float64[np.ndarray, " k"] | None:
    """Coefficients of the modes at rest; None without an equilibrium, or if a place moves by more
    than 24 mm (on a kidney). Motions of 16 to 24 mm are scaled to 16."""
    unknowns, organ = problem.equilibrium(), problem.organ
    if unknowns is None:
        return None
    state = unknowns[: organ.n_modes]
    farthest = np.linalg.norm(organ.moves[:, :, : organ.n_modes] @ state, axis=1).max()
    most = _FARTHEST_MM * organ.scale
    return None if farthest > 1.5 * most else state * min(1.0, most / farthest)


def _press_strip(problem: ReducedProblem, outward: np.ndarray, rng: np.random.Generator) -> None:
    """A strip in a random direction, on a kidney 10-70 mm wide, pressed in up to ``_DEEPEST``."""
    patches = problem.organ.patches
    across = patches.points_mm @ unit(np.cross(outward, rng.normal(size=3)))
    low, high = np.percentile(across, [15, 85])
    middle, width = rng.uniform(low, high), problem.organ.scale * rng.uniform(10, 70)
    foot = _faded(width / 2 - np.abs(across - middle)) * (patches.normals @ outward > 0)
    height = patches.points_mm @ outward
    depth = rng.uniform(0.02, _DEEPEST) * np.ptp(height)
    touched = height[foot > 0] if (foot > 0).any() else height
    problem.press(outward, float(touched.max() - depth), foot)


def _faded(inward_mm: np.ndarray) -> np.ndarray:
    """1 well inside an edge, 0 outside."""
    return np.clip(inward_mm / _EDGE_MM + 0.5, 0, 1)


def _reachable(problem: ReducedProblem, rng: np.random.Generator) -> int:
    """A patch that does not face down."""
    return int(rng.choice(np.flatnonzero(problem.organ.patches.normals @ problem.up > -0.2)))


def _turned(direction: np.ndarray, std_rad: float, rng: np.random.Generator) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0, std_rad, 3)).apply(direction)


def _log_uniform(low: float, high: float, rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
