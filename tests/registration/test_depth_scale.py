"""What a camera's depths err by, all alike: from what is stated, and from the organ's size."""

from __future__ import annotations

import numpy as np
import pytest

from tumortrack.core.report import SizeFit
from tumortrack.core.types import DepthError
from tumortrack.registration.depth_scale import depth_share


def size(times=1.0, std=0.02):
    return SizeFit(times=times, gain=((times - 1) / std) ** 2, std=std)


def test_a_share_of_the_depth_and_a_constant():
    rng, error = np.random.default_rng(0), DepthError(3.0, 0.01)
    off_mm = rng.uniform(-3, 3, 200_000) + 200 * rng.uniform(-0.01, 0.01, 200_000)
    assert error.share(200.0) == pytest.approx(off_mm.std() / 200, rel=0.01)


@pytest.mark.parametrize("times", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("stated", [DepthError(0.5), DepthError(4.0, 0.03)])
def test_it_is_the_posterior_about_what_was_measured(times, stated):
    """Against draws of the camera's error and of the size as it is read, weighted by the latter."""
    prior = stated.share(150.0)
    drawn = prior * np.random.default_rng(1).standard_normal(400_000)
    weights = np.exp(-(((times - 1 - drawn) / 0.02) ** 2) / 2)
    expected = np.sqrt(np.average(drawn**2, weights=weights))
    assert depth_share(size(times), 150.0, stated) == pytest.approx(expected, rel=0.02)


def test_a_right_camera_leaves_nothing_and_an_organ_that_looks_large_speaks_against_others():
    assert depth_share(size(1.03), 150.0, DepthError()) == 0
    right, large = (depth_share(size(times), 150.0, None) for times in (1.0, 1.05))
    assert right < DepthError(5.0, 0.02).share(150.0)
    assert large > 1.2 * right
    assert 0.5 < depth_share(size(3.0), 150.0, None) < 2  # another organ: no overflow
