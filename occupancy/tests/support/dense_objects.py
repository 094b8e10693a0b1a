"""Fields at every voxel, in tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from tumortrack.core.geometry import transform_points
from tumortrack_occupancy.volume import margins_of


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
