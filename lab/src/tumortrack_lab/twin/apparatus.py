"""The apparatus of the paper's experiment as physics, with one case on it, and its experiments.

Bench frame, mm: z up, towards the camera; the support is the plane z = 0, on which the organ
stands as in its CT; its long axis lies along x, its middle at x = y = 0. Packing between support
and organ fits the underside, as the body's own bed does: on a bare plane an organ that stands on
its pole would first of all collapse, which says nothing of plates and instruments.

The CT shows the organ at rest under its weight in that bed. Only what is added deforms it: loads,
and weight that softened tissue no longer bears. After the paper's section Experiments, and Altamar
et al. 2011 (doi 10.1117/12.877992) for G1. D0: as in the CT, taken free of stress. D1, D2, D3: the
midsection pressed to 4, 8, 12 mm less between a plate and the bed. G1: turgor lost after an
incision, softened tissue sinks under its weight by 8 mm at the midsection. P1: a rod of 8 mm with a
round end pressed 10 mm into the side that faces the camera, away from the tumors.

It shares nothing with the elastic body of the default method.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.geometry import rigid, transform_points, triangles_of
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.raster import label_grid
from tumortrack_experiment.kit.base import laid_down as bench_from_ct
from tumortrack_experiment.kit.stands import COMPRESSION_MM, poke_point
from tumortrack_lab.tets import TetMesh, embed, tetrahedralise
from tumortrack_lab.twin import equilibrium
from tumortrack_lab.twin.equilibrium import ContactPlate, Nodes, Rod, Support
from tumortrack_lab.twin.solid import NeoHookeanSolid
from tumortrack_lab.world.forces import LoadedBody, Obstacle, Steady, Touch, Weight, rows_of

GRAVITY_KPA_PER_MM = 9.81e-6  # of 1 kg/m^3
STATES = ("D0", "D1", "D2", "D3", "G1", "P1")
_LARGEST_VOLUME_CHANGE = 0.02
_STEEPEST = 1.5  # slope of the underside, which packing bears
_SINK_STEPS = 15
_SINK_TOLERANCE_MM = 0.4

Obstacles = tuple[Obstacle, ...]
Step = Callable[..., Nodes]  # of the load: nodes, obstacles, text, added weight -> nodes at rest


class ApparatusConfig(Config, frozen=True, kw_only=True):
    """Material and apparatus."""

    youngs_kpa: float = 15.0  # of the organ; kidney and soft PVA gels lie near 5..30 kPa
    tumor_ratio: float = 3.0  # tumors are stiffer by this factor (2..5)
    poisson: float = 0.49  # nearly incompressible
    density_kg_m3: float = 1050.0
    edge_mm: float = 5.5  # of the tetrahedra
    contact_kpa_mm: float = 300.0  # penalty per depth; few kPa sink in by about 0.1 mm
    packing_kpa_mm: float = 3.0  # under the organ: fat, foam
    plate_mm: float = 36.0  # width along the organ
    rounding_mm: float = 4.0  # of the plate's edges
    load_step_mm: float = 2.0  # the plate advances by this much at a time, the rod by half
    sink_mm: float = 8.0
    poke_mm: float = 10.0
    poke_diameter_mm: float = 8.0


@dataclass(frozen=True, eq=False)
class State:
    """The organ at rest in one state: where the mesh's nodes lie, and what was measured."""

    name: str
    nodes_mm: Float64[np.ndarray, "n 3"]
    report: dict


class _Body(LoadedBody):
    """Unbalanced forces are measured against weight and contact forces, each one's sum."""

    def load_mn(self, nodes_mm: Nodes) -> float:
        forces = (force for force in self.forces if not isinstance(force, Steady))
        return float(sum(np.linalg.norm(f.energy(nodes_mm)[1].sum(0)) for f in forces))


class Apparatus:
    def __init__(
        self, anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: ApparatusConfig
    ) -> None:
        self.config = config
        self.bench_from_ct = bench_from_ct(anatomy_ct.organ, up_lps)
        self.anatomy = moved(anatomy_ct, self.bench_from_ct)
        self.mesh = tetrahedralise(self.anatomy.organ, config.edge_mm)
        ratio = 1 + (config.tumor_ratio - 1) * tumor_share(self.mesh, self.anatomy)
        shear_kpa = config.youngs_kpa * ratio / (2 * (1 + config.poisson))
        self.solid = NeoHookeanSolid(self.mesh, shear_kpa, config.poisson)
        points_mm, self._areas_mm2 = contact_points(self.anatomy.organ, 1.0, 1.0)
        self.surface = embed(self.mesh, points_mm)
        self._rows = rows_of(self.surface, len(self.mesh.nodes_mm))
        volumes = self.solid.node_volumes_mm3
        self._weight_mn = config.density_kg_m3 * GRAVITY_KPA_PER_MM * volumes
        under = _faces_down(self.anatomy.organ, points_mm)
        areas_mm2, bed = self._areas_mm2[under], Support(points_mm[under, 2])
        packing = Touch(self._rows[under], areas_mm2, bed, config.packing_kpa_mm)
        self._always = self.touch(Support()), packing, Steady.of(self.solid)

    def carry(
        self, state: State, points_ct: Float[np.ndarray, "m 3"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Points in or on the organ (CT frame) at their place on the bench, mm."""
        points = transform_points(self.bench_from_ct, np.asarray(points_ct, np.float64))
        # The displacement is interpolated, not the point, so that D0 is exact to the last digit.
        return points + embed(self.mesh, points).carry(state.nodes_mm - self.mesh.nodes_mm)

    def find_equilibrium(
        self, nodes_mm: np.ndarray, obstacles: Obstacles, weight: float = 0.0
    ) -> tuple[np.ndarray, equilibrium.Convergence]:
        """One load step: the nodes at rest in their bed among obstacles, under so many weights more
        than in the CT. Raises TumortrackError: no equilibrium was found."""
        down_mn = weight * self._weight_mn[:, None] * [0.0, 0.0, -1.0]
        body = _Body(self.solid, (*self._always, *map(self.touch, obstacles), Weight(down_mn)))
        return equilibrium.find_equilibrium(body, nodes_mm)

    def touch(self, obstacle: Obstacle) -> Touch:
        """What an obstacle does to the surface."""
        return Touch(self._rows, self._areas_mm2, obstacle, self.config.contact_kpa_mm)

    def load_n(self, nodes_mm: Nodes, obstacle: Obstacle) -> float:
        """How much of an obstacle's weight the organ bears."""
        return float(self.touch(obstacle).energy(nodes_mm)[1][:, 2].sum()) / 1000

    def sunk_in_mm(self, nodes_mm: Nodes, *obstacles: Obstacle) -> float:
        """The deepest penetration of the surface into the support or an obstacle."""
        points = self.surface.carry(nodes_mm)
        return max(0.0, *(-float(o.distance(points)[0].min()) for o in (Support(), *obstacles)))

    def midsection(self, nodes_mm: np.ndarray, axis: int = 2) -> tuple[float, float]:
        """Lowest and highest z (or y) of the surface under the middle half of the plate, mm."""
        at_rest = self.surface.carry(self.mesh.nodes_mm)
        in_middle = np.abs(at_rest[:, 0]) < self.config.plate_mm / 4
        there = self.surface.carry(nodes_mm)[in_middle, axis]
        return float(there.min()), float(there.max())


def moved(anatomy: Anatomy, b_from_a: Float64[np.ndarray, "4 4"]) -> Anatomy:
    """An anatomy in another frame."""
    return anatomy.of(
        part.moved(transform_points(b_from_a, part.vertices_mm)) for part in anatomy.parts
    )


def contact_points(
    organ: Mesh, spacing_mm: float, cube_mm: float
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, " m"]]:
    """One point of the surface per cube that it passes, and the area there."""
    points_mm, areas_mm2 = surface_samples(organ, spacing_mm)
    cubes = np.floor(points_mm / cube_mm)
    _, first, cube = np.unique(cubes, axis=0, return_index=True, return_inverse=True)
    return points_mm[first], np.bincount(cube.ravel(), areas_mm2)


def _faces_down(organ: Mesh, points_mm: Float64[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
    """Which points of the surface lie on its underside, where it is not too steep."""
    middle, normal = triangles_of(organ.vertices_mm, organ.faces)
    down = -normal[:, 2] > np.linalg.norm(normal, axis=1) / np.hypot(1, _STEEPEST)
    return np.asarray(down[cKDTree(middle).query(points_mm)[1]])


def tumor_share(mesh: TetMesh, anatomy: Anatomy) -> Float64[np.ndarray, " t"]:
    """Share of each tetrahedron that lies in a tumor, by a voxel grid of 1 mm."""
    low = np.floor(anatomy.organ.box_mm[0]) - 1
    shape = np.ceil(anatomy.organ.box_mm[1] - low).astype(int) + 2
    labels = label_grid(anatomy, rigid(np.eye(3), low), tuple(shape.tolist()))
    # Fixed points spread over a tetrahedron: corners, edges' middles and centre, pulled inwards.
    spread = np.concatenate(
        [np.eye(4), (np.eye(4)[[0, 0, 0, 1, 1, 2]] + np.eye(4)[[1, 2, 3, 2, 3, 3]]) / 2]
    )
    weights = np.concatenate([0.75 * spread + 0.0625, np.full((1, 4), 0.25)])
    points = np.einsum("pk,tkj->tpj", weights, mesh.nodes_mm[mesh.tets])
    index = np.clip(np.rint(points - low).astype(int), 0, shape - 1)
    return np.asarray((labels[tuple(index.transpose(2, 0, 1))] > 1).mean(1), np.float64)


def solve(
    bench: Apparatus,
    name: str,
    warm: State | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> State:
    """Bring the organ into a state. ``warm``: for D2 and D3, a state of less compression to go on
    from (the answer is the same); ``progress``: called with a line after each load step. Raises
    InputError: no such state; TumortrackError: no equilibrium, or the organ's volume changed by
    over 2 %."""
    if name not in STATES:
        raise InputError(f"state {name!r} is not known; allowed: {', '.join(STATES)}.")
    start, log = time.perf_counter(), list[equilibrium.Convergence]()
    if name == "D0":
        return State(name, bench.mesh.nodes_mm, {"state": name, "volume_change": 0.0})

    def step(nodes: Nodes, obstacles: Obstacles, text: str, weight: float = 0.0) -> Nodes:
        nodes, convergence = bench.find_equilibrium(nodes, obstacles, weight)
        log.append(convergence)
        progress(f"{text}: {convergence.iterations} iterations")
        return nodes

    if name in COMPRESSION_MM:
        nodes, about = _compress(bench, step, COMPRESSION_MM[name], warm)
    else:
        nodes, about = (_sink if name == "G1" else _poke)(bench, step)
    stretch = bench.solid.stretch(nodes)
    change = float(np.average(stretch, weights=bench.mesh.volumes_mm3) - 1)
    if abs(change) > _LARGEST_VOLUME_CHANGE:
        raise TumortrackError(f"{name}: the organ's volume changed by {change:.1%}, over 2 %.")
    moved_mm = np.linalg.norm(nodes - bench.mesh.nodes_mm, axis=1)
    left, right = np.subtract(bench.midsection(nodes, 1), bench.midsection(bench.mesh.nodes_mm, 1))
    report = {
        "state": name,
        **about,
        "sides_outwards_mm": [-float(left), float(right)],
        "volume_change": change,
        "least_stretch": float(stretch.min()),
        "largest_displacement_mm": float(moved_mm.max()),
        "residual": log[-1].residual,
        "steps": [asdict(step) for step in log],
        "seconds": time.perf_counter() - start,
    }
    return State(name, nodes, report)


def _increments(start_mm: float, end_mm: float, step_mm: float) -> list[float]:
    """From start (exclusive) to end in equal steps of about that length."""
    count = max(1, round((end_mm - start_mm) / step_mm))
    return np.linspace(start_mm, end_mm, count + 1)[1:].tolist()


def _compress(bench: Apparatus, step: Step, by_mm: float, warm: State | None) -> tuple[Nodes, dict]:
    config, nodes, done_mm = bench.config, bench.mesh.nodes_mm, 0.0
    if warm is not None and COMPRESSION_MM.get(warm.name, np.inf) < by_mm:
        nodes, done_mm = warm.nodes_mm, COMPRESSION_MM[warm.name]
    low, high = bench.midsection(bench.mesh.nodes_mm)
    half = (config.plate_mm / 2, 200.0, 10.0)  # wider than any organ
    for amount in _increments(done_mm, by_mm, config.load_step_mm):
        above = ContactPlate((0.0, 0.0, high - amount + half[2]), half, config.rounding_mm)
        nodes = step(nodes, (above,), f"plate lowered by {amount:.1f} mm")
    now_low, now_high = bench.midsection(nodes)
    return nodes, {
        "plate_z_mm": high - by_mm,
        "midsection_mm": [high - low, now_high - now_low],
        "plate_load_n": bench.load_n(nodes, above),
        "sunk_in_mm": bench.sunk_in_mm(nodes, above),
    }


def _sink(bench: Apparatus, step: Step) -> tuple[Nodes, dict]:
    """Weight over stiffness grows until the midsection has sunk as far as wanted. Softer tissue and
    more weight are the same problem; the second keeps the factorised stiffness. One weight of it is
    borne already, as the CT shows."""
    wanted, nodes = bench.config.sink_mm, bench.mesh.nodes_mm
    height, added, sunk = bench.midsection(nodes)[1], 4.0, 0.0
    less, more = (0.0, 0.0), (np.inf, np.inf)  # weights added, and how far it sank
    for _ in range(_SINK_STEPS):
        nodes = step(nodes, (), f"softer by {1 + added:.1f}, sunk {sunk:.1f} mm before", added)
        sunk = height - bench.midsection(nodes)[1]
        if abs(sunk - wanted) < _SINK_TOLERANCE_MM:
            return nodes, {
                "youngs_kpa": bench.config.youngs_kpa / (1 + added),
                "sunk_mm": sunk,
                "sunk_in_mm": bench.sunk_in_mm(nodes),
            }
        less, more = ((added, sunk), more) if sunk < wanted else (less, (added, sunk))
        if np.isfinite(more[0]):
            share = (wanted - less[1]) / (more[1] - less[1])
            added = less[0] + share * (more[0] - less[0])
        else:
            added *= min(2.0, wanted / max(sunk, 1e-6))
    raise TumortrackError(
        f"G1: the midsection would not sink by {wanted:g} mm (it sank {sunk:.1f} mm at "
        f"{1 + added:.1f} times the softness). Choose a smaller sink_mm."
    )


def _poke(bench: Apparatus, step: Step) -> tuple[Nodes, dict]:
    config, nodes = bench.config, bench.mesh.nodes_mm
    radius = config.poke_diameter_mm / 2
    point, up = poke_point(bench.anatomy), np.array([0.0, 0.0, 1.0])
    for depth in _increments(0.0, config.poke_mm, config.load_step_mm / 2):
        rod = Rod(point - depth * up, up, radius)
        nodes = step(nodes, (rod,), f"rod pressed in by {depth:.1f} mm")
    load_n = bench.load_n(nodes, rod)
    if load_n <= 0:
        raise TumortrackError("P1: the surface slipped past the rod; take a finer mesh (edge_mm).")
    return nodes, {
        "poke": {"tip_mm": rod.tip_mm.tolist(), "axis": up.tolist(), "radius_mm": radius},
        "poke_load_n": load_n,
        "sunk_in_mm": bench.sunk_in_mm(nodes, rod),
    }
