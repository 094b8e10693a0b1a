"""What is measured: the built-in phantom, scenes of it, and models trained for it here.

Labels of untrained networks mean nothing and their volumes have no surface, so whatever runs a
network runs one that has learnt: `clinic` and `quick` for a minute, `paper` one scene by heart,
from a fixed seed, kept in a folder; or a user's own.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack_lab.bench.by_heart import learn_scene

if TYPE_CHECKING:
    from tumortrack.models.config import TrainConfig
    from tumortrack.models.model import Model
    from tumortrack.registration.model import RegistrationModel
    from tumortrack.simulate.elastic.body import ElasticBody
    from tumortrack.simulate.scene import RenderedScene
    from tumortrack.training.train import TrainingStatus
    from tumortrack_lab.bench.asked import OccupancyWorkload

UP = (0.0, -1.0, 0.0)
SEED = 0
PRESETS = ("clinic", "quick", "paper")
STEPS = {"clinic": 240, "quick": 500, "paper": 300}  # about a minute on two cores each
_VALIDATED = 16  # scenes
_VOXEL_MM = 1.5  # of the phantom

ConfigOf = Callable[[Anatomy], "TrainConfig"]


@dataclass(frozen=True)
class Given:
    """A user's own model, and a cloud that shows its organ: they take the place of the preset's."""

    model: Path
    cloud: Path


@dataclass(eq=False)
class Subject:
    """``presets``: configurations by name; ``folder``: where trained models are kept; ``asked``:
    see ``asked.asked_of``."""

    presets: Mapping[str, ConfigOf]
    folder: Path
    given: Given | None = None
    asked: dict[str, OccupancyWorkload] = field(default_factory=dict)

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        from tumortrack.imaging.surface import surfaces
        from tumortrack.phantom.digital import PhantomParameters, phantom_labels

        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=_VOXEL_MM))[0]

    def config(self, preset: str) -> TrainConfig:
        """The preset as it is."""
        return self.presets[preset](self.anatomy)

    @cached_property
    def body(self) -> ElasticBody:
        """The phantom's elastic body: the clinic model's."""
        return self.clinic.shape.body

    @cached_property
    def clinic(self) -> RegistrationModel:
        """The trained model of that preset."""
        from tumortrack.registration.model import RegistrationModel

        model = self.model("clinic")
        assert isinstance(model, RegistrationModel)
        return model

    @cached_property
    def _models(self) -> dict[str, Model]:
        return {}

    def model(self, preset: str) -> Model:
        """The trained model of a preset, on the CPU.

        Raises:
            InputError: not trained yet (``train``), or the given model is of another preset.
        """
        from tumortrack.training.model import load_model

        if preset not in self._models:
            self._models[preset] = load_model(self.model_folder(preset), "cpu")
        return self._models[preset]

    def model_folder(self, preset: str) -> Path:
        """Of the trained or given model of a preset."""
        if self.given is not None and preset == self.given_preset:
            return self.given.model
        return self.folder / preset

    @cached_property
    def given_preset(self) -> str | None:
        """Of the given model: by its kind of network, and the size of what it encodes to.

        Raises:
            InputError: its network is that of no preset.
        """
        from tumortrack.training.model import load_model

        if self.given is None:
            return None
        network = load_model(self.given.model, "cpu").config.network
        for preset in PRESETS:
            like = self.config(preset).network
            sizes = (like.encoder.latent_size, network.encoder.latent_size)
            if type(like.encoder) is type(network.encoder) and sizes[0] == sizes[1]:
                return preset
        raise InputError(f"{self.given.model}: its network is none of {', '.join(PRESETS)}.")

    def cloud(self, preset: str) -> SensorCloud:
        """1,000 points that the preset's model is asked about: of the given cloud, or of a view of
        ``stage``."""
        from tumortrack.sense.cloud import thin_cloud
        from tumortrack.sense.files import read_cloud

        if self.given is not None and preset == self.given_preset:
            seen = read_cloud(self.given.cloud)[0]
        else:
            seen = self.stage.cloud
        return thin_cloud(seen, 1000, np.random.default_rng(SEED))

    @cached_property
    def stage(self) -> RenderedScene:
        """A scene of the phantom, dragged, without the sensor's faults."""
        from tumortrack.simulate.deform import DragConfig
        from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator

        config = SceneConfig(deform=(DragConfig(),))
        return Simulator(self.anatomy, UP, config).render(SceneRecipe(SEED, "test", 0))

    def trained(self, preset: str) -> bool:
        """Whether there is a whole model of this version."""
        from tumortrack.core.errors import ArtifactError
        from tumortrack.training.model import load_model

        try:
            load_model(self.model_folder(preset), "cpu")
        except ArtifactError:
            return False
        return True

    def train(self, preset: str, tell: Callable[[TrainingStatus], None] = lambda _: None) -> None:
        """Train the preset's model into its folder, on the CPU; ``tell`` hears how far it is."""
        folder, config = self.model_folder(preset), self.config(preset)
        shutil.rmtree(folder, ignore_errors=True)
        if preset == "paper":
            scene = self.stage, self.cloud(preset)
            learn_scene(self.anatomy, scene, config, folder, STEPS[preset])
            return
        from tumortrack.training.run import TrainingRun
        from tumortrack.training.train import train

        name = hashlib.sha256(b"the bench's phantom").hexdigest()
        short = msgspec.structs.replace(config, validation_pairs=_VALIDATED)
        run = TrainingRun(self.anatomy, UP, name, short, SEED, steps=STEPS[preset], device="cpu")
        train(run, folder, tell)
