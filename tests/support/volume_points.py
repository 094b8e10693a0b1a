"""Reading volumes at points of the patient, and fields at every voxel, in tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy import ndimage

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import LabelVolume, Volume
from tumortrack.occupancy.volume import margins_of


def read_at(volume: Volume | LabelVolume, points_lps_mm: np.ndarray, order: int = 0) -> np.ndarray:
    """Values of a volume at points given in LPS."""
    values = volume.hu if isinstance(volume, Volume) else volume.labels
    index = transform_points(np.linalg.inv(volume.lps_from_index), points_lps_mm)
    return ndimage.map_coordinates(
        values.astype(float), index.T, order=order, mode="constant", cval=np.nan
    )


def lps_of(volume: Volume | LabelVolume, index: ArrayLike) -> np.ndarray:
    return transform_points(volume.lps_from_index, np.asarray(index, float))


def dense_margins(
    logits_at: Callable[[np.ndarray], torch.Tensor],
    camera_from_index: np.ndarray,
    shape: tuple[int, int, int],
) -> tuple[torch.Tensor, np.ndarray]:
    """``sparse_margins``, every voxel queried."""
    index = np.indices(shape).reshape(3, -1).T.astype(float)
    logits = logits_at(transform_points(camera_from_index, index).astype(np.float32))
    margins = margins_of(logits).T.reshape(-1, *shape)
    return margins, logits.argmax(-1).byte().numpy().reshape(shape)
