"""The ten scenes that the package brings (``tumortrack.datasets.phantom_scenes``): the built-in
phantom in states of the twin and of the wider world, seen as that sees, touched as its tools touch.

    make demo-scenes ARGS='OUT'        (some five minutes)

Writes src/tumortrack/simulation/phantom_scenes.safetensors. OUT keeps the phantom's CT and case and
the tetrahedra, with which the same command gives the same file.

Nothing in the scenes is chosen by what any method makes of them. Of a family it is the first state,
by the seed's number, that has an equilibrium; of a state the first view, drawn as all of a world's,
in which the organ is found. True organ and case are the same surface: errors of segmentations are
left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

import tumortrack as tt
from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.camera import with_depth_error
from tumortrack.core.errors import NoEstimate, TumortrackError
from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.io.case import Case
from tumortrack.io.scene_folder import InnerPoints, Scene, draw_targets
from tumortrack.simulation import datasets
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.physics.equilibrium import Rod
from tumortrack_benchmarks.physics.evidence import EvidenceSource
from tumortrack_benchmarks.physics.families import FAMILIES, Deformed, solve
from tumortrack_benchmarks.physics.noise import StereoConfig
from tumortrack_benchmarks.physics.occluders import rod_mesh
from tumortrack_benchmarks.physics.organ import Organ, transformed
from tumortrack_benchmarks.physics.tets import TETS
from tumortrack_benchmarks.physics.twin import Bench
from tumortrack_benchmarks.physics.twin import solve as solve_twin
from tumortrack_benchmarks.physics.views import organ_cloud, render_view

_SEED = 0
_HIDDEN = (0.3, 0.7)  # share
_TOUCHES, _ABOVE = 6, 0.3  # on triangles whose normals rise so much: a tool reaches them


class Shot(NamedTuple):
    """``state``: of the twin, or a family of the world."""

    state: str
    words: str
    hidden: bool = False


SHOTS = {
    "1-rest": Shot("D0", "at rest, as in the CT"),
    "2-pressed-4-mm": Shot("D1", "pressed by 4 mm between a plate and its bed"),
    "3-pressed-8-mm": Shot("D2", "pressed by 8 mm between a plate and its bed"),
    "4-pressed-12-mm": Shot("D3", "pressed by 12 mm between a plate and its bed"),
    "5-cut": Shot("cut", "cut, and the cut pulled open"),
    "6-sunk": Shot("G1", "softened after a cut, and sunk by 8 mm under its weight"),
    "7-poked": Shot("P1", "poked 10 mm deep by a rod"),
    "8-pulled": Shot("pull", "a tumor pulled by something that is not seen"),
    "9-hidden": Shot("clamp", "squeezed from two sides, partly hidden", hidden=True),
}
TOUCHED, OF = "10-hidden-touched", "9-hidden"


@dataclass(frozen=True)
class Options:
    """Make the scenes and pack them."""

    out: tyro.conf.Positional[Path]
    """What takes long is kept here."""


def main(options: Options) -> None:
    """The case of the demo, its scenes, one file."""
    case = options.out / "case"
    if not case.exists():
        tt.prepare(tt.scan_phantom(options.out / "ct", spacing_mm=datasets.SPACING_MM), case)
    opened = tt.load_case(case)
    content = datasets.packed(scenes_of(opened, options.out), opened.anatomy)
    file = Path(datasets.__file__).with_name(datasets.FILE)
    store.write_atomically(file, content)
    say(f"{len(content) / 1e6:.1f} MB written to {file}.")


def _solved(bench: Bench, name: str) -> Deformed:
    """A state of the twin, or the first of a family that has an equilibrium."""
    if name not in FAMILIES:
        return solve_twin(bench, name, say)
    organ = bench.stage.organ
    organ = Organ.from_anatomy(organ.anatomy, organ.mesh)
    for seed in count(_SEED):
        try:
            return solve(organ, name, seed)
        except TumortrackError as error:
            say(f"{name} {seed}: {error}")
    raise AssertionError


def scenes_of(case: Case, kept: Path) -> dict[str, Scene]:
    """The scenes by name. ``kept``: where the tetrahedra are kept."""
    bench, inner = (
        Bench.from_anatomy(case.anatomy, case.up_lps, kept / TETS),
        draw_targets(case.anatomy, 0),
    )
    scenes = {}
    for number, (name, shot) in enumerate(SHOTS.items()):
        say(name)
        scenes[name] = next(_views(bench, _solved(bench, shot.state), inner, shot, number))
    source = EvidenceSource.of(scenes[OF], [_SEED])
    touches = source.touches_at_random(_TOUCHES, source.unseen & _upward(scenes[OF]))
    words = f"the same view, with {_TOUCHES} touches of what the camera does not see"
    scenes[TOUCHED] = replace(
        scenes[OF],
        evidence=tuple(piece.evidence for piece in touches),
        meta={**scenes[OF].meta, "words": words, "false_touches": sum(p.false for p in touches)},
    )
    return scenes


def _views(
    bench: Bench, state: Deformed, inner: InnerPoints, shot: Shot, number: int
) -> Iterator[Scene]:
    """Views in which the organ is found."""
    rest = state.organ.anatomy
    truth = rest.with_parts(
        part.with_vertices(state.forward(part.vertices_mm)) for part in rest.parts
    )
    points_mm = state.forward(transform_points(bench.bench_from_ct, inner.points_ct))
    poke = state.about.get("poke")
    beside = ()
    if poke is not None:  # the twin's rod
        rod = Rod(np.array(poke["tip_mm"]), np.array(poke["axis"]), poke["radius_mm"])
        beside = (rod_mesh(rod),)
    for attempt in count():
        rng = np.random.default_rng([_SEED, number, attempt])
        hidden = rng.uniform(*_HIDDEN) if shot.hidden else 0.0
        view = render_view(state, truth.organ, hidden, rng, beside)
        try:
            cloud, on_organ = organ_cloud(view, truth.organ, rng)
        except NoEstimate:
            continue
        to_camera = view.camera_from_bench
        meta: dict[str, Any] = {
            **state.about,
            "words": shot.words,
            "state": shot.state,
            **view.about,
            "attempt": attempt,
            "cloud_on_organ": on_organ,
            "camera_from_ct": (to_camera @ bench.bench_from_ct).tolist(),
            "camera_from_bench": to_camera.tolist(),
        }
        depth_mm = float(np.median(cloud.points_mm[:, 2]))
        error = StereoConfig().depth_error(view.frame.intrinsics, depth_mm)
        cloud, frame = replace(cloud, depth_error=error), with_depth_error(view.frame, error)
        targets = inner.at(transform_points(to_camera, points_mm))
        yield Scene(cloud, transformed(truth, to_camera), frame, meta, targets)


def _upward(scene: Scene) -> np.ndarray:
    """The triangles of the organ that face up from the bench."""
    organ, camera_from_bench = scene.reference.organ, np.array(scene.meta["camera_from_bench"])
    _, doubled = triangles_of(organ.vertices_mm, organ.faces)
    rise = doubled @ camera_from_bench[:3, 2]
    return rise > _ABOVE * np.linalg.norm(doubled, axis=1)


if __name__ == "__main__":
    scripting.run(main, Options)
