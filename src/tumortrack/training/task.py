"""What training asks of a method, and the validation scenes that both methods share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from tumortrack.models.config import TrainConfig
from tumortrack.models.in_distribution import InDistributionRange
from tumortrack.models.model import Model
from tumortrack.simulate.dataset import refill
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import PartPool, PointSource, organ_pool
from tumortrack.simulate.scene import SceneRecipe, Simulator, body_for
from tumortrack.training.run import TrainingRun


class TrainingTask(ABC):
    """What a method learns, how it is validated, and the model it leaves; a class per method.

    Attributes:
        points: those of the training scenes.
        body: the organ's, where scenes or model need it.
    """

    points: PointSource
    body: ElasticBody | None

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self._run, self._device = run, device
        self.body = body_for(run.anatomy_ct, run.up_lps, run.config.scene, run.seed)

    @abstractmethod
    def initialize(self, network: Any) -> None:
        """Give a fresh network what does not have to be learnt."""

    @abstractmethod
    def miou(self, network: Any) -> float:
        """On the validation scenes."""

    @abstractmethod
    def model(self, network: Any, provenance: dict[str, Any]) -> Model:
        """The finished model of the network."""

    @cached_property
    def _scenes(self) -> ValidationScenes:
        run = self._run
        simulator = Simulator(run.anatomy_ct, run.up_lps, run.config.scene, self.body)
        return validation_scenes(simulator, self._pool(), run.config, run.seed)

    def _pool(self) -> PartPool:
        """Points about the organ, to validate on."""
        return organ_pool(self._run.anatomy_ct, self._run.config.scene.occupancy, self._run.seed)

    def _fields(
        self,
        network: Any,
        provenance: dict[str, Any],
        spreads_mm: Sequence[float],
        fits_mm: Sequence[float],
    ) -> dict[str, Any]:
        """What models of both methods hold; of validation scenes, how far their points spread and
        how far they lie from the surface that was found."""
        known = InDistributionRange(
            spread_mm=(min(spreads_mm), max(spreads_mm)),
            fit_mm=float(np.percentile(fits_mm, 95)),
        )
        return {
            "network": network,
            "config": self._run.config,
            "parts": self._run.anatomy_ct.names,
            "query_box_mm": self._scenes.query_box_mm,
            "in_distribution": known,
            "provenance": provenance,
        }


@dataclass(frozen=True, eq=False)
class ValidationScenes:
    """Scenes of the ``validation`` stream with points spread evenly over the organ's enlarged
    box, so that numbers of points are volumes; camera frame, mm.

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
        return grown_box(self.boxes_mm)


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


def grown_box(boxes_mm: Float64[np.ndarray, "s 2 3"]) -> Float64[np.ndarray, "2 3"]:
    """The box of all the boxes, 10 % larger."""
    lower, upper = boxes_mm[:, 0].min(0), boxes_mm[:, 1].max(0)
    return np.stack([lower - 0.05 * (upper - lower), upper + 0.05 * (upper - lower)])
