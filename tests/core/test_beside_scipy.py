"""Own forms that stand for SciPy's, which are slow to import, agree with them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from tumortrack.core.geometry import turned_by
from tumortrack.registration.estimate import probabilities


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.3, np.pi, 5.0])
def test_rotations(length):
    axis = np.array([0.48, -0.6, 0.64])
    expected = Rotation.from_rotvec(length * axis).as_matrix()
    np.testing.assert_allclose(turned_by(length * axis), expected, atol=1e-12)


def test_the_normal_distribution():
    off = np.linspace(0, 9, 1000, dtype=np.float32)
    which = np.zeros(len(off), np.int32)
    np.testing.assert_allclose(probabilities(off, np.ones(1), which), ndtr(off), atol=6e-8)
