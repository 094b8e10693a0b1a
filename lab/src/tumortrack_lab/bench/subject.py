"""The test subject: the built-in phantom, scenes of it, and models trained for it here.

Labels of untrained networks mean nothing and their volumes have no surface, so whatever runs a
network runs one that has learnt: `clinic` and `quick` for a minute, `paper` one scene alone,
from a fixed seed, kept in a folder; or a user's own.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.surface import surfaces
from tumortrack.models.config import TrainConfig
from tumortrack.models.model import Model
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.registration.model import RegistrationModel
from tumortrack.sense.cloud import thin_cloud
from tumortrack.sense.files import read_cloud
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.scene import RenderedScene, SceneConfig, SceneRecipe, Simulator
from tumortrack.training.model import load_model
from tumortrack.training.state import TrainingRun
from tumortrack.training.train import TrainingStatus, train
from tumortrack_lab.bench.occupancy import OccupancyWorkload
from tumortrack_lab.bench.overfitted import overfit_scene
from tumortrack_lab.bench.registration import RegistrationWorkload
from tumortrack_lab.bench.rows import PRESETS

UP = (0.0, -1.0, 0.0)
SEED = 0
LABELLING = ("quick", "paper")  # the presets that label points
QUERIES = 40_000  # of a frame
_STEPS = {"clinic": 240, "quick": 500, "paper": 300}  # about a minute on two cores each
_VALIDATED = 16  # scenes
_VOXEL_MM = 1.5  # of the phantom

ConfigOf = Callable[[Anatomy], TrainConfig]


@dataclass(eq=False)
class BenchSubject:
    """``presets``: configurations by name; ``folder``: where trained models are kept; ``given``: a
    user's own model and a cloud that shows its organ, which take the place of its preset's."""

    presets: Mapping[str, ConfigOf]
    folder: Path
    given: tuple[Path, Path] | None = None

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=_VOXEL_MM))[0]

    def config(self, preset: str) -> TrainConfig:
        """The preset as it is."""
        return self.presets[preset](self.anatomy)

    @cached_property
    def body(self) -> ElasticBody:
        """The phantom's elastic body: the clinic model's."""
        return self.clinic.shape.body

    def model(self, preset: str) -> Model:
        """The trained model of a preset, on the CPU."""
        return _loaded(self.model_folder(preset))

    @property
    def clinic(self) -> RegistrationModel:
        model = self.model("clinic")
        assert isinstance(model, RegistrationModel)
        return model

    @cache  # noqa: B019 (a subject lives as long as its process)
    def occupancy(self, preset: str) -> OccupancyWorkload:
        """Of a preset: one for all groups of rows, whose naive form then labels its queries
        once."""
        model = self.model(preset)
        assert isinstance(model, OccupancyModel)
        return OccupancyWorkload(model, self.cloud(preset).points_mm)

    @cached_property
    def registration(self) -> RegistrationWorkload:
        return RegistrationWorkload(self.clinic, self.cloud("clinic"), QUERIES)

    def model_folder(self, preset: str) -> Path:
        """Of the trained or given model of a preset."""
        if self.given is not None and preset == self.given_preset:
            return self.given[0]
        return self.folder / preset

    @cached_property
    def given_preset(self) -> str | None:
        """Of the given model: by its kind of network, and the size of what it encodes to.

        Raises:
            InputError: its network is that of no preset.
        """
        if self.given is None:
            return None
        network = _loaded(self.given[0]).config.network
        for preset in PRESETS:
            like = self.config(preset).network
            sizes = (like.encoder.latent_size, network.encoder.latent_size)
            if type(like.encoder) is type(network.encoder) and sizes[0] == sizes[1]:
                return preset
        raise InputError(f"{self.given[0]}: its network is none of {', '.join(PRESETS)}.")

    def cloud(self, preset: str) -> SensorCloud:
        """1,000 points that the preset's model is asked about: of the given cloud, or of a view of
        ``scene``."""
        theirs = self.given is not None and preset == self.given_preset
        seen = read_cloud(self.given[1])[0] if self.given and theirs else self.scene.cloud
        return thin_cloud(seen, 1000, np.random.default_rng(SEED))

    @cached_property
    def scene(self) -> RenderedScene:
        """A scene of the phantom, dragged, without the sensor's faults."""
        config = SceneConfig(deform=(DragConfig(),))
        return Simulator(self.anatomy, UP, config).render(SceneRecipe(SEED, "test", 0))

    def trained(self, preset: str) -> bool:
        """Whether there is a whole model of this version."""
        try:
            self.model(preset)
        except ArtifactError:
            return False
        return True

    def train(self, preset: str, report: Callable[[TrainingStatus], None]) -> None:
        """Train the preset's model into its folder, on the CPU; ``report`` is called with how far
        it is."""
        folder, config = self.model_folder(preset), self.config(preset)
        shutil.rmtree(folder, ignore_errors=True)
        if preset == "paper":
            overfit_scene(
                self.anatomy, (self.scene, self.cloud(preset)), config, folder, _STEPS[preset]
            )
            return
        name = hashlib.sha256(b"the bench's phantom").hexdigest()
        short = replace(config, validation_pairs=_VALIDATED)
        run = TrainingRun(self.anatomy, UP, name, short, SEED, steps=_STEPS[preset], device="cpu")
        train(run, folder, report)


@cache
def _loaded(folder: Path) -> Model:
    """On the CPU.

    Raises:
        ArtifactError: no whole model of this version.
    """
    return load_model(folder, "cpu")
