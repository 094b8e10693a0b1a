"""Logits on a coarse lattice, linear between its points: the cheap first view of an answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, Float64

LogitsAt = Callable[[Float32[np.ndarray, "n 3"]], torch.Tensor]  # camera frame, mm -> (n, classes)


@dataclass(frozen=True, eq=False)
class LogitLattice:
    """Logits at origin + step * (i, j, k), camera frame, mm."""

    origin_mm: Float64[np.ndarray, " 3"]
    step_mm: float
    logits: Float32[np.ndarray, "i j k classes"]

    @property
    def box_mm(self) -> Float64[np.ndarray, "2 3"]:
        """From the first point to the last."""
        size = np.array(self.logits.shape[:3]) - 1
        return np.stack([self.origin_mm, self.origin_mm + self.step_mm * size])

    def between(self, points_mm: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n classes"]:
        """Logits at points, linear between those of the lattice; outside of it the border's."""
        from tumortrack.occupancy.lattice_kernels import between

        out = np.empty((len(points_mm), self.logits.shape[3]), np.float32)
        place = ((points_mm - self.origin_mm) / self.step_mm).astype(np.float32)
        between(self.logits, place, out)
        return out


def lattice_over(
    logits_at: LogitsAt, box_mm: Float64[np.ndarray, "2 3"], steps: int
) -> LogitLattice:
    """Ask on a lattice over a box, ``steps`` along its longest side."""
    step = float((box_mm[1] - box_mm[0]).max()) / steps
    axes = [np.arange(low, high + step, step) for low, high in box_mm.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
    logits = logits_at(grid.reshape(-1, 3)).float().cpu().numpy()
    return LogitLattice(box_mm[0].astype(float), step, logits.reshape(*grid.shape[:3], -1))
