"""Logits on a coarse lattice, linear between its points: the cheap first view of an answer."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from tumortrack.core.types import OUTSIDE

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
        from tumortrack.occupancy.kernels import between

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


def organ_lattice(
    logits_at: LogitsAt, box_mm: Float[np.ndarray, "2 3"], steps: int
) -> LogitLattice:
    """``lattice_over``, asked everywhere inside of the organ and a point or two about it.

    Every second point along each axis is asked first, then all within two of one that lies
    inside, then all about those that turn out to lie inside, until none is left. The others are
    linear between the first ones, all of them outside. Whatever hangs together with a part that
    holds one of the first points is met as if all were asked; what lies apart and between them is
    not, and would be dropped (``models.volume.keep_largest_pieces``).
    """
    from tumortrack.occupancy.kernels import halved, neighbours

    coarse = lattice_over(logits_at, box_mm, -(-steps // 2))
    i, j, k = (2 * n - 1 for n in coarse.logits.shape[:3])
    shape, step_mm = (i, j, k), coarse.step_mm / 2
    logits = np.empty((*shape, coarse.logits.shape[3]), np.float32)
    halved(coarse.logits, logits, 0, len(logits))
    rows = logits.reshape(-1, logits.shape[3])
    known = np.zeros(shape, bool)
    known[::2, ::2, ::2] = True
    flat = np.arange(math.prod(shape)).reshape(shape)[::2, ::2, ::2].ravel()
    known = known.ravel()
    first = neighbours(shape, _inside(flat, rows), known)
    asked = np.concatenate([first, neighbours(shape, first, known)])
    while len(asked):
        place = np.stack(np.unravel_index(asked, shape), axis=1) * step_mm + coarse.origin_mm
        rows[asked] = logits_at(place.astype(np.float32)).float().cpu().numpy()
        asked = neighbours(shape, _inside(asked, rows), known)
    return LogitLattice(coarse.origin_mm, step_mm, logits)


def leaves(lattice: LogitLattice) -> bool:
    """Whether the organ, the largest piece of what lies inside, reaches the border of a lattice, or
    is not in it at all."""
    from scipy import ndimage

    pieces, count = ndimage.label(lattice.logits.argmax(-1) != OUTSIDE)
    if not count:
        return True
    sizes = np.bincount(pieces.ravel())
    largest = 1 + int(sizes[1:].argmax())
    return bool(sizes[largest] > (pieces[1:-1, 1:-1, 1:-1] == largest).sum())


def _inside(flat: np.ndarray, rows: Float32[np.ndarray, "n classes"]) -> np.ndarray:
    return flat[rows[flat].argmax(1) != OUTSIDE]
