"""States of a case's organ under the pull of a plan's holder, for the virtual source.

    make pull ARGS='PLAN virtual:CASE?breathing=false&instrument=false OUT.safetensors'
    tumortrack resect PLAN viewer --live CASE 'virtual:CASE?...&pulled=OUT.safetensors'

The plan is made with a `--cell` file that gives pull_mm. Finite elements: see
tumortrack_lab.world.pulled. The organ is pulled where it lies when the source begins.
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
from tumortrack_devices.pulled import PulledStates
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_lab.study import scripts
from tumortrack_lab.world.pulled import Held
from tumortrack_lab.world.scenes import TETS, World, WorldConfig
from tumortrack_resection.files import read_plan

_STATES = 5  # of a pull, the one at rest included


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
        world = World.opened(source.case, WorldConfig(), Path(folder) / TETS)
    grasp_mm = transform_points(world.bench_from_ct @ ct_from_table, stored.plan.grasp_mm[None])[0]
    surface = world.organ.points_mm
    apart_mm = np.linalg.norm(surface - grasp_mm, axis=1)
    up = (world.bench_from_ct @ ct_from_table)[:3, 2]
    rest_ct = np.concatenate([part.vertices_mm for part in player.anatomy_ct.parts])
    rest_mm = transform_points(world.bench_from_ct, rest_ct)
    pulls_mm = np.linspace(0.0, stored.cell.pull_mm, 2 * _STATES - 1)
    held = Held.plain(world.organ)
    states = held.pulled(surface[apart_mm.argmin()], up, pulls_mm.tolist())
    moved_mm = np.stack([state.carry(rest_mm) - rest_mm for state in states])
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
        f"{apart_mm.min():.1f} mm from the grasp point, moves (mm) {tumors}. Between its "
        f"{_STATES} states vertices are off by {off_mm:.3f} mm at most."
    )


if __name__ == "__main__":
    scripts.run(main, Options)
