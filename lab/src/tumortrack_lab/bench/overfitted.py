"""An overfitted scene: a network for figures that need sure labels, not good ones.

The paper's network learns for hours; where its labels are compared, or the surface of its volume
decides the time, one that is as sure of a single scene serves, and a minute makes it. Its encoder
stays as it was drawn, and so do the weights on the latent; the rest of the decoder learns.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.models.config import TrainConfig
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool
from tumortrack.simulate.scene import RenderedScene
from tumortrack.training.model import save_model

_PER_SIDE = 600  # points in and outside of each part in a step
_RATE = 1.5e-3
_SETTLED = 30  # passes that a norm's statistics take
_LATENT_SHARE = 0.01  # latents that mean nothing are large: in full they would drown the queries


def overfit_scene(
    anatomy: Anatomy,
    seen: tuple[RenderedScene, SensorCloud],
    config: TrainConfig,
    folder: Path,
    steps: int,
) -> None:
    """Write a model folder whose network labels points of one scene, seen as this cloud."""
    scene, cloud = seen
    pool = OccupancyPool(anatomy, OccupancyConfig(per_side=_PER_SIDE), 0)
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    network = OccupancyNetwork(config.network)
    points = torch.tensor(cloud.points_mm)[None]
    fixed = _settled(network, points)
    optimizer = torch.optim.Adam(network.decoder.parameters(), _RATE)
    decay = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / steps))
    )
    with torch.no_grad():
        latent = network.encode(points)
    fast = has_fast_bfloat16(torch.device("cpu"))
    network.decoder.train()
    for _ in range(steps):
        points_ct, labels = pool.draw(rng)
        places = torch.from_numpy(scene.carry(points_ct).astype(np.float32))[None]
        queries = (places - latent.centre_mm) / latent.scale_mm
        with torch.autocast("cpu", torch.bfloat16, enabled=fast):
            logits = network.decoder(network.decoder.prepare(latent.vector), queries)
        loss = cross_entropy(logits[0].float(), torch.from_numpy(labels).long())
        optimizer.zero_grad()
        loss.backward()
        for weight in fixed:
            assert weight.grad is not None
            weight.grad[:, -latent.vector.shape[1] :] = 0.0
        optimizer.step()
        decay.step()
    every = InDistributionRange(spread_mm=(0.0, 1e3), fit_mm=1e3)  # nothing is refused
    about = {"steps": steps, "loss": round(float(loss.detach()), 4), "scenes": 1}
    folder.mkdir(parents=True, exist_ok=True)
    organ = scene.carry(anatomy.organ.vertices_mm) - np.median(cloud.points_mm, axis=0)
    box = np.array([organ.min(0), organ.max(0)], float)
    model = OccupancyModel(
        network=network.eval(), config=config, parts=anatomy.names, query_box_mm=box,
        in_distribution=every, provenance=about,
    )  # fmt: skip
    save_model(model, folder)


def _settled(network: OccupancyNetwork, cloud: Tensor) -> list[Tensor]:
    """Statistics of the encoder's norms from the cloud, small weights on the latent; returns the
    decoder's weights that hold them."""
    latent = network.config.encoder.latent_size
    weights: list[Tensor] = [
        weight
        for name, weight in network.decoder.named_parameters()
        # With columns for the latent: no other is so wide.
        if name.endswith("weight") and weight.dim() == 2 and weight.shape[1] > latent
    ]
    with torch.no_grad():
        network.encoder.train()
        for _ in range(_SETTLED):
            network.encode(cloud)
        for weight in weights:
            weight[:, -latent:] *= _LATENT_SHARE
    network.encoder.eval()
    return weights
