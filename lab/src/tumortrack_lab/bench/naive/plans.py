"""A resection planned on all points: hulls and a triangulation of every point, voxels."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay
from skimage.measure import find_contours

from tumortrack.core.types import Anatomy
from tumortrack.imaging.raster import label_grid
from tumortrack.plan.outline import common, evenly, grown
from tumortrack.plan.values import Located

_VOXEL_MM = 0.5


def published(seen: Located) -> None:
    """The paper's plan with hulls of all points."""
    import shapely

    _shares(seen)
    tumor = shapely.concave_hull(shapely.MultiPoint(seen.of(3)[:, :2]), ratio=0.1)
    organ = shapely.concave_hull(shapely.MultiPoint(seen.points_mm[:, :2]), ratio=0.1)
    zone = common(grown(tumor, 5.0), organ)
    evenly(np.array(zone.exterior.coords), 1.0)


def margin(seen: Located) -> None:
    """The grown tumor on voxels: distances everywhere, then a contour in each layer."""
    _shares(seen)
    low, high = seen.meshes["tumor_2"].box_mm + [[-8.0], [8.0]]
    table_from_index = np.diag([_VOXEL_MM, _VOXEL_MM, _VOXEL_MM, 1.0])
    table_from_index[:3, 3] = low
    i, j, k = (int(n) for n in np.ceil((high - low) / _VOXEL_MM))
    tumor = label_grid(Anatomy((seen.meshes["tumor_2"],)), table_from_index, (i, j, k)) > 0
    grown_mm = _VOXEL_MM * distance_transform_edt(~tumor)
    below = np.minimum.accumulate(grown_mm, axis=2)
    for level in range(0, k, 8):
        find_contours(below[:, :, level], 5.0)


def _shares(seen: Located) -> None:
    """Which tumor lies outside: every point against a triangulation of all others."""
    hull = Delaunay(seen.of(1))
    for label in seen.tumors:
        (hull.find_simplex(seen.of(label)) < 0).mean()
