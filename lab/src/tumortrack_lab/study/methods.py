"""What can be measured: something with an identity that turns a scene's cloud into an estimate."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.models.model import Model
from tumortrack.registration.model import RegistrationModel
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model

LIVE_STAGES = (
    "encode",
    "coarse",
    "refine",
    "fine",
)  # what a live frame takes; the dense volume is extra


@dataclass(frozen=True)
class Answer:
    """An estimate, and what a live frame of it costs."""

    estimate: Estimate
    frame_s: float


class Method(ABC):
    """One way to locate, for one patient. Nothing heavy is made or loaded before it is needed."""

    @property
    @abstractmethod
    def identity(self) -> dict:
        """``kind``, ``name`` and everything else that decides the answers (JSON)."""

    @property
    @abstractmethod
    def device(self) -> str:
        """What it runs on."""

    @property
    @abstractmethod
    def prepare_s(self) -> float | None:
        """Spent once for a patient, before the first frame: training, or a peer's own work."""

    @property
    @abstractmethod
    def about(self) -> dict:
        """What else a reader wants to know of it (JSON)."""

    @abstractmethod
    def locate(self, scene: Scene, grid: int) -> Answer:
        """The anatomy in a scene; ``grid``: voxels along the longest side of the volume.

        Raises:
            NoEstimate: nothing can be said of the scene.
            InputError: the cloud cannot be used.
        """


@dataclass(frozen=True)
class Network(Method):
    """A trained model under a name such as M_lim; ``unrefined``: its warps as the network says
    them, not laid on the cloud."""

    name: str
    folder: Path
    want_device: str = "auto"
    locate_seed: int = 0
    unrefined: bool = False

    @cached_property
    def identity(self) -> dict:
        about = self.provenance
        named = {"unrefined": True} if self.unrefined else {}  # older cells have no such word
        return {
            "kind": "network",
            "name": self.name,
            "seed": about["seed"],
            "steps": about["steps"],
            "locate_seed": self.locate_seed,
            "model_sha256": store.sha256_of(self.folder / store.MANIFEST),
            **named,
        }

    @property
    def provenance(self) -> dict:
        """The model's own: steps, seconds of training, device."""
        return store.read_json(self.folder / store.MANIFEST)["provenance"]

    @cached_property
    def _model(self) -> Model:
        model = load_model(self.folder, self.want_device)
        return without_refinement(model) if self.unrefined else model

    @cached_property
    def _tracker(self) -> Tracker:
        return Tracker(self._model)

    @property
    def device(self) -> str:
        return str(next(self._model.network.parameters()).device.type)

    @property
    def prepare_s(self) -> float | None:
        return self.about["training_s"]

    @property
    def about(self) -> dict:
        """Of the training: seed, steps, seconds, device, validation mIoU."""
        keys = ("seed", "steps", "training_s", "device", "validation_miou")
        return {key: self.provenance[key] for key in keys}

    def locate(self, scene: Scene, grid: int) -> Answer:
        estimate = self._tracker.locate(scene.cloud, grid, self.locate_seed)
        seconds = estimate.report["timings"]
        return Answer(estimate, sum(seconds.get(stage, 0.0) for stage in LIVE_STAGES))


def without_refinement(model: Model) -> RegistrationModel:
    """The warp model that takes its network's word; only which way round an organ lies, where the
    network is in doubt, is still decided by the cloud. Any fit is familiar and usual to it, for
    validation knew refined ones.

    Raises:
        InputError: the model is no warp.
    """
    if not isinstance(model, RegistrationModel):
        raise InputError("only warps are refined; an occupancy model has no unrefined form.")
    config = msgspec.structs.replace(
        model.config, refine=msgspec.structs.replace(model.config.refine, steps=0)
    )
    in_distribution = msgspec.structs.replace(model.in_distribution, fit_mm=math.inf)
    trust = msgspec.structs.replace(model.calibration, usual_cost=math.inf)
    return replace(model, config=config, in_distribution=in_distribution, calibration=trust)
