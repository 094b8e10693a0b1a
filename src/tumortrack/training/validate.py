"""How good a network is on scenes it does not train on, and where organs lie in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from tumortrack.core.errors import NoEstimate
from tumortrack.models.config import TrainConfig
from tumortrack.models.in_distribution import (
    FIT_STEPS,
    InDistributionRange,
    fit_mm,
    spread_mm,
    surface_distances,
)
from tumortrack.occupancy.lattice import lattice_over
from tumortrack.occupancy.network import Latent, OccupancyNetwork
from tumortrack.simulate.dataset import refill
from tumortrack.simulate.occupancy import PartPool
from tumortrack.simulate.scene import SceneRecipe, Simulator

_AT_ONCE = 32  # scenes
_FIT_ON = 32  # scenes
_QUERIES = 2**13  # at once: bounds the memory


@dataclass(frozen=True, eq=False)
class ValidationScenes:
    """Scenes of the ``validation`` stream with points spread evenly over the organ's enlarged
    box, so that shares of points are volumes; camera frame, mm.

    ``boxes_mm``: the organ's, relative to the median of the observed points.
    """

    clouds_mm: Float32[np.ndarray, "s n 3"]
    points_ct: Float32[np.ndarray, "s q 3"]
    points_mm: Float32[np.ndarray, "s q 3"]
    labels: UInt8[np.ndarray, "s q"]
    boxes_mm: Float64[np.ndarray, "s 2 3"]

    @property
    def query_box_mm(self) -> Float64[np.ndarray, "2 3"]:
        """Where the organ can lie, relative to the median of the observed points."""
        return _grown(self.boxes_mm)


def validation_scenes(
    simulator: Simulator, pool: PartPool, config: TrainConfig, seed: int
) -> ValidationScenes:
    """The first scenes of the ``validation`` stream."""
    vertices = simulator.anatomy_ct.organ.vertices_mm
    n = config.scene.cloud.n_points
    rows = []
    for index in range(config.validation_pairs):
        recipe = SceneRecipe(seed, "validation", index)
        stage = simulator.render(recipe)
        drawn, answer = pool.draw_evenly(recipe.generator(999), config.validation_points)
        observed = stage.cloud.points_mm
        organ = stage.carry(vertices) - np.median(observed, axis=0)
        box = np.array([organ.min(0), organ.max(0)], float)
        rows.append((refill(observed, n), drawn, stage.carry(drawn), answer, box))
    return ValidationScenes(*(np.stack(column) for column in zip(*rows, strict=True)))


def mean_iou_of(
    guess: UInt8[np.ndarray, ...], labels: UInt8[np.ndarray, ...], n_classes: int
) -> float:
    """Mean over the parts (organ, tumors; not the outside) of the IoU over all points."""
    pairs = guess.astype(np.int64).ravel() * n_classes + labels.ravel()
    table = np.bincount(pairs, minlength=n_classes**2).reshape(n_classes, n_classes)
    both = table.diagonal()
    either = table.sum(0) + table.sum(1) - both
    return float((both / np.maximum(either, 1))[1:].mean())


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
            around = _grown(box_mm[None] + np.median(points_mm, axis=0))

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


def _grown(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The box of all the boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
