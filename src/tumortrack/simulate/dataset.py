"""An endless, addressable stream of training batches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Num, UInt8

from tumortrack.core.types import Anatomy
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import PointSource
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator


class Batch(NamedTuple):
    """Scenes stacked; camera frame, mm."""

    clouds_mm: Float32[np.ndarray, "b n 3"]
    points_mm: Float32[np.ndarray, "b q 3"]
    labels: UInt8[np.ndarray, "b q"]
    camera_from_ct: Float32[np.ndarray, "b 4 4"]


@dataclass(frozen=True, eq=False)
class SceneStream:
    """Batch ``i`` holds the recipes ``i * size ... i * size + size - 1``, so that worker processes
    and resumed runs see the same data. Picklable."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    config: SceneConfig
    pool: PointSource
    seed: int
    stream: Literal["train", "validation", "test"]
    batch_size: int
    body: ElasticBody | None = None  # built once by the caller, for elastic deformations

    @cached_property
    def simulator(self) -> Simulator:
        """Built where it is used: ray trees cannot be pickled."""
        return Simulator(self.anatomy_ct, self.up_lps, self.config, self.body)

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "simulator"}

    def batch(self, index: int) -> Batch:
        """The batch with this number."""
        first = index * self.batch_size
        pairs = [
            self.simulator.pair(SceneRecipe(self.seed, self.stream, i), self.pool)
            for i in range(first, first + self.batch_size)
        ]
        n = self.config.cloud.n_points
        return Batch(
            np.stack([refill(scene.cloud.points_mm, n) for scene, _ in pairs]),
            np.stack([samples.points_mm for _, samples in pairs]),
            np.stack([samples.labels for _, samples in pairs]),
            np.stack([scene.camera_from_ct for scene, _ in pairs]).astype(np.float32),
        )


def refill(points_mm: Num[np.ndarray, m * row], n: int) -> Num[np.ndarray, n * row]:
    """A cloud of fewer than ``n`` points repeats them, so that clouds stack; max pooling is not
    affected."""
    return points_mm[np.arange(n) % len(points_mm)]
