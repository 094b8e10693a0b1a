"""Folders of scenes: made of a case, and never taken for another case's."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tumortrack.cli.console import progress_bar
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.models.model import Model
    from tumortrack.simulate.scene import SceneConfig

_TEST_BODY = 2**20  # and the seed: elastic states that training with the same seed never sees


@dataclass(frozen=True)
class SimulateOptions:
    scenes: int = 20
    seed: int = 0
    configurations: tuple[int, ...] = (3,)
    falloff: Literal["sigma", "variance"] = "sigma"
    rotations: Literal["limited", "full"] = "limited"
    squeeze: bool = False
    noise: bool = True
    elastic: bool = False

    def scene_config(self) -> SceneConfig:
        from tumortrack.sense.noise import CLEAN, D405_NOISE
        from tumortrack.simulate.deform import (
            ChainConfig,
            DeformConfig,
            DragConfig,
            ElasticConfig,
            StretchConfig,
        )
        from tumortrack.simulate.deform.drag import CONFIGURATIONS
        from tumortrack.simulate.pose import PoseConfig
        from tumortrack.simulate.scene import SceneConfig

        models: list[DragConfig | ElasticConfig] = [
            DragConfig(steps=CONFIGURATIONS[n], falloff=self.falloff) for n in self.configurations
        ]
        if self.elastic:
            models = [ElasticConfig()]
        deform: tuple[DeformConfig, ...] = tuple(
            ChainConfig(links=(model, StretchConfig())) if self.squeeze else model
            for model in models
        )
        return SceneConfig(
            width=848,
            height=480,
            pose=PoseConfig(rotations=self.rotations),
            deform=deform,
            noise=D405_NOISE if self.noise else CLEAN,
        )


def write_scenes(
    case_folder: Path, dataset: Path, options: SimulateOptions, prefix: str = ""
) -> None:
    """Scenes PREFIX0000, PREFIX0001, ... of the ``test`` stream; those that are there stay.

    Raises:
        InputError: no case, or scenes that are not of this case, seed and options.
    """
    from tumortrack.imaging.case import load_case
    from tumortrack.simulate.scene import SceneRecipe, Simulator, body_for
    from tumortrack.simulate.scene_folder import Scene, write_scene
    from tumortrack.simulate.targets import draw_targets

    if options.scenes < 1:
        raise InputError(f"--scenes {options.scenes} must be at least 1.")
    case = load_case(case_folder)
    config = options.scene_config()
    body = body_for(case.anatomy, case.up_lps, config, _TEST_BODY + options.seed)
    simulator = Simulator(case.anatomy, case.up_lps, config, body)
    targets = draw_targets(case.anatomy, options.seed)
    volumes = [part.volume_mm3 for part in case.anatomy.parts]
    about = {
        "case_sha256": store.sha256_of(case_folder / store.MANIFEST),
        "case_volumes_mm3": volumes,
        "config": to_builtins(config),
    }
    with progress_bar("simulate", options.scenes) as advance:
        for index in range(options.scenes):
            folder = dataset / f"{prefix}{index:04d}"
            recipe = SceneRecipe(options.seed, "test", index)
            made_from = {**about, "recipe": asdict(recipe)}
            if folder.exists():
                _check_same(folder, made_from)
            else:
                stage = simulator.render(recipe)
                meta = {
                    **made_from,
                    "camera_from_ct": stage.camera_from_ct.tolist(),
                    "deformation": stage.deformation.record(),
                }
                truth = simulator.reference(stage)
                placed = targets.at(stage.carry(targets.points_ct))
                write_scene(folder, Scene(stage.cloud, truth, stage.frame, meta, placed))
            advance()


def _check_same(folder: Path, made_from: dict) -> None:
    """Refuse to continue a dataset of another case, seed or options."""
    meta = store.read_json(folder / "meta.json")
    if {key: meta.get(key) for key in made_from} != made_from:
        raise InputError(
            f"{folder} is a scene of another case, seed or option. Choose another DATASET folder."
        )


def check_case(model: Model, folders: list[Path]) -> None:
    """Refuse scenes that are known to show another anatomy than the model's.

    Scenes of other programs do not say which case they show; they pass.

    Raises:
        InputError: a scene that `simulate` made of another case.
    """
    wanted = model.provenance.get("case_sha256")
    for folder in folders:
        path = folder / "meta.json"
        stated = store.read_json(path).get("case_sha256") if path.is_file() else None
        if wanted is not None and stated is not None and stated != wanted:
            raise InputError(
                f"{folder} shows another case than the one this model was trained for, so the "
                "figures would mean nothing. Make scenes of the model's own case with: "
                "tumortrack simulate CASE DATASET."
            )
