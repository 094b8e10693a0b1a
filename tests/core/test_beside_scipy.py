"""Own forms that stand for SciPy's, which are slow to import, agree with them."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from tumortrack.assessment.sight import _within
from tumortrack.core.geometry import turned_by
from tumortrack.registration.estimate import NODES_MM, nearest_lookup, probabilities


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.3, np.pi, 5.0])
def test_rotations(length):
    axis = np.array([0.48, -0.6, 0.64])
    expected = Rotation.from_rotvec(length * axis).as_matrix()
    np.testing.assert_allclose(turned_by(length * axis), expected, atol=1e-12)


@pytest.mark.parametrize("reach", [1.0, 2.0, 3.7, 40.0])
def test_what_lies_near_filled_pixels(reach):
    filled = np.random.default_rng(0).random((37, 50)) < 0.01
    np.testing.assert_array_equal(_within(reach, filled), distance_transform_edt(~filled) <= reach)
    rim = binary_dilation(filled, iterations=2)
    np.testing.assert_array_equal(_within(2, filled), rim)


def test_nearest_places():
    rng = np.random.default_rng(1)
    b = rng.normal(0, 30, (60, 3))
    lower, which = nearest_lookup(b)
    nodes = lower + NODES_MM * np.stack(np.indices(which.shape), -1).reshape(-1, 3)
    away_mm = np.linalg.norm(nodes - b[which.ravel()], axis=1)
    np.testing.assert_allclose(away_mm, cKDTree(b).query(nodes)[0], atol=1e-4)


def test_the_normal_distribution():
    off = np.linspace(0, 9, 1000, dtype=np.float32)
    which = np.zeros(len(off), np.int32)
    np.testing.assert_allclose(probabilities(off, np.ones(1), which), ndtr(off), atol=6e-8)
