"""The test subject: the built-in phantom, a scene of it, and its model, kept in a folder."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tumortrack.core.errors import ArtifactError
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.surface import surfaces
from tumortrack.models.folder import save_model
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.registration.config import clinic
from tumortrack.registration.model import RegistrationModel, build_model
from tumortrack.sense.cloud import thin_cloud
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack.tracking.model_files import load_model
from tumortrack_lab.bench.rows import METHOD

_VOXEL_MM = 1.5  # of the phantom
_UP = (0.0, -1.0, 0.0)
_SEED = 0


@dataclass(eq=False)
class BenchSubject:
    """``folder``: where the model is kept."""

    folder: Path

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=_VOXEL_MM))[0]

    @cached_property
    def cloud(self) -> SensorCloud:
        """1,000 points of a view of the phantom, dragged, without sensor noise."""
        config = SceneConfig(deform=(DragConfig(),))
        scene = Simulator(self.anatomy, _UP, config).render(SceneRecipe(_SEED, "test", 0))
        return thin_cloud(scene.cloud, 1000, np.random.default_rng(_SEED))

    @property
    def model_folder(self) -> Path:
        return self.folder / METHOD

    @cached_property
    def model(self) -> RegistrationModel:
        """Raises ArtifactError: there is no whole model of this version."""
        model = load_model(self.model_folder, device="cpu")
        assert isinstance(model, RegistrationModel)
        return model

    @property
    def has_model(self) -> bool:
        """Whether there is a whole model of this version."""
        try:
            return bool(self.model)
        except ArtifactError:
            return False

    def make_model(self) -> None:
        """Write the model into its folder."""
        model = build_model(self.anatomy, _UP, clinic(self.anatomy), _SEED)
        shutil.rmtree(self.model_folder, ignore_errors=True)
        self.model_folder.mkdir(parents=True)
        save_model(model, self.model_folder)
