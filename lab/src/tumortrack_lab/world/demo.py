"""The scenes that the package brings (``tumortrack.datasets.phantom_scenes``): the built-in phantom
in states of the twin and of the world, seen as the world sees, touched as its tools touch.

Nothing in them is chosen by what any method makes of them. Of a world's family it is the first
state, by the seed's number, that has an equilibrium; of a state the first view, drawn as all of a
world's, in which the organ is found. True organ and case are the same surface: errors of
segmentations are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tumortrack.core.errors import NoEstimate, TumortrackError
from tumortrack.core.geometry import transform_points, triangles_of, unit
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.case import load_case
from tumortrack.sense.camera import with_depth_error
from tumortrack.simulate.scene_folder import Scene, Targets, draw_targets
from tumortrack_lab.study.document import make_folder
from tumortrack_lab.twin.apparatus import STATES, moved
from tumortrack_lab.twin.dataset import StateCache, TwinRun
from tumortrack_lab.twin.equilibrium import Rod
from tumortrack_lab.twin.occluders import rod_mesh
from tumortrack_lab.world.evidence import EvidenceSource
from tumortrack_lab.world.families import Deformed, solve
from tumortrack_lab.world.noise import StereoConfig
from tumortrack_lab.world.organ import Organ
from tumortrack_lab.world.scenes import TETS, World, WorldConfig
from tumortrack_lab.world.views import look, organ_cloud

_SEED = 0
_HIDDEN = (0.3, 0.7)  # share, as where a world's disturbance is that
_TOUCHES, _ABOVE = 6, 0.3  # on triangles whose normals rise so much: a tool reaches them


class _Shot(NamedTuple):
    """``state``: of the twin, or a family of the world."""

    state: str
    words: str
    hidden: bool = False


_SHOTS = {
    "1-rest": _Shot("D0", "at rest, as in the CT"),
    "2-pressed-4-mm": _Shot("D1", "pressed by 4 mm between a plate and its bed"),
    "3-pressed-8-mm": _Shot("D2", "pressed by 8 mm between a plate and its bed"),
    "4-pressed-12-mm": _Shot("D3", "pressed by 12 mm between a plate and its bed"),
    "5-cut": _Shot("cut", "cut, and the cut pulled open"),
    "6-sunk": _Shot("G1", "softened after a cut, and sunk by 8 mm under its weight"),
    "7-poked": _Shot("P1", "poked 10 mm deep by a rod"),
    "8-pulled": _Shot("pull", "a tumor pulled by something that is not seen"),
    "9-hidden": _Shot("clamp", "squeezed from two sides, partly hidden", hidden=True),
}
_TOUCHED, _OF = "10-hidden-touched", "9-hidden"


@dataclass(frozen=True, eq=False)
class _Shown:
    """A state on the bench, mm."""

    state: Deformed
    truth: Anatomy
    targets: Targets
    beside: tuple[Mesh, ...] = ()


def demo_scenes(case_folder: Path, kept: Path, say: Callable[[str], None]) -> dict[str, Scene]:
    """The scenes by name. ``kept``: where tetrahedra and the twin's states are kept, without which
    they come out a little differently. Raises TumortrackError: a state has no equilibrium."""
    case, run = load_case(case_folder), TwinRun(case_folder)
    inner = draw_targets(case.anatomy, _SEED)
    make_folder(kept / "twin")
    cache = StateCache(kept / "twin", run, case, inner)
    world = World.opened(case_folder, WorldConfig(), kept / TETS)
    on_bench = moved(case.anatomy, world.bench_from_ct)  # all of the case's triangles
    organ = Organ.of(on_bench, world.organ.mesh)
    targets = inner.at(transform_points(world.bench_from_ct, inner.points_ct))

    def of_twin(name: str) -> _Shown:
        found, mesh = cache.get(name, say), organ.mesh
        rim_mm = np.random.default_rng(_SEED).uniform(0.1, 0.4) * organ.size_mm[2]
        rod = found.report.get("poke")
        beside = () if rod is None else (_shaft(rod),)
        state = Deformed(organ, mesh.nodes_mm, mesh.tets, rim_mm, None, {})  # nodes are not used
        return _Shown(state, found.anatomy, replace(targets, points_mm=found.targets_mm), beside)

    def of_world(family: str) -> _Shown:
        for seed in count(_SEED):
            try:
                state = solve(organ, family, seed)
            except TumortrackError as error:
                say(f"{family} {seed}: {error}")
            else:
                break
        truth = on_bench.of(part.moved(state.carry(part.vertices_mm)) for part in on_bench.parts)
        return _Shown(state, truth, replace(targets, points_mm=state.carry(targets.points_mm)))

    scenes = {}
    for number, (name, shot) in enumerate(_SHOTS.items()):
        say(name)
        shown = (of_twin if shot.state in STATES else of_world)(shot.state)
        scenes[name] = next(_views(shown, shot, number, world.bench_from_ct))
    source = EvidenceSource.of(scenes[_OF], [_SEED])
    touches = source.touches_at_random(_TOUCHES, source.unseen & _upward(scenes[_OF]))
    words = f"the same view, with {_TOUCHES} touches of what the camera does not see"
    scenes[_TOUCHED] = replace(
        scenes[_OF],
        evidence=tuple(piece.evidence for piece in touches),
        meta={**scenes[_OF].meta, "words": words, "false_touches": sum(p.false for p in touches)},
    )
    return scenes


def _views(shown: _Shown, shot: _Shot, number: int, bench_from_ct: np.ndarray) -> Iterator[Scene]:
    """Views in which the organ is found."""
    for attempt in count():
        rng = np.random.default_rng([_SEED, number, attempt])
        hidden = rng.uniform(*_HIDDEN) if shot.hidden else 0.0
        view = look(shown.state, shown.truth.organ, hidden, rng, shown.beside)
        try:
            cloud, on_organ = organ_cloud(view, shown.truth.organ, rng)
        except NoEstimate:
            continue
        to_camera = view.camera_from_bench
        meta: dict[str, Any] = {
            "words": shot.words,
            "state": shot.state,
            **shown.state.about,
            **view.about,
            "attempt": attempt,
            "cloud_on_organ": on_organ,
            "camera_from_ct": (to_camera @ bench_from_ct).tolist(),
            "camera_from_bench": to_camera.tolist(),
        }
        points_mm = transform_points(to_camera, shown.targets.points_mm)
        targets = replace(shown.targets, points_mm=points_mm)
        depth_mm = float(np.median(cloud.points_mm[:, 2]))
        error = StereoConfig().depth_error(view.frame.intrinsics, depth_mm)
        cloud, frame = replace(cloud, depth_error=error), with_depth_error(view.frame, error)
        yield Scene(cloud, moved(shown.truth, to_camera), frame, meta, targets)


def _upward(scene: Scene) -> np.ndarray:
    """The triangles of the organ that face up from the bench."""
    organ, camera_from_bench = scene.reference.organ, np.array(scene.meta["camera_from_bench"])
    _, doubled = triangles_of(organ.vertices_mm, organ.faces)
    rise = doubled @ camera_from_bench[:3, 2]
    return rise > _ABOVE * np.linalg.norm(doubled, axis=1)


def _shaft(poke: dict[str, Any]) -> Mesh:
    """The twin's rod."""
    tip_mm, axis = np.array(poke["tip_mm"], float), unit(np.array(poke["axis"], float))
    return rod_mesh(Rod(tip_mm, axis, float(poke["radius_mm"])))
