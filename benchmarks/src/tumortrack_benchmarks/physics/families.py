"""Deformed states of one organ on the bench: families of loads, each state one random draw of
material, bed and load.

Beyond the twin: soft to hard beds with a rim, friction, an organ that is free to
roll, vessels, grips that twist, clamp or pull, a slit that is pulled open, tissue that is uneven
and has a capsule. Ranges are assumptions, wide on purpose, where no source stands beside them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import perpendicular, unit
from tumortrack.organ.tets import TetMesh
from tumortrack_benchmarks.physics.equilibrium import (
    ContactPlate,
    Nodes,
    Points,
    Rod,
    find_equilibrium,
)
from tumortrack_benchmarks.physics.forces import (
    Capsule,
    Force,
    LoadedBody,
    Springs,
    Steady,
    Touch,
    Turned,
    Weight,
    rows_of,
)
from tumortrack_benchmarks.physics.organ import (
    Generator,
    Organ,
    Slit,
    Stage,
    Vector,
    Wound,
    cut_open,
)
from tumortrack_benchmarks.physics.solid import NeoHookeanSolid
from tumortrack_benchmarks.physics.tets import find

_LARGEST_CHANGE, _NEARLY_NONE = 0.05, 0.02  # of volume; from Poisson's ratio 0.49 on the second
BED_DEPTH_MM = 15.0  # of fat under the organ: what turns the bed's modulus into stiffness
GRIP_MN_MM = 4000.0  # of a grip, over all its points
_STEP_MM = 6.0  # of a load, at a time
GRAVITY_MN_MM3 = 1050.0 * 9.81e-6  # of soft tissue
_ITERATIONS = 400  # a step; with more it mostly does not converge either
_CLEAR_MM = 6.0  # between a slit and every tumor: as wide as a tetrahedron


def log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


class Load(NamedTuple):
    """``at``: the forces at a share 0..1 of the load; ``reach_mm``: how far it goes; ``free``:
    nothing but bed and load holds the organ; ``rim``: of the bed, shares of the organ's height."""

    at: Callable[[float], list[Force]]
    reach_mm: float
    about: dict[str, Any]
    free: bool = False
    rim: tuple[float, float] = (0.1, 0.4)
    smooth: bool = False  # the bed has no friction


def _plate(stage: Stage, rng: Generator) -> Load:
    """A plate from any side above, up to 70 degrees oblique."""
    tilt, turn = rng.uniform(0, np.deg2rad(70)), rng.uniform(0, 2 * np.pi)
    out = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    width, deep = rng.uniform(12, 60), rng.uniform(3, 0.3 * stage.organ.size_mm[2])
    target = stage.organ.place(rng, 0.0)
    axes = _frame_along(out, rng)

    def at(share: float) -> list[Force]:
        return [stage.touch(_plate_over(stage, axes, target, width, share * deep))]

    return Load(at, deep, {"plate_tilt_degrees": np.rad2deg(tilt), "width_mm": width, "mm": deep})


def _clamp(stage: Stage, rng: Generator) -> Load:
    """Two plates from opposite sides, about level."""
    turn, width = rng.uniform(0, 2 * np.pi), rng.uniform(15, 60)
    out = unit(np.array([np.cos(turn), np.sin(turn), rng.uniform(-0.2, 0.2)]))
    thick = float(np.ptp(stage.organ.points_mm @ out))
    deep = rng.uniform(2.0, 0.14 * min(thick, 80.0), 2)
    target, axes = stage.organ.place(rng), _frame_along(out, rng)
    back = axes * [-1.0, 1.0, -1.0]

    def at(share: float) -> list[Force]:
        sides = zip((axes, back), deep, strict=True)
        plates = [_plate_over(stage, way, target, width, share * mm) for way, mm in sides]
        return [stage.touch(plate) for plate in plates]

    return Load(at, float(deep.sum()), {"width_mm": width, "mm": deep.tolist()})


def _twist(stage: Stage, rng: Generator) -> Load:
    """Both ends are held and turned about the long axis, oppositely."""
    x, angle = stage.organ.points_mm[:, 0], rng.uniform(10.0, 50.0) * rng.choice([-1, 1])
    ends = np.flatnonzero(x < np.quantile(x, 0.12)), np.flatnonzero(x > np.quantile(x, 0.88))
    middles = [stage.organ.points_mm[end].mean(0) for end in ends]

    def at(share: float) -> list[Force]:
        grips: list[Force] = []
        for end, middle, sign in zip(ends, middles, (-0.5, 0.5), strict=True):
            turn = Rotation.from_rotvec([sign * share * angle, 0, 0], degrees=True)
            arm = stage.organ.points_mm[end] - middle
            grips.append(stage.grip(end, turn.apply(arm) - arm, GRIP_MN_MM))
        return grips

    return Load(at, abs(np.deg2rad(angle)) * 20, {"degrees": angle})


def _pull(stage: Stage, rng: Generator) -> Load:
    """A tumor is pulled aside or up (a place of the surface, where the organ has none)."""
    mesh, organ = stage.solid.mesh, stage.organ
    inside = np.unique(mesh.tets[organ.in_tumor > 0.5])
    if organ.anatomy.tumors and len(inside):
        middle = organ.anatomy.tumors[rng.integers(len(organ.anatomy.tumors))].vertices_mm.mean(0)
        far = np.linalg.norm(mesh.nodes_mm[inside] - middle, axis=1)
        held = inside[far < np.sort(far)[min(24, len(far) - 1)]]
    else:
        middle = organ.place(rng, 0.3)
        held = np.argsort(np.linalg.norm(mesh.nodes_mm - middle, axis=1))[:12]
    out = unit(unit(middle - organ.middle_mm) + rng.normal(0, 0.6, 3) + [0, 0, 0.4])
    far_mm = rng.uniform(4.0, 16.0)
    rows = rows_of(held[:, None], np.ones((len(held), 1)), len(mesh.nodes_mm))

    def at(share: float) -> list[Force]:
        places = mesh.nodes_mm[held] + share * far_mm * out
        return [Springs(rows, places, np.full(len(held), GRIP_MN_MM / 2 / len(held)))]

    return Load(at, far_mm, {"mm": far_mm, "direction": out.tolist()})


def _tether(stage: Stage, rng: Generator) -> Load:
    """Vessels at the hilum hold and draw the organ, a rod pushes it; nothing else holds it."""
    organ, pull = stage.organ, rng.uniform(0.0, 12.0)
    patch = stage.patch(organ.hilum_mm, rng.uniform(10.0, 20.0))
    springs, out = log_uniform(rng, 60.0, 1500.0), unit(organ.hilum_mm - organ.middle_mm)
    out = unit(out + rng.normal(0, 0.4, 3))
    point, radius, deep = organ.place(rng, 0.2), rng.uniform(4.0, 12.0), rng.uniform(2.0, 12.0)
    axis = unit(unit(point - organ.middle_mm) + rng.normal(0, 0.3, 3))

    def at(share: float) -> list[Force]:
        rod = Rod(point - share * deep * axis, axis, radius)
        return [stage.grip(patch, share * pull * out, springs), stage.touch(rod)]

    about = {"tether_mn_mm": springs, "drawn_mm": pull, "rod_mm": deep, "rod_radius_mm": radius}
    return Load(at, max(pull, deep), about, free=True)


def _roll(stage: Stage, rng: Generator) -> Load:
    """A flank is drawn sideways over a slippery bed: the organ is free to roll about its length."""
    organ, far_mm = stage.organ, rng.uniform(5.0, 18.0)
    out = unit(np.array([rng.normal(0, 0.2), rng.choice([-1.0, 1.0]), rng.uniform(0.3, 1.0)]))
    flank = organ.points_mm[(organ.points_mm @ out).argmax()]
    patch, way = stage.patch(flank, rng.uniform(10.0, 18.0)), np.cross(out, [1.0, 0.0, 0.0])
    way = unit(way if way[2] < 0 else -way)  # over the side and down

    def at(share: float) -> list[Force]:
        return [stage.grip(patch, share * far_mm * way, 600.0)]

    return Load(at, far_mm, {"mm": far_mm}, free=True, rim=(0.25, 0.5), smooth=True)


def _cut(stage: Stage, rng: Generator) -> Load:
    """The lips of the slit are pulled apart, the farther the nearer to its middle."""
    assert stage.wound is not None
    assert stage.wound.slit is not None
    (middle, normal, radius), organ = stage.wound.slit, stage.organ
    far = np.linalg.norm(organ.points_mm - middle, axis=1) / radius
    lips = np.flatnonzero((far < 0.7) & (np.abs((organ.points_mm - middle) @ normal) < 8.0))
    side = np.where(stage.wound.side[organ.owner[lips]], 0.5, -0.5)
    open_mm = rng.uniform(5.0, 18.0)
    apart = (side * (1 - far[lips] ** 2) * open_mm)[:, None] * normal

    def at(share: float) -> list[Force]:
        return [stage.grip(lips, share * apart, GRIP_MN_MM)]

    return Load(at, open_mm, {"open_mm": open_mm, "slit_radius_mm": radius})


def _frame_along(out: Vector, rng: Generator) -> Float64[np.ndarray, "3 3"]:
    """A frame whose z is that direction, turned about it at random."""
    side = perpendicular(out)
    angle = rng.uniform(0, 2 * np.pi)
    x = np.cos(angle) * side + np.sin(angle) * np.cross(out, side)
    return np.stack([x, np.cross(out, x), out], axis=1)


def _plate_over(
    stage: Stage, axes: np.ndarray, target_mm: Vector, width_mm: float, deep_mm: float
) -> Turned:
    """A plate across the z of ``axes`` over a target, so deep from where it first touches."""
    local = (stage.organ.points_mm - target_mm) @ axes
    under = (np.abs(local[:, 0]) < width_mm / 2) & (np.abs(local[:, 1]) < 100.0)
    height = float(local[under, 2].max()) - deep_mm
    half = (width_mm / 2, 100.0, 10.0)
    return Turned(ContactPlate((0.0, 0.0, height + half[2]), half, 4.0), axes, target_mm)


def _random_slit(organ: Organ, rng: Generator) -> Slit:
    """From above into the organ, clear of every tumor. Raises TumortrackError: no room."""
    for _ in range(300):
        middle = organ.place(rng, 0.3)
        normal = unit(np.cross(middle - organ.middle_mm, rng.normal(size=3)))
        slit = Slit(middle, normal, rng.uniform(12.0, 20.0))
        tumors = [tumor.vertices_mm - middle for tumor in organ.anatomy.tumors]
        along = [np.maximum(np.linalg.norm(v, axis=1) - slit.radius_mm, 0) for v in tumors]
        gaps = [np.hypot(v @ normal, a).min() for v, a in zip(tumors, along, strict=True)]
        if min(gaps, default=np.inf) > _CLEAR_MM:
            return slit
    raise TumortrackError("the tumors leave no room for a slit.")


FAMILIES: dict[str, Callable[[Stage, Generator], Load] | None] = {
    "rest": None, "plate": _plate, "clamp": _clamp, "twist": _twist, "pull": _pull,
    "tether": _tether, "roll": _roll, "cut": _cut,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Deformed:
    """A state: the organ's deformed tissue (bench frame, mm)."""

    organ: Organ
    nodes_mm: Nodes
    tets: Int[np.ndarray, "t 4"]  # in the order of the organ's own
    rim_mm: float  # of the bed
    wound: Wound | None
    about: dict[str, Any]

    def forward(self, points_mm: Points) -> Points:
        """Points in or on the organ at rest at their place now."""
        owner, weights = find(self.organ.mesh.nodes_mm[self.organ.mesh.tets], points_mm)
        if self.wound is not None:  # no extrapolation from strained lips
            weights = np.maximum(weights, 0)
            weights /= weights.sum(1, keepdims=True)
        moved = self.nodes_mm[self.tets] - self.organ.mesh.nodes_mm[self.organ.mesh.tets]
        return points_mm + np.einsum("mi,mij->mj", weights, moved[owner])


def solve(organ: Organ, family: str, seed: int) -> Deformed:
    """One state of a family, all of it drawn from the seed. Raises TumortrackError: no equilibrium
    was found, or the organ's volume changed by more than tissue's does."""
    rng = np.random.default_rng([seed, list(FAMILIES).index(family)])
    loading, height = FAMILIES[family], organ.size_mm[2]
    if loading is None:
        rim = rng.uniform(0.1, 0.4) * height
        return Deformed(organ, organ.mesh.nodes_mm, organ.mesh.tets, rim, None, {})
    wound = cut_open(organ.mesh, _random_slit(organ, rng)) if family == "cut" else None
    mesh = wound.mesh if wound else organ.mesh
    material, solid = random_tissue(organ, mesh, rng)
    stage = Stage(organ, solid, wound)
    load = loading(stage, rng)
    rim = rng.uniform(*load.rim) * height
    bed_kpa, friction = log_uniform(rng, 0.3, 40.0), rng.choice([0.0, rng.uniform(0.1, 0.8)])
    friction = 0.0 if load.smooth else friction
    down = np.array([*rng.normal(0, 0.3, 2), -1.0]) * log_uniform(rng, 0.2, 3.0)
    under = organ.bed.under(organ.points_mm, rim)
    steady: list[Force] = [
        stage.touch(under, bed_kpa / BED_DEPTH_MM, friction),
        Weight(GRAVITY_MN_MM3 * solid.node_volumes_mm3[:, None] * down),  # beyond the CT's
    ]
    if not load.free:
        steady.append(Steady.from_solid(solid))
        if rng.uniform() < 0.5:
            patch = stage.patch(organ.hilum_mm, 15.0)
            material["vessels_mn_mm"] = log_uniform(rng, 30.0, 600.0)
            steady.append(stage.grip(patch, np.zeros(3), material["vessels_mn_mm"]))
    if material["capsule_mn_mm"] > 0:
        steady.append(Capsule.from_mesh(mesh, material["capsule_mn_mm"]))
    steps = max(1, int(np.ceil(load.reach_mm / _STEP_MM)))
    loads = ((*steady, *load.at(step / steps)) for step in range(1, steps + 1))
    keys, iterations = equilibria(solid, loads)
    nodes, change = keys[-1], volume_change(solid, keys[-1])
    about = {
        "material": {**material, "bed_kpa": bed_kpa, "friction": friction, "rim_mm": rim},
        "load": load.about,
        "volume_change": change,
        "least_stretch": float(solid.stretch(nodes).min()),
        "iterations": iterations,
        "steps": steps,
    }
    return Deformed(organ, nodes, mesh.tets, rim, wound, about)


def equilibria(
    solid: NeoHookeanSolid, loads: Iterable[tuple[Force, ...]], start_mm: Nodes | None = None
) -> tuple[list[Nodes], int]:
    """The solid's equilibria under one set of forces after the other, each from the one before
    (default: at rest), against which it rubs; and the number of iterations. Raises TumortrackError:
    none was found."""
    nodes, iterations, keys = solid.mesh.nodes_mm if start_mm is None else start_mm, 0, []
    for forces in loads:
        for force in forces:
            if isinstance(force, Touch):
                force.remember(nodes)
        body = LoadedBody(solid, forces)
        nodes, convergence = find_equilibrium(body, nodes, _ITERATIONS)
        iterations += convergence.iterations
        keys.append(nodes)
    return keys, iterations


def volume_change(solid: NeoHookeanSolid, nodes_mm: Nodes) -> float:
    """Relative change of the volume. Raises TumortrackError: more than tissue's."""
    change = float(np.average(solid.stretch(nodes_mm), weights=solid.mesh.volumes_mm3) - 1)
    limit = _LARGEST_CHANGE if solid.poisson < 0.49 else _NEARLY_NONE
    if abs(change) > limit:
        raise TumortrackError(f"the organ's volume changed by {change:.1%}, over {limit:.0%}.")
    return change


def even_tissue(organ: Organ) -> NeoHookeanSolid:
    """15 kPa (kidney and soft PVA gels: about 5 to 30), tumors three times as stiff, nearly
    incompressible."""
    shear = 15.0 / (2 * (1 + 0.49)) * (1 + 2.0 * organ.in_tumor)
    return NeoHookeanSolid(organ.mesh, shear, 0.49)


def random_tissue(
    organ: Organ, mesh: TetMesh, rng: Generator
) -> tuple[dict[str, float], NeoHookeanSolid]:
    """Kidneys: 3 to 40 kPa; tumors one to ten times as stiff; up to a factor of two either way in
    smooth gradients; in half of them a capsule."""
    drawn = {
        "youngs_kpa": log_uniform(rng, 3.0, 40.0),
        "poisson": rng.uniform(0.45, 0.495),
        "tumor_ratio": log_uniform(rng, 1.0, 10.0),
        "gradient": rng.uniform(0.0, np.log(2.0)),
        "capsule_mn_mm": float(rng.choice([0.0, log_uniform(rng, 5.0, 300.0)])),
    }
    middles = (mesh.nodes_mm[mesh.tets].mean(1) - organ.middle_mm) / (organ.size_mm.max() / 2)
    phases = middles @ rng.normal(0, 1.5, (3, 3)) + rng.uniform(0, 2 * np.pi, 3)
    uneven = np.exp(drawn["gradient"] * np.sin(phases).mean(1) * np.sqrt(2))
    ratio = 1 + (drawn["tumor_ratio"] - 1) * organ.in_tumor
    shear = drawn["youngs_kpa"] / (2 * (1 + drawn["poisson"])) * ratio * uneven
    return drawn, NeoHookeanSolid(mesh, shear, drawn["poisson"])
