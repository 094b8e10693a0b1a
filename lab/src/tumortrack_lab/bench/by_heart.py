"""A network that knows one scene by heart: for figures that need sure labels, not good ones.

The paper's network learns for hours; where its labels are compared, or the surface of its volume
decides the time, one that is as sure of a single scene serves, and a minute makes it. Its encoder
stays as it was drawn, and so do the weights on what it says; the rest of the decoder learns.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

    from tumortrack.core.types import Anatomy, SensorCloud
    from tumortrack.models.config import TrainConfig
    from tumortrack.occupancy.network import OccupancyNetwork
    from tumortrack.simulate.scene import RenderedScene

_PER_SIDE = 600  # points in and outside of each part in a step
_RATE = 1.5e-3
_SETTLED = 30  # passes that a norm's statistics take
_LATENT_SHARE = 0.01  # latents that mean nothing are large: in full they would drown the queries


def learn_scene(
    anatomy: Anatomy,
    scene: tuple[RenderedScene, SensorCloud],
    config: TrainConfig,
    folder: Path,
    steps: int,
) -> None:
    """Write a model folder whose network labels points of one scene, seen as this cloud."""
    stage, cloud = scene
    import torch
    from torch.nn.functional import cross_entropy

    from tumortrack.models.hardware import has_fast_bfloat16
    from tumortrack.models.in_distribution import InDistributionRange
    from tumortrack.occupancy.model import OccupancyModel
    from tumortrack.occupancy.network import OccupancyNetwork
    from tumortrack.simulate.occupancy import OccupancyConfig, OccupancyPool
    from tumortrack.training.model import save_model

    pool = OccupancyPool(anatomy, OccupancyConfig(per_side=_PER_SIDE), 0)
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    network = OccupancyNetwork(config.network)
    seen = torch.tensor(cloud.points_mm)[None]
    fixed = _settled(network, seen)
    optimizer = torch.optim.Adam(network.decoder.parameters(), _RATE)
    decay = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: 0.5 * (1 + math.cos(math.pi * step / steps))
    )
    with torch.no_grad():
        latent = network.encode(seen)
    fast = has_fast_bfloat16(torch.device("cpu"))
    network.decoder.train()
    for _ in range(steps):
        points_ct, labels = pool.draw(rng)
        places = torch.from_numpy(stage.carry(points_ct).astype(np.float32))[None]
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
    organ = stage.carry(anatomy.organ.vertices_mm) - np.median(cloud.points_mm, axis=0)
    box = np.array([organ.min(0), organ.max(0)], float)
    save_model(
        OccupancyModel(
            network=network.eval(),
            config=config,
            parts=anatomy.names,
            query_box_mm=box,
            in_distribution=every,
            provenance=about,
        ),
        folder,
    )


def _settled(network: OccupancyNetwork, seen: Tensor) -> list[Tensor]:
    """Statistics of the encoder's norms from the cloud, small weights on what it says; returns the
    decoder's weights that hold them."""
    import torch

    weights: list[Tensor] = [
        weight
        for name, weight in network.decoder.named_parameters()
        if name.endswith("weight") and weight.dim() == 2 and _sees_latent(network, weight)
    ]
    with torch.no_grad():
        network.encoder.train()
        for _ in range(_SETTLED):
            network.encode(seen)
        for weight in weights:
            weight[:, -network.config.encoder.latent_size :] *= _LATENT_SHARE
    network.encoder.eval()
    return weights


def _sees_latent(network: OccupancyNetwork, weight: Tensor) -> bool:
    """Whether a layer's weights have columns for the latent: no other is so wide."""
    return weight.shape[1] > network.config.encoder.latent_size
