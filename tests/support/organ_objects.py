"""Organs that are no kidneys, as label maps: what shapes like a liver's and a prostate's ask."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tumortrack.core.types import LabelVolume

Ball = tuple[tuple[float, float, float], float]  # middle and radius, mm


def liver(tumors: tuple[Ball, ...] = (), voxel_mm: float = 3.0) -> LabelVolume:
    """About 1.5 l and 230 mm wide: a wedge that thins to the patient's left, hollowed below."""
    return _labelled((240.0, 170.0, 200.0), voxel_mm, _in_liver, tumors)


def prostate(tumors: tuple[Ball, ...] = (), voxel_mm: float = 1.0) -> LabelVolume:
    """About 40 ml and 50 mm wide: a chestnut, its apex below, flat behind."""
    return _labelled((60.0, 50.0, 60.0), voxel_mm, _in_prostate, tumors)


def _in_liver(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    thick = 1 - 0.45 * x / 110
    wedge = (x / 112) ** 2 + (y / (56 * thick)) ** 2 + ((z + 12 * x / 110) / (62 * thick)) ** 2 < 1
    below = ((x - 10) / 60) ** 2 + ((y - 55) / 40) ** 2 + ((z + 62) / 45) ** 2 < 1
    return wedge & ~below


def _in_prostate(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    wide = 1 + 0.28 * z / 22
    across = 25 * wide * (1 + 0.25 * y / 18)
    whole = (x / across) ** 2 + (y / (19 * wide)) ** 2 + (z / 23) ** 2 < 1
    return whole & (y < 11)


def _labelled(
    size_mm: tuple[float, float, float],
    voxel_mm: float,
    inside: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    tumors: tuple[Ball, ...],
) -> LabelVolume:
    count = [round(side / voxel_mm) for side in size_mm]
    low = -voxel_mm * (np.array(count) - 1) / 2
    x, y, z = (voxel_mm * np.indices(count).T + low).T
    labels = inside(x, y, z).astype(np.uint8)
    for number, ((a, b, c), radius) in enumerate(tumors, 2):
        ball = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < radius**2
        labels[ball & (labels > 0)] = number
    affine = np.diag([voxel_mm, voxel_mm, voxel_mm, 1.0])
    affine[:3, 3] = low
    return LabelVolume(labels, affine)
