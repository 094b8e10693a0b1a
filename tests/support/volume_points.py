"""Reading volumes at points of the patient, and fields at every voxel, in tests."""

import numpy as np
from scipy import ndimage

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Volume
from tumortrack.occupancy.volume import margins_of


def read_at(volume, points_lps_mm, order=0):
    """Values of a volume at points given in LPS."""
    values = volume.hu if isinstance(volume, Volume) else volume.labels
    index = transform_points(np.linalg.inv(volume.lps_from_index), points_lps_mm)
    return ndimage.map_coordinates(
        values.astype(float), index.T, order=order, mode="constant", cval=np.nan
    )


def lps_of(volume, index):
    return transform_points(volume.lps_from_index, np.asarray(index, float))


def dense_margins(logits_at, camera_from_index, shape):
    """``sparse_margins``, every voxel queried."""
    index = np.indices(shape).reshape(3, -1).T.astype(float)
    logits = logits_at(transform_points(camera_from_index, index).astype(np.float32))
    margins = margins_of(logits).T.reshape(-1, *shape)
    return margins, logits.argmax(-1).byte().numpy().reshape(shape)
