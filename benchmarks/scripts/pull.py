"""States of a case's organ under the pull of a plan's holder, for the virtual source.

    make pull ARGS='PLAN virtual:CASE?breathing=false&instrument=false OUT.safetensors'
    tumortrack resect PLAN viewer --live CASE 'virtual:CASE?...&pulled=OUT.safetensors'

The plan is made with a `--cell` file that gives pull_mm. Finite elements, which share nothing with
the elastic body of the default method: fat below the rim and vessels at the hilum hold the organ,
and the cup of a vacuum grasper pulls its surface, where the organ lies when the source begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.live.spec import SOURCES
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.physics.families import (
    BED_DEPTH_MM,
    GRIP_MN_MM,
    Deformed,
    equilibria,
    even_tissue,
    volume_change,
)
from tumortrack_benchmarks.physics.forces import Springs
from tumortrack_benchmarks.physics.organ import Organ, Stage, Vector
from tumortrack_benchmarks.physics.scenes import StressConfig, StressScenes
from tumortrack_benchmarks.physics.tets import TETS
from tumortrack_devices.pulled import PulledStates
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_resection.files import read_plan

_STATES = 5  # of a pull, the one at rest included
_CUP_MM = 8.0  # radius of the grasper's cup
_RIM = 0.4  # of the organ's height: below, fat holds it
_BED_KPA, _VESSELS_MN_MM = 5.0, 200.0
_STEP_MM = 2.0  # of the pull, at a time


@dataclass(frozen=True)
class Options:
    """Solve and write."""

    plan: tyro.conf.Positional[Path]
    """Folder that `tumortrack plan` wrote: where the cup grips, and how far it pulls."""
    source: tyro.conf.Positional[str]
    """The virtual source, as `resect --live` will get it."""
    out: tyro.conf.Positional[Path]
    """The file."""


def main(options: Options) -> None:
    """Solve, check what lies between the states, and write."""
    stored, source = read_plan(options.plan), SOURCES.parse(options.source)
    if not isinstance(source, VirtualSourceConfig):
        raise InputError(f"{options.source} is no virtual source (virtual:CASE?...).")
    if stored.cell is None or not stored.cell.pull_mm:
        raise InputError(f"{options.plan} does not pull; plan with a --cell that gives pull_mm.")
    player = source.player()
    instant = player.state_at(0.0)
    ct_from_camera = np.linalg.inv(instant.camera_from_room @ instant.room_from_organ)
    ct_from_table = ct_from_camera @ np.linalg.inv(stored.frames.published_from_camera)
    with TemporaryDirectory() as folder:
        world = StressScenes.opened(source.case, StressConfig(), Path(folder) / TETS)
    grasp_mm = transform_points(world.bench_from_ct @ ct_from_table, stored.plan.grasp_mm[None])[0]
    surface = world.organ.points_mm
    distance_mm = np.linalg.norm(surface - grasp_mm, axis=1)
    up = (world.bench_from_ct @ ct_from_table)[:3, 2]
    rest_ct = np.concatenate([part.vertices_mm for part in player.anatomy_ct.parts])
    rest_mm = transform_points(world.bench_from_ct, rest_ct)
    pulls_mm = np.linspace(0.0, stored.cell.pull_mm, 2 * _STATES - 1)
    states = pulled(world.organ, surface[distance_mm.argmin()], up, pulls_mm.tolist())
    moved_mm = np.stack([state.forward(rest_mm) - rest_mm for state in states])
    moved_mm = moved_mm @ world.bench_from_ct[:3, :3]
    sha256 = store.sha256_of(source.case / store.MANIFEST)
    kept = PulledStates(sha256, pulls_mm[::2], moved_mm[::2])
    off_mm = max(
        float(np.linalg.norm(kept.at(pull_mm) - moved, axis=1).max())
        for pull_mm, moved in zip(pulls_mm[1::2].tolist(), moved_mm[1::2], strict=True)
    )
    kept.write(options.out)
    ends = np.cumsum([len(part.vertices_mm) for part in player.anatomy_ct.parts])[:-1]
    far_mm = [
        float(np.linalg.norm(part, axis=1).mean()) for part in np.split(moved_mm[-1], ends)[1:]
    ]
    tumors = ", ".join(f"tumor {n} {mm:.1f}" for n, mm in enumerate(far_mm, start=1))
    say(
        f"written to {options.out}: a pull of {pulls_mm[-1]:g} mm at the surface, "
        f"{distance_mm.min():.1f} mm from the grasp point, moves (mm) {tumors}. Between its "
        f"{_STATES} states vertices are off by {off_mm:.3f} mm at most."
    )


def pulled(organ: Organ, grip_mm: Vector, way: Vector, pulls_mm: list[float]) -> list[Deformed]:
    """The states in which the cup, which took the surface's place ``grip_mm`` (bench frame, at
    rest), has moved so far along the unit vector ``way``; from small to large. Raises
    TumortrackError: no equilibrium was found."""
    solid, rim_mm = even_tissue(organ), _RIM * float(organ.size_mm[2])
    stage = Stage(organ, solid)
    low = np.flatnonzero(organ.points_mm[:, 2] < rim_mm)
    fat = _BED_KPA / BED_DEPTH_MM * organ.areas_mm2[low]
    vessels = stage.grip(stage.patch(organ.hilum_mm, 15.0), np.zeros(3), _VESSELS_MN_MM)
    steady = Springs(stage.rows(low), organ.points_mm[low], fat), vessels
    patch = stage.patch(grip_mm, _CUP_MM)
    states, done_mm, nodes = [], 0.0, organ.mesh.nodes_mm
    for pull_mm in pulls_mm:
        steps = max(1, int(np.ceil((pull_mm - done_mm) / _STEP_MM)))
        ways = np.linspace(done_mm, pull_mm, steps + 1)[1:]
        loads = [(*steady, stage.grip(patch, mm * way, GRIP_MN_MM)) for mm in ways]
        nodes = equilibria(solid, loads, nodes)[0][-1] if pull_mm > 0 else nodes
        done_mm = pull_mm
        about = {"pull_mm": pull_mm, "volume_change": volume_change(solid, nodes)}
        states.append(Deformed(organ, nodes, organ.mesh.tets, rim_mm, None, about))
    return states


if __name__ == "__main__":
    scripting.run(main, Options)
