"""Training an occupancy network: labels of points near surfaces, validated by their IoU."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from tumortrack.core.errors import NoEstimate
from tumortrack.models.in_distribution import fit_mm, spread_mm
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.occupancy.volume import FIT_STEPS, lattice_over, surface_distances
from tumortrack.simulate.occupancy import OccupancyPool, PartPool
from tumortrack.training.run import TrainingRun
from tumortrack.training.task import TrainingTask, ValidationScenes, grown_box, mean_iou_of

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


class OccupancyTask(TrainingTask):
    """Labels of points near surfaces, as in the paper."""

    points: OccupancyPool

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        super().__init__(run, device)

    def _pool(self) -> PartPool:
        return self.points.parts[0]

    def initialize(self, network: OccupancyNetwork) -> None:
        """An occupancy network knows nothing at first."""

    def miou(self, network: OccupancyNetwork) -> float:
        return label_miou(network, self._scenes, len(self._run.anatomy_ct.parts) + 1, self._device)

    @torch.no_grad()
    def model(self, network: OccupancyNetwork, provenance: dict[str, Any]) -> OccupancyModel:
        network.eval()
        spreads, fits = [], []
        scenes = self._scenes
        for points_mm, box_mm in zip(scenes.clouds_mm[:_FIT_ON], scenes.boxes_mm, strict=False):
            latent = network.encode(torch.from_numpy(points_mm).to(self._device)[None])
            around = grown_box(box_mm[None] + np.median(points_mm, axis=0))
            spreads.append(spread_mm(points_mm))
            try:
                lattice = lattice_over(partial(self._logits, network, latent), around, FIT_STEPS)
                fits.append(fit_mm(surface_distances(lattice, points_mm)))
            except NoEstimate:  # after a few steps a network finds no organ
                fits.append(spreads[-1])
        return OccupancyModel(**self._fields(network, provenance, spreads, fits))

    def _logits(
        self, network: OccupancyNetwork, latent: Latent, queries_mm: np.ndarray
    ) -> torch.Tensor:
        parts = torch.from_numpy(queries_mm).to(self._device)[None].split(_QUERIES, dim=1)
        return torch.cat([network.query(latent, part)[0] for part in parts])


@torch.no_grad()
def label_miou(
    network: OccupancyNetwork, scenes: ValidationScenes, n_classes: int, device: torch.device
) -> float:
    """``mean_iou_of`` the network's labels."""
    network.eval()
    clouds, points = (torch.from_numpy(v).to(device) for v in (scenes.clouds_mm, scenes.points_mm))
    pairs = zip(clouds.split(_AT_ONCE), points.split(_AT_ONCE), strict=True)
    guess = torch.cat([network(*pair).argmax(-1) for pair in pairs])
    return mean_iou_of(guess.to(torch.uint8).cpu().numpy(), scenes.labels, n_classes)
