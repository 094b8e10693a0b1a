"""Scenes with labelled points, and the batches that a training sees."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Num, UInt8

from tumortrack.core.types import Anatomy
from tumortrack.organ.body import ElasticBody
from tumortrack.simulation.scene import RenderedScene, SceneConfig, SceneRecipe, Simulator
from tumortrack_occupancy.training.query_points import OccupancyPool


def labelled_scene(
    simulator: Simulator, recipe: SceneRecipe, pool: OccupancyPool
) -> tuple[RenderedScene, Float32[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
    """The scene, its points (camera frame, mm) and their labels."""
    scene, rng = simulator.draw(recipe)
    points_ct, labels = pool.draw(rng)
    return scene, scene.forward(points_ct).astype(np.float32, copy=False), labels


class Batch(NamedTuple):
    """Scenes stacked; camera frame, mm."""

    clouds_mm: Float32[np.ndarray, "b n 3"]
    points_mm: Float32[np.ndarray, "b q 3"]
    labels: UInt8[np.ndarray, "b q"]


@dataclass(frozen=True, eq=False)
class SceneStream:
    """Batch ``i`` holds the recipes ``i * batch_size`` to ``(i + 1) * batch_size - 1``, so that
    worker processes and resumed runs see the same data. Picklable."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    config: SceneConfig
    pool: OccupancyPool
    seed: int
    stream: Literal["train", "validation", "test"]
    batch_size: int
    body: ElasticBody | None = None  # built once by the caller, for elastic deformations

    @cached_property
    def simulator(self) -> Simulator:
        """Built in the process that uses it: ray trees cannot be pickled."""
        return Simulator(self.anatomy_ct, self.up_lps, self.config, self.body)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "simulator"}

    def batch(self, index: int) -> Batch:
        first, n = index * self.batch_size, self.config.cloud.n_points
        rows = []
        for number in range(first, first + self.batch_size):
            recipe = SceneRecipe(self.seed, self.stream, number)
            scene, points_mm, labels = labelled_scene(self.simulator, recipe, self.pool)
            cloud_mm = refill(scene.cloud.points_mm, n)
            rows.append((cloud_mm, points_mm, labels))
        return Batch(*map(np.stack, zip(*rows, strict=True)))


def refill(points_mm: Num[np.ndarray, m * row], n: int) -> Num[np.ndarray, n * row]:
    """``n`` points of a cloud, repeated if there are fewer, so that clouds stack; max pooling is
    not affected."""
    return points_mm[np.arange(n) % len(points_mm)]
