"""Training an occupancy network: labels of points about surfaces, judged by their IoU."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from tumortrack.core.errors import NoEstimate
from tumortrack.models.in_distribution import InDistributionRange, fit_mm, spread_mm
from tumortrack.occupancy.lattice import lattice_over
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.occupancy.volume import FIT_STEPS, surface_distances
from tumortrack.simulate.occupancy import OccupancyPool
from tumortrack.simulate.scene import Simulator, body_for
from tumortrack.training.run import TrainingRun
from tumortrack.training.validate import ValidationScenes, grown_box, mean_iou_of, validation_scenes

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


class OccupancyTask:
    """Labels of points about surfaces, in the paper's way."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.points = OccupancyPool(run.anatomy_ct, run.config.scene.occupancy, run.seed)
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @cached_property
    def _scenes(self) -> ValidationScenes:
        run = self._run
        simulator = Simulator(run.anatomy_ct, run.up_lps, run.config.scene, self.body)
        return validation_scenes(simulator, self.points.parts[0], run.config, run.seed)

    @cached_property
    def _validation(self) -> ValidationSet:
        return ValidationSet(self._scenes, len(self._run.anatomy_ct.parts) + 1, self._device)

    def teach(self, network: OccupancyNetwork) -> None:
        """An occupancy network starts with nothing."""

    def miou(self, network: OccupancyNetwork) -> float:
        return self._validation.miou(network)

    def model(self, network: OccupancyNetwork, provenance: dict) -> OccupancyModel:
        return OccupancyModel(
            network=network,
            config=self._run.config,
            parts=self._run.anatomy_ct.names,
            query_box_mm=self._scenes.query_box_mm,
            familiar=self._validation.familiar(network),
            provenance=provenance,
        )


class ValidationSet:
    """How good an occupancy network is on validation scenes."""

    def __init__(self, scenes: ValidationScenes, n_classes: int, device: torch.device) -> None:
        self._labels, self._n_classes, self._boxes_mm = scenes.labels, n_classes, scenes.boxes_mm
        self._clouds = torch.from_numpy(scenes.clouds_mm).to(device)
        self._points = torch.from_numpy(scenes.points_mm).to(device)

    @torch.no_grad()
    def miou(self, network: OccupancyNetwork) -> float:
        """``mean_iou_of`` the network's labels."""
        network.eval()
        guesses = []
        for i in range(0, len(self._clouds), _AT_ONCE):
            latent = network.encode(self._clouds[i : i + _AT_ONCE])
            guesses.append(network.query(latent, self._points[i : i + _AT_ONCE]).argmax(-1))
        guess = torch.cat(guesses).to(torch.uint8).cpu().numpy()
        return mean_iou_of(guess, self._labels, self._n_classes)

    @torch.no_grad()
    def familiar(self, network: OccupancyNetwork) -> InDistributionRange:
        """What the clouds are like, and how far they lie from the surfaces that a network sees."""
        network.eval()
        spreads, fits = [], []
        for cloud, box_mm in zip(self._clouds[:_FIT_ON], self._boxes_mm, strict=False):
            latent = network.encode(cloud[None])
            points_mm = cloud.cpu().numpy()
            around = grown_box(box_mm[None] + np.median(points_mm, axis=0))

            def logits_at(queries_mm: np.ndarray, latent: Latent = latent) -> torch.Tensor:
                queries = torch.from_numpy(queries_mm).to(self._clouds.device)[None]
                parts = queries.split(_QUERIES, dim=1)
                return torch.cat([network.query(latent, part)[0] for part in parts])

            spreads.append(spread_mm(points_mm))
            try:
                lattice = lattice_over(logits_at, around, FIT_STEPS)
                fits.append(fit_mm(surface_distances(lattice, points_mm)))
            except NoEstimate:  # a network of a few steps sees no organ
                fits.append(spreads[-1])
        return InDistributionRange(
            spread_mm=(min(spreads), max(spreads)), fit_mm=float(np.percentile(fits, 95))
        )
