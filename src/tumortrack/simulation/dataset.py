"""Scenes of a case by their numbers, in memory or as a folder of scene folders."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.io.case import Case
from tumortrack.io.scene_folder import Scene, draw_targets
from tumortrack.simulation.scene import SceneConfig, SceneRecipe, Simulator, body_for

_TEST_BODY = 2**20  # and the seed: elastic states that training with the same seed never sees


def scene_maker(case: Case, config: SceneConfig, seed: int) -> Callable[[int], Scene]:
    """Makes any scene of the stream ``test`` by its number."""
    body = body_for(case.anatomy, case.up_lps, config, _TEST_BODY + seed)
    simulator = Simulator(case.anatomy, case.up_lps, config, body)
    inner = draw_targets(case.anatomy, seed)

    def make(index: int) -> Scene:
        recipe = SceneRecipe(seed, "test", index)
        made = simulator.render(recipe)
        meta = {
            "recipe": asdict(recipe),
            "camera_from_ct": made.camera_from_ct.tolist(),
            "deformation": made.deformation.record(),
        }
        targets = inner.at(made.forward(inner.points_ct))
        return Scene(made.cloud, simulator.reference(made), made.frame, meta, targets)

    return make


def write_scenes(
    case: Case, config: SceneConfig, seed: int, folders: Iterable[Path]
) -> Iterator[None]:
    """Write scenes into folders, with an iteration each; those that are there stay. InputError: one
    of them was made otherwise."""
    about = {
        "case_sha256": case.sha256,
        "case_volumes_mm3": [part.volume_mm3 for part in case.anatomy.parts],
        "config": to_builtins(config),
    }
    make = scene_maker(case, config, seed)
    for index, folder in enumerate(folders):
        if folder.exists():
            made_from = {**about, "recipe": asdict(SceneRecipe(seed, "test", index))}
            meta = store.read_json(folder / "meta.json")
            if {key: meta.get(key) for key in made_from} != made_from:
                raise InputError(
                    f"{folder} is of another case, seed or option. Choose another DATASET."
                )
        else:
            scene = make(index)
            replace(scene, meta={**about, **scene.meta}).write(folder)
        yield
