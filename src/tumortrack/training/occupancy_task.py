"""Training an occupancy network: labels of points near surfaces, validated by their IoU."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import torch

from tumortrack.core.errors import NoEstimate
from tumortrack.models.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.occupancy.volume import FIT_STEPS, lattice_over, surface_distances
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import Simulator, body_for
from tumortrack.training.run import TrainingRun
from tumortrack.training.task import ValidationScenes, grown_box, mean_iou_of, validation_scenes

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


class OccupancyTask:
    """Labels of points near surfaces, as in the paper."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @cached_property
    def _scenes(self) -> ValidationScenes:
        run = self._run
        simulator = Simulator(run.anatomy_ct, run.up_lps, run.config.scene, self.body)
        return validation_scenes(simulator, self.points.parts[0], run.config, run.seed)

    def initialize(self, network: OccupancyNetwork) -> None:
        """An occupancy network knows nothing at first."""

    def miou(self, network: OccupancyNetwork) -> float:
        return label_miou(network, self._scenes, len(self._run.anatomy_ct.parts) + 1, self._device)

    def model(self, network: OccupancyNetwork, provenance: dict[str, Any]) -> OccupancyModel:
        return OccupancyModel(
            network=network,
            config=self._run.config,
            parts=self._run.anatomy_ct.names,
            query_box_mm=self._scenes.query_box_mm,
            in_distribution=self._in_distribution(network),
            provenance=provenance,
        )

    @torch.no_grad()
    def _in_distribution(self, network: OccupancyNetwork) -> InDistributionRange:
        """How far the clouds spread, and how far they lie from the network's surface."""
        network.eval()
        spreads, fits = [], []
        scenes = self._scenes
        for points_mm, box_mm in zip(scenes.clouds_mm[:_FIT_ON], scenes.boxes_mm, strict=False):
            latent = network.encode(torch.from_numpy(points_mm).to(self._device)[None])
            around = grown_box(box_mm[None] + np.median(points_mm, axis=0))

            def logits_at(queries_mm: np.ndarray, latent: Latent = latent) -> torch.Tensor:
                queries = torch.from_numpy(queries_mm).to(self._device)[None]
                parts = queries.split(_QUERIES, dim=1)
                return torch.cat([network.query(latent, part)[0] for part in parts])

            spreads.append(spread_mm(points_mm))
            try:
                lattice = lattice_over(logits_at, around, FIT_STEPS)
                fits.append(fit_mm(surface_distances(lattice, points_mm)))
            except NoEstimate:  # after a few steps a network finds no organ
                fits.append(spreads[-1])
        return InDistributionRange(
            spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(fits, 95))
        )


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
