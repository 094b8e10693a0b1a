"""Compiled kernels of the lab against what NumPy and SciPy say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from tumortrack_lab.cut import _approach
from tumortrack_lab.world.forces import Bed


def test_the_bed_is_a_cubic_spline_of_its_grid_with_its_slope():
    rng = np.random.default_rng(0)
    bed = Bed(rng.normal(size=(7, 5, 9)), np.array([1.0, -2.0, 3.0]))
    points = bed.origin_mm + 2.5 * rng.uniform([1, 1, 1], [4.9, 2.9, 6.9], (50, 3))
    off, slope = bed.outside(points)
    places = ((points - bed.origin_mm) / 2.5).T
    expected = ndimage.map_coordinates(bed.values, places, order=3, prefilter=False)
    np.testing.assert_allclose(off, expected, atol=1e-12)
    for axis, step in enumerate(1e-4 * np.eye(3)):
        ahead, behind = bed.outside(points + step)[0], bed.outside(points - step)[0]
        np.testing.assert_allclose(slope[:, axis], (ahead - behind) / 2e-4, atol=1e-6)
    with pytest.raises(ValueError, match="4 along each axis"):
        Bed(np.zeros((7, 3, 9)), np.zeros(3))


def test_voxels_near_electrodes_learn_how_far_these_are():
    """Through the grid, beside it, and one without a length."""
    rng, reach = np.random.default_rng(1), 3.0
    ends = rng.uniform(-20, 40, (20, 2, 3))
    ends[0, 1] = ends[0, 0] = 7.0
    near = np.full((22, 18, 25), (reach + 1) ** 2, np.float32)
    _approach(ends, reach, near)
    voxels = np.indices(near.shape).reshape(3, -1).T[:, None]
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    along = ((voxels - start) * way).sum(-1) / np.maximum((way**2).sum(-1), 1e-12)
    foot = start + np.clip(along, 0, 1)[..., None] * way
    squared = ((voxels - foot) ** 2).sum(-1).min(1).reshape(near.shape)
    np.testing.assert_allclose(near[squared < reach**2], squared[squared < reach**2], rtol=1e-5)
    assert (near >= np.minimum(squared, (reach + 1) ** 2) * (1 - 1e-5)).all()
    assert 100 < (squared < reach**2).sum() < near.size / 2
