"""What training asks of a method, and the validation scenes that both methods share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from tumortrack.models.config import TrainConfig
from tumortrack.models.model import Model, Network
from tumortrack.simulate.dataset import refill
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import PartPool, PointSource
from tumortrack.simulate.scene import SceneRecipe, Simulator

N = TypeVar("N", bound=Network, contravariant=True)


@runtime_checkable
class TrainingTask(Protocol[N]):
    """What a method learns, how it is validated, and the model it leaves; a class per method."""

    @property
    def points(self) -> PointSource:
        """Those of the training scenes."""
        ...

    @property
    def body(self) -> ElasticBody | None:
        """The organ's, where scenes or model need it."""
        ...

    def initialize(self, network: N) -> None:
        """Give a fresh network what does not have to be learnt."""
        ...

    def miou(self, network: N) -> float:
        """On the validation scenes."""
        ...

    def model(self, network: N, provenance: dict[str, Any]) -> Model:
        """The finished model of the network."""
        ...


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
