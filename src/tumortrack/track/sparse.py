"""The dense answer from few questions: coarse first, then only where labels differ.

A lattice of at most ``START_MM`` is asked; cells between equal labels take them unasked, others
are halved, down to the voxels. Whatever was not asked and touches a differing label that was, is
asked after all, on every level: without that some voxels would be wrong.

What it may miss: a part of which no lattice point lies inside and that touches nothing which is
split. A ball of START_MM times the square root of 3, 5.2 mm, always holds a lattice point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float16, Float64, UInt8

from tumortrack.core.geometry import transform_points
from tumortrack.track.volume import LARGEST_MARGIN, dense_margins, margins_of

START_MM = 3.0
_AT_ONCE = 2**18  # queries


def sparse_margins(
    logits_at: Callable[[np.ndarray], torch.Tensor],
    camera_from_index: Float64[np.ndarray, "4 4"],
    shape: tuple[int, int, int],
    start_mm: float = START_MM,
) -> tuple[Float16[np.ndarray, "parts i j k"], UInt8[np.ndarray, "i j k"]]:
    """What ``dense_margins`` returns; far from all surfaces margins are the largest there are.

    Args:
        start_mm: distance of the first lattice's points at the most.
    """
    voxel_mm = float(camera_from_index[0, 0])
    levels = max(0, int(np.floor(np.log2(max(start_mm / voxel_mm, 1.0)))))
    if levels == 0:
        return dense_margins(logits_at, camera_from_index, shape)
    asked = _Asked(logits_at, camera_from_index)
    stride = 2**levels
    size = [
        (n - 2) // stride + 2 for n in shape
    ]  # the last point lies on the grid's end or past it
    labels = np.empty(size, np.uint8)
    known = np.ones(size, bool)
    labels.reshape(-1)[:] = asked.labels_of(np.arange(labels.size), labels.shape, stride)
    for _ in range(levels):
        stride //= 2
        labels, known = _halved(labels, known, asked, stride)
    i, j, k = shape
    found = np.ascontiguousarray(labels[:i, :j, :k])
    return asked.margins(found), found


def _halved(
    coarse: np.ndarray, known: np.ndarray, asked: _Asked, stride: int
) -> tuple[np.ndarray, np.ndarray]:
    from tumortrack.track.sparse_kernels import doubtful, refined

    shape = tuple(2 * n - 1 for n in coarse.shape)
    labels, now_known = np.empty(shape, np.uint8), np.empty(shape, bool)
    frontier = refined(coarse, known, labels, now_known)
    while len(frontier):
        labels.reshape(-1)[frontier] = asked.labels_of(frontier, shape, stride)
        now_known.reshape(-1)[frontier] = True
        frontier = doubtful(labels, now_known, frontier)
    return labels, now_known


@dataclass(eq=False)
class _Asked:
    """Asks, and keeps the answers."""

    logits_at: Callable[[np.ndarray], torch.Tensor]
    camera_from_index: Float64[np.ndarray, "4 4"]
    places: list[np.ndarray] = field(default_factory=list)  # voxels (n, 3)
    won: list[np.ndarray] = field(default_factory=list)  # margins (n, parts)

    def labels_of(self, flat: np.ndarray, shape: tuple[int, ...], stride: int) -> np.ndarray:
        """Labels at these points of a lattice of ``shape``, ``stride`` voxels apart."""
        labels = np.empty(len(flat), np.uint8)
        for first in range(0, len(flat), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            index = np.stack(np.unravel_index(flat[part], shape), axis=1) * stride
            points = transform_points(self.camera_from_index, index.astype(float))
            logits = self.logits_at(points.astype(np.float32))
            labels[part] = logits.argmax(-1).to(torch.uint8).cpu().numpy()
            self.places.append(index)
            self.won.append(margins_of(logits))
        return labels

    def margins(self, labels: UInt8[np.ndarray, "i j k"]) -> Float16[np.ndarray, "parts i j k"]:
        """As they were answered; elsewhere as sure as can be."""
        n_parts = self.won[0].shape[1]
        margins = np.empty((n_parts, *labels.shape), np.float16)
        for part in range(n_parts):
            inside = labels > 0 if part == 0 else labels == part + 1
            margins[part] = np.where(
                inside, np.float16(LARGEST_MARGIN), -np.float16(LARGEST_MARGIN)
            )
        places, won = np.concatenate(self.places), np.concatenate(self.won)
        within = (places < labels.shape).all(axis=1)
        i, j, k = places[within].T
        margins[:, i, j, k] = won[within].T
        return margins
