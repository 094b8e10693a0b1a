"""The test subject: the built-in phantom, a scene of it, and models of it, kept in a folder.

Labels of an untrained network mean nothing and their volume has no surface, and the paper's network
learns for hours. One that is as sure of a single scene serves: its encoder stays as it was drawn,
and so do the weights on the latent; the rest of the decoder learns, for a minute.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import cross_entropy

from tumortrack.core.errors import ArtifactError
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.imaging.surface import surfaces
from tumortrack.models.folder import save_model
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.model import Model
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.registration.build import build_model
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.presets import clinic
from tumortrack.sense.cloud import thin_cloud
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.scene import (
    OccupancyConfig,
    RenderedScene,
    SceneConfig,
    SceneRecipe,
    Simulator,
)
from tumortrack.tracking.model_files import load_model
from tumortrack_lab.bench.occupancy import OccupancyForms
from tumortrack_lab.bench.registration import RegistrationForms
from tumortrack_lab.bench.rows import PRESETS, Workload
from tumortrack_occupancy.hardware import has_fast_bfloat16
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.network import OccupancyNetwork
from tumortrack_occupancy.presets import paper
from tumortrack_occupancy.training.query_points import OccupancyPool

_PER_SIDE = 600  # points in and outside of each part in a step
_RATE = 1.5e-3
_SETTLED = 30  # passes that a norm's statistics take
_LATENT_SHARE = 0.01  # latents that mean nothing are large: in full they would drown the queries
_STEPS = 300  # about a minute on two cores
_VOXEL_MM = 1.5  # of the phantom
UP = (0.0, -1.0, 0.0)
SEED = 0


@dataclass(eq=False)
class BenchSubject:
    """``folder``: where models are kept."""

    folder: Path

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=_VOXEL_MM))[0]

    @cached_property
    def scene(self) -> RenderedScene:
        """A scene of the phantom, dragged, without the sensor's faults."""
        config = SceneConfig(deform=(DragConfig(),))
        return Simulator(self.anatomy, UP, config).render(SceneRecipe(SEED, "test", 0))

    @cached_property
    def cloud(self) -> SensorCloud:
        """1,000 points of a view of ``scene``."""
        return thin_cloud(self.scene.cloud, 1000, np.random.default_rng(SEED))

    def model(self, preset: str) -> Model:
        """The model of a preset, on the CPU. Raises ArtifactError: there is no whole model of this
        version."""
        return _loaded(self.model_folder(preset))

    @cache  # noqa: B019 (a subject lives as long as its process)
    def forms(self, preset: str) -> OccupancyForms | RegistrationForms:
        """One for all groups of rows, whose naive form then labels its queries once."""
        model = self.model(preset)
        if isinstance(model, RegistrationModel):
            return RegistrationForms(model, self.cloud)
        assert isinstance(model, OccupancyModel)
        return OccupancyForms(model, self.cloud.points_mm)

    def model_folder(self, preset: str) -> Path:
        return self.folder / preset

    def has(self, preset: str) -> bool:
        """Whether there is a whole model of this version."""
        try:
            self.model(preset)
        except ArtifactError:
            return False
        return True

    def make(self, preset: str, progress: Callable[[int, int], None]) -> None:
        """Write the preset's model into its folder."""
        about = self.anatomy, UP, clinic(self.anatomy), SEED
        network = preset == "paper"
        made = _overfit(self, progress) if network else build_model(*about, progress=progress)
        shutil.rmtree(self.model_folder(preset), ignore_errors=True)
        self.model_folder(preset).mkdir(parents=True)
        save_model(made, self.model_folder(preset))


_loaded = cache(partial(load_model, device="cpu"))


def _workloads(kind: str, subject: BenchSubject, _: float) -> Iterator[Workload]:
    for preset in PRESETS:
        yield from getattr(subject.forms(preset), kind)()


frames, tracking, volumes = (partial(_workloads, one) for one in ("frames", "tracking", "volumes"))


def _overfit(subject: BenchSubject, progress: Callable[[int, int], None]) -> OccupancyModel:
    """The paper's network, which labels points of the subject's scene."""
    anatomy, scene, cloud = subject.anatomy, subject.scene, subject.cloud
    config, pool = paper(anatomy), OccupancyPool(anatomy, OccupancyConfig(per_side=_PER_SIDE), 0)
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
        optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / _STEPS))
    )
    fast = has_fast_bfloat16(torch.device("cpu"))
    decoder.train()
    for step in range(_STEPS):
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
        progress(step + 1, _STEPS)
    organ = scene.carry(anatomy.organ.vertices_mm) - np.median(cloud.points_mm, axis=0)
    return OccupancyModel(
        network=network.eval(), config=config, parts=anatomy.names,
        query_box_mm=np.array([organ.min(0), organ.max(0)], float),
        in_distribution=InDistributionRange(spread_mm=(0.1, 1e3), fit_mm=100),  # widest allowed
        provenance={"steps": _STEPS, "loss": round(float(loss.detach()), 4), "scenes": 1},
    )  # fmt: skip
