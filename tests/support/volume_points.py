"""Reading volumes at points of the patient, in tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import LabelVolume, Volume


def read_at(volume: Volume | LabelVolume, points_lps_mm: np.ndarray, order: int = 0) -> np.ndarray:
    """Values of a volume at points given in LPS."""
    values = volume.hu if isinstance(volume, Volume) else volume.labels
    index = transform_points(np.linalg.inv(volume.lps_from_index), points_lps_mm)
    return ndimage.map_coordinates(
        values.astype(float), index.T, order=order, mode="constant", cval=np.nan
    )


def lps_of(volume: Volume | LabelVolume, index: ArrayLike) -> np.ndarray:
    return transform_points(volume.lps_from_index, np.asarray(index, float))
