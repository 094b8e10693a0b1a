"""The experiments on the organ: one function per kind.

After the paper's section Experiments, and Altamar et al. 2011 (doi 10.1117/12.877992) for G1.
D0: as in the CT, taken free of stress. D1, D2, D3: the midsection pressed to 4, 8, 12 mm less
between a plate and the bed. G1: turgor lost after an incision, softened tissue sinks under its
weight by 8 mm at the midsection. P1: a rod of 8 mm with a round end pressed 10 mm into the side
that faces the camera, away from the tumors.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack_lab.twin.apparatus import Apparatus, State, triangles
from tumortrack_lab.twin.contact import ContactPlate, Obstacles, Rod, Support
from tumortrack_lab.twin.equilibrium import Convergence

STATES = ("D0", "D1", "D2", "D3", "G1", "P1")
COMPRESSION_MM = {"D1": 4.0, "D2": 8.0, "D3": 12.0}
_LARGEST_VOLUME_CHANGE = 0.02
_SINK_STEPS = 15
_SINK_TOLERANCE_MM = 0.4

Progress = Callable[[str], None]
Nodes = Float64[np.ndarray, "n 3"]


def solve(
    bench: Apparatus, name: str, warm: State | None = None, progress: Progress | None = None
) -> State:
    """Bring the organ into a state.

    Args:
        bench: apparatus and case.
        name: one of ``STATES``.
        warm: for D2 and D3, a state of less compression to go on from (the answer is the same).
        progress: called with a line after each load step.

    Raises:
        InputError: no such state.
        TumortrackError: no equilibrium, or the organ's volume changed by over 2 %.
    """
    if name not in STATES:
        raise InputError(f"state {name!r} is not known; allowed: {', '.join(STATES)}.")
    start = time.perf_counter()
    if name == "D0":
        return State(name, bench.mesh.nodes_mm, {"state": name, "volume_change": 0.0})
    run = _Run(bench, progress or (lambda line: None))
    if name == "G1":
        nodes, about = _sink(run)
    elif name == "P1":
        nodes, about = _poke(run)
    else:
        nodes, about = _compress(run, COMPRESSION_MM[name], warm)
    stretch = bench.solid.stretch(nodes)
    change = float(np.average(stretch, weights=bench.mesh.volumes_mm3) - 1)
    if abs(change) > _LARGEST_VOLUME_CHANGE:
        raise TumortrackError(f"{name}: the organ's volume changed by {change:.1%}, over 2 %.")
    moved_mm = np.linalg.norm(nodes - bench.mesh.nodes_mm, axis=1)
    report = {
        "state": name,
        **about,
        "sides_outwards_mm": list(bench.sides_outwards_mm(nodes)),
        "volume_change": change,
        "least_stretch": float(stretch.min()),
        "largest_displacement_mm": float(moved_mm.max()),
        "residual": run.log[-1].residual,
        "steps": [asdict(step) for step in run.log],
        "seconds": time.perf_counter() - start,
    }
    return State(name, nodes, report)


class _Run:
    """The load steps of one state."""

    def __init__(self, bench: Apparatus, progress: Progress) -> None:
        self.bench = bench
        self.log: list[Convergence] = []
        self._progress = progress

    def step(self, nodes: Nodes, obstacles: Obstacles, text: str, weight: float = 0.0) -> Nodes:
        nodes, convergence = self.bench.settle(nodes, obstacles, weight)
        self.log.append(convergence)
        self._progress(f"{text}: {convergence.iterations} iterations")
        return nodes


def _increments(start_mm: float, end_mm: float, step_mm: float) -> list[float]:
    """From start (exclusive) to end in equal steps of about that length."""
    count = max(1, round((end_mm - start_mm) / step_mm))
    return np.linspace(start_mm, end_mm, count + 1)[1:].tolist()


def _compress(run: _Run, by_mm: float, warm: State | None) -> tuple[Nodes, dict]:
    bench, config = run.bench, run.bench.config
    nodes, done_mm = bench.mesh.nodes_mm, 0.0
    if warm is not None and COMPRESSION_MM.get(warm.name, np.inf) < by_mm:
        nodes, done_mm = warm.nodes_mm, COMPRESSION_MM[warm.name]
    low, high = bench.midsection(bench.mesh.nodes_mm)
    half = (config.plate_mm / 2, 200.0, 10.0)  # wider than any organ
    for amount in _increments(done_mm, by_mm, config.load_step_mm):
        above = ContactPlate((0.0, 0.0, high - amount + half[2]), half, config.rounding_mm)
        nodes = run.step(nodes, (above,), f"plate lowered by {amount:.1f} mm")
    now_low, now_high = bench.midsection(nodes)
    return nodes, {
        "plate_z_mm": high - by_mm,
        "midsection_mm": [high - low, now_high - now_low],
        "plate_load_n": -float(bench.contact.load_mn(nodes, above)[2]) / 1000,
        "sunk_in_mm": bench.contact.depth_mm(nodes, (Support(), above)),
    }


def _sink(run: _Run) -> tuple[Nodes, dict]:
    """Weight over stiffness grows until the midsection has sunk as far as wanted.

    Tissue softer by a factor and weight multiplied by it are the same problem; the second keeps
    the factorised stiffness. One weight of it is borne already, as the CT shows.
    """
    bench, wanted = run.bench, run.bench.config.sink_mm
    height = bench.midsection(bench.mesh.nodes_mm)[1]
    nodes, added, sunk = bench.mesh.nodes_mm, 4.0, 0.0
    less, more = (0.0, 0.0), (np.inf, np.inf)  # weights added, and how far it sank
    for _ in range(_SINK_STEPS):
        nodes = run.step(nodes, (), f"softer by {1 + added:.1f}, sunk {sunk:.1f} mm before", added)
        sunk = height - bench.midsection(nodes)[1]
        if abs(sunk - wanted) < _SINK_TOLERANCE_MM:
            return nodes, {
                "youngs_kpa": bench.config.youngs_kpa / (1 + added),
                "sunk_mm": sunk,
                "sunk_in_mm": bench.contact.depth_mm(nodes, (Support(),)),
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


def _poke(run: _Run) -> tuple[Nodes, dict]:
    bench, config = run.bench, run.bench.config
    radius = config.poke_diameter_mm / 2
    x, y, z = poke_point(bench).tolist()
    nodes = bench.mesh.nodes_mm
    for depth in _increments(0.0, config.poke_mm, config.load_step_mm / 2):
        rod = Rod((x, y, z - depth), (0.0, 0.0, 1.0), radius)
        nodes = run.step(nodes, (rod,), f"rod pressed in by {depth:.1f} mm")
    load_n = -float(bench.contact.load_mn(nodes, rod)[2]) / 1000
    if load_n <= 0:
        raise TumortrackError("P1: the surface slipped past the rod; take a finer mesh (edge_mm).")
    return nodes, {
        "poke": {"tip_mm": list(rod.tip_mm), "axis": list(rod.axis), "radius_mm": radius},
        "poke_load_n": load_n,
        "sunk_in_mm": bench.contact.depth_mm(nodes, (Support(), rod)),
    }


def poke_point(bench: Apparatus) -> Float64[np.ndarray, " 3"]:
    """Where the surface faces up and is farthest from every tumor and from the organ's rim."""
    from scipy.spatial import cKDTree

    middle, normal = triangles(bench.anatomy.organ)
    facing = normal[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    top = (facing > min(0.85, float(facing.max()))) & (middle[:, 2] > middle[:, 2].mean())
    room = cKDTree(middle[facing < 0.5]).query(middle[top])[0]
    for tumor in bench.anatomy.tumors:
        room = np.minimum(room, cKDTree(tumor.vertices_mm).query(middle[top])[0])
    return middle[top][int(room.argmax())]
