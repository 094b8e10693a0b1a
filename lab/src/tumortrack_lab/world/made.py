"""A random kidney on disk: its case and its scenes in the wider world's physics."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import tumortrack as tt
from tumortrack.core.errors import TumortrackError
from tumortrack.core.mesh_files import write_anatomy
from tumortrack.simulate.scene_folder import list_scenes
from tumortrack_lab.world.kidneys import SHAPES, random_anatomy
from tumortrack_lab.world.scenes import TETS, World, WorldConfig


def scenes_of(folder: Path, number: int, states: int, shape: str = "kidney") -> list[Path]:
    """Scenes of this random organ's first states, families in turn; what is missing is made:
    FOLDER/case and FOLDER/scenes. Some have no equilibrium, or no organ in the image. ``shape``:
    of ``SHAPES``."""
    case, scenes = folder / "case", folder / "scenes"
    if not case.exists():
        anatomy_ct, up_lps = random_anatomy(number, SHAPES[shape])
        with TemporaryDirectory() as aside:
            write_anatomy(Path(aside), anatomy_ct)
            up = ",".join(f"{value:.6f}" for value in up_lps)
            tt.prepare(aside, case, up=up, name=shape)
    scenes.mkdir(exist_ok=True)
    # What is missing before the last that was made was tried, and failed.
    tried = max((_state(path) for path in scenes.iterdir() if path.is_dir()), default=-1) + 1
    if tried < states:
        world = World.opened(case, WorldConfig(seed=number), scenes / TETS)
        for n in range(tried, states):
            try:
                world.scene(n).write(scenes / "-".join((f"{n:05d}", *world.recipe(n))))
            except TumortrackError:
                continue
    return [path for path in list_scenes(scenes) if _state(path) < states]


def _state(scene: Path) -> int:
    return int(scene.name.split("-")[0])
