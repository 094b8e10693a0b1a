"""Noise is measured as it was put in, whatever the shape below it."""

from __future__ import annotations

import numpy as np
import pytest

from noise_objects import noisy, seen
from tumortrack.core.camera import deproject
from tumortrack.core.types import SensorCloud
from tumortrack.segmentation.measured_noise import cloud_noise, depth_step_mm, image_noise


@pytest.mark.parametrize(("width", "distance_mm"), [(848, 150), (848, 300), (424, 150), (640, 400)])
@pytest.mark.parametrize("white_mm", [0.1, 0.5, 1.0, 2.0])
def test_white_noise_within_a_tenth(width, distance_mm, white_mm):
    found = image_noise(noisy(seen(width, distance_mm), white_mm))
    assert found.white_mm == pytest.approx(white_mm, rel=0.1)
    assert found.correlated_mm < white_mm / 3
    assert not found.bound


@pytest.mark.parametrize(("width", "distance_mm"), [(848, 150), (424, 150), (640, 300)])
@pytest.mark.parametrize("length_px", [1.5, 3.0, 5.0])
@pytest.mark.parametrize("white_mm", [0.0, 0.5])
def test_correlated_noise_is_told_from_white(width, distance_mm, length_px, white_mm):
    found = image_noise(noisy(seen(width, distance_mm), white_mm, 1.0, length_px))
    assert found.correlated_mm == pytest.approx(1.0, rel=0.2)
    assert found.correlation_px == pytest.approx(length_px, rel=0.4)
    # Over 1.5 pixels it is nearly white.
    assert found.white_mm == pytest.approx(white_mm, abs=0.25 if length_px < 2 else 0.15)


def test_noise_below_half_a_step_is_a_bound():
    found = image_noise(noisy(seen(848, 150), 0.05, step_mm=1.0))
    assert found.bound
    assert (found.step_mm, found.whole_mm) == (pytest.approx(1.0), pytest.approx(0.5))


def test_steps_of_depth_and_of_disparity():
    frame = noisy(seen(424, 200), 0.5, step_mm=0.25)
    assert depth_step_mm(frame.depth_mm) == pytest.approx(0.25)
    focal_baseline = 431.0 * 18.0  # of a D405, in px mm; a 32nd of a pixel
    plain = noisy(seen(424, 200), 0.5, step_mm=0.0).depth_mm
    stored = focal_baseline / (np.rint(32 * focal_baseline / plain) / 32)
    middle = float(np.nanmedian(stored))
    assert depth_step_mm(stored) == pytest.approx(middle**2 / 32 / focal_baseline, rel=0.1)
    assert depth_step_mm(plain) == 0


def test_edges_instruments_and_strays_do_not_count():
    frame = noisy(seen(848, 150), 0.5)
    depth = frame.depth_mm.copy()
    rng = np.random.default_rng(1)
    depth[150:170] = 90.0 + 0.5 * rng.standard_normal((20, 848))  # a shaft
    outliers = rng.random(depth.shape) < 2e-4
    depth[outliers] += rng.uniform(-20, 20, outliers.sum())
    assert image_noise(frame.with_depth(depth)).white_mm == pytest.approx(0.5, rel=0.2)


def test_an_image_without_a_smooth_surface_says_nothing():
    whole = noisy(seen(424, 150), 0.5).depth_mm
    rows, columns = np.indices(whole.shape)
    for there in (np.zeros(whole.shape, bool), (rows < 200) & (rows % 4 > 0) & (columns % 4 > 0)):
        left = np.where(there, whole, np.float32(np.nan))  # nothing; less than a window each
        assert image_noise(seen(424, 150).with_depth(left)) is None


@pytest.mark.parametrize("points", [1000, 20_000])
@pytest.mark.parametrize("noise_mm", [0.5, 1.0, 2.0])
def test_a_clouds_noise_whatever_its_density(points, noise_mm):
    places = deproject(noisy(seen(424, 150), noise_mm, step_mm=0.0))
    drawn = np.random.default_rng(2).choice(len(places), points, replace=False)
    found = cloud_noise(SensorCloud(places[drawn].astype(np.float32)))
    assert found.white_mm == pytest.approx(noise_mm, rel=0.25) or found.bound
    if found.bound:
        assert found.white_mm >= 0.8 * noise_mm
