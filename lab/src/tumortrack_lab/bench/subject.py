"""The test subject: the built-in phantom, scenes of it, and models trained for it here.

Labels of untrained networks mean nothing and their volumes have no surface, so whatever runs a
network runs one that has learnt, from a fixed seed, kept in a folder; or a user's own. `clinic`
and `quick` learn for a minute. The paper's network learns for hours: where its labels are compared,
or the surface of its volume decides the time, one that is as sure of a single scene serves. Its
encoder stays as it was drawn, and so do the weights on the latent; the rest of the decoder learns.
"""

from __future__ import annotations

import hashlib
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
import torch
from msgspec.structs import replace
from torch.nn.functional import cross_entropy

from tumortrack.core.errors import ArtifactError, InputError
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.surface import surfaces
from tumortrack.models.config import TrainConfig
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.model import Model
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.registration.model import RegistrationModel
from tumortrack.sense.cloud import thin_cloud
from tumortrack.sense.files import read_cloud
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool
from tumortrack.simulate.scene import RenderedScene, SceneConfig, SceneRecipe, Simulator
from tumortrack.training.model import load_model, save_model
from tumortrack.training.state import TrainingRun
from tumortrack.training.train import TrainingStatus, train
from tumortrack_lab.bench.occupancy import OccupancyForms
from tumortrack_lab.bench.registration import RegistrationForms
from tumortrack_lab.bench.rows import PRESETS, Workload

_PER_SIDE = 600  # points in and outside of each part in a step
_RATE = 1.5e-3
_SETTLED = 30  # passes that a norm's statistics take
_LATENT_SHARE = 0.01  # latents that mean nothing are large: in full they would drown the queries
UP = (0.0, -1.0, 0.0)
SEED = 0
LABELLING = ("quick", "paper")  # the presets that label points
_STEPS = {"clinic": 240, "quick": 500, "paper": 300}  # about a minute on two cores each
_VALIDATED = 16  # scenes
_VOXEL_MM = 1.5  # of the phantom


@dataclass(eq=False)
class BenchSubject:
    """``presets``: configurations by name; ``folder``: where trained models are kept; ``given``: a
    user's own model and a cloud that shows its organ, which take the place of its preset's."""

    presets: Mapping[str, Callable[..., TrainConfig]]  # of an anatomy
    folder: Path
    given: tuple[Path, Path] | None = None

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=_VOXEL_MM))[0]

    @cached_property
    def body(self) -> ElasticBody:
        """The phantom's elastic body: the clinic model's."""
        model = self.model("clinic")
        assert isinstance(model, RegistrationModel)
        return model.shape.body

    @cached_property
    def scene(self) -> RenderedScene:
        """A scene of the phantom, dragged, without the sensor's faults."""
        config = SceneConfig(deform=(DragConfig(),))
        return Simulator(self.anatomy, UP, config).render(SceneRecipe(SEED, "test", 0))

    def model(self, preset: str) -> Model:
        """The trained or given model of a preset, on the CPU. Raises ArtifactError: there is no
        whole model of this version."""
        return _loaded(self.model_folder(preset))

    def cloud(self, preset: str) -> SensorCloud:
        """1,000 points that the preset's model is asked about: of the given cloud, or of a view of
        ``scene``."""
        given = self.given is not None and preset == self._given_preset
        seen = read_cloud(self.given[1])[0] if self.given and given else self.scene.cloud
        return thin_cloud(seen, 1000, np.random.default_rng(SEED))

    @cache  # noqa: B019 (a subject lives as long as its process)
    def forms(self, preset: str) -> OccupancyForms | RegistrationForms:
        """One for all groups of rows, whose naive form then labels its queries once."""
        model, cloud = self.model(preset), self.cloud(preset)
        if isinstance(model, RegistrationModel):
            return RegistrationForms(model, cloud)
        assert isinstance(model, OccupancyModel)
        return OccupancyForms(preset, model, cloud.points_mm)

    def model_folder(self, preset: str) -> Path:
        if self.given is not None and preset == self._given_preset:
            return self.given[0]
        return self.folder / preset

    @cached_property
    def _given_preset(self) -> str | None:
        """Of the given model: by its kind of network, and the size of what it encodes to. Raises
        InputError: its network is that of no preset."""
        if self.given is None:
            return None
        encoder = _loaded(self.given[0]).config.network.encoder
        for preset in PRESETS:
            like = self.presets[preset](self.anatomy).network.encoder
            if type(like) is type(encoder) and like.latent_size == encoder.latent_size:
                return preset
        raise InputError(f"{self.given[0]}: its network is none of {', '.join(PRESETS)}.")

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
        folder, config = self.model_folder(preset), self.presets[preset](self.anatomy)
        shutil.rmtree(folder, ignore_errors=True)
        if preset == "paper":
            _overfit(self, config, folder)
            return
        name = hashlib.sha256(b"the bench's phantom").hexdigest()
        short = replace(config, validation_pairs=_VALIDATED)
        run = TrainingRun(self.anatomy, UP, name, short, SEED, steps=_STEPS[preset], device="cpu")
        train(run, folder, report)


_loaded = cache(partial(load_model, device="cpu"))


def _workloads(kind: str, subject: BenchSubject, _: float) -> Iterator[Workload]:
    presets = {"encoders": (*LABELLING, "clinic"), "decoders": LABELLING}
    for preset in presets.get(kind, PRESETS):
        yield from getattr(subject.forms(preset), kind)()


encoders, decoders, frames, tracking, volumes = (
    partial(_workloads, kind) for kind in ("encoders", "decoders", "frames", "tracking", "volumes")
)


def _overfit(subject: BenchSubject, config: TrainConfig, folder: Path) -> None:
    """Write a model folder whose network labels points of the subject's scene."""
    anatomy, scene, cloud = subject.anatomy, subject.scene, subject.cloud("paper")
    steps, pool = _STEPS["paper"], OccupancyPool(anatomy, OccupancyConfig(per_side=_PER_SIDE), 0)
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    network = OccupancyNetwork(config.network)
    encoder, decoder = network.encoder, network.decoder
    points, size = torch.tensor(cloud.points_mm)[None], config.network.encoder.latent_size
    # With columns for the latent: no other is so wide.
    wide = [w for n, w in decoder.named_parameters() if w.dim() == 2 and w.shape[1] > size]
    with torch.no_grad():
        encoder.train()
        for _ in range(_SETTLED):
            network.encode(points)
        encoder.eval()
        for weight in wide:
            weight[:, -size:] *= _LATENT_SHARE
        latent = network.encode(points)
    optimizer = torch.optim.Adam(decoder.parameters(), _RATE)
    decay = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / steps))
    )
    fast = has_fast_bfloat16(torch.device("cpu"))
    decoder.train()
    for _ in range(steps):
        points_ct, labels = pool.draw(rng)
        places = torch.from_numpy(scene.carry(points_ct).astype(np.float32))[None]
        queries = (places - latent.centre_mm) / latent.scale_mm
        with torch.autocast("cpu", torch.bfloat16, enabled=fast):
            logits = decoder(decoder.prepare(latent.vector), queries)
        loss = cross_entropy(logits[0].float(), torch.from_numpy(labels).long())
        optimizer.zero_grad()
        loss.backward()
        for weight in wide:
            assert weight.grad is not None
            weight.grad[:, -size:] = 0.0
        optimizer.step()
        decay.step()
    organ = scene.carry(anatomy.organ.vertices_mm) - np.median(cloud.points_mm, axis=0)
    folder.mkdir(parents=True, exist_ok=True)
    model = OccupancyModel(
        network=network.eval(), config=config, parts=anatomy.names,
        query_box_mm=np.array([organ.min(0), organ.max(0)], float),
        in_distribution=InDistributionRange(spread_mm=(0.1, 1e3), fit_mm=100),  # widest allowed
        provenance={"steps": steps, "loss": round(float(loss.detach()), 4), "scenes": 1},
    )  # fmt: skip
    save_model(model, folder)
