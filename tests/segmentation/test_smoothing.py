"""White noise is averaged away where a surface goes on, and nowhere else; of clouds, too."""

from __future__ import annotations

import numpy as np
import pytest

from noise_objects import noisy, seen
from tumortrack.core.camera import deproject
from tumortrack.core.types import SensorCloud
from tumortrack.segmentation.measured_noise import image_noise
from tumortrack.segmentation.smoothing import clean_cloud, smoothed, window_px

EVERY = slice(None), slice(None)


@pytest.mark.parametrize("white_mm", [0.5, 1.0, 2.0])
def test_what_is_left_is_as_of_so_many_pixels(white_mm):
    true, frame = seen(424, 150), noisy(seen(424, 150), white_mm, step_mm=0.0)
    noise = image_noise(frame)
    reach = window_px(frame, noise)
    left_mm = smoothed(frame, EVERY, noise, reach) - true.depth_mm
    inner = left_mm[80:130, 180:240]  # the organ's middle
    expected_mm = white_mm / (2 * reach + 1)
    assert np.nanstd(inner) == pytest.approx(expected_mm, rel=0.25)
    assert abs(np.nanmean(inner)) < 0.1  # of a curved surface
    assert noise.of_points(1, reach).point_mm == pytest.approx(expected_mm, rel=0.25)


def test_nothing_is_averaged_across_a_step():
    """The organ's edge before the table, 40 mm behind."""
    true = seen(424, 150)
    frame = noisy(true, 1.0, step_mm=0.0)
    noise = image_noise(frame)
    out_mm = smoothed(frame, EVERY, noise, window_px(frame, noise))
    off_mm = np.abs(out_mm - true.depth_mm)[np.isfinite(out_mm)]
    assert np.percentile(off_mm, 99) < 2.5
    assert off_mm.max() < 6.0  # of the 110,000 pixels, four of their own deviations and a slope
    assert (np.isfinite(out_mm) == np.isfinite(frame.depth_mm)).all()


def points_of(frame, count, seed=3):
    """Of the organ, without the table."""
    places = deproject(frame)
    places = places[np.linalg.norm(places[:, :2], axis=1) < 25]
    return places[np.random.default_rng(seed).choice(len(places), count, replace=False)]


def off_mm(points_mm):
    """From the ellipsoid at 150 mm, about."""
    radii, middle = np.array([50.0, 30.0, 28.0]), np.array([0.0, 0.0, 178.0])
    scaled = (points_mm - middle) / radii
    size = np.linalg.norm(scaled, axis=1)
    return (size - 1) * size / np.linalg.norm(scaled / radii, axis=1)


@pytest.mark.parametrize("white_mm", [0.1, 1.0, 2.0])
def test_a_noisy_cloud_comes_nearer_to_its_surface(white_mm):
    rng = np.random.default_rng(0)
    points = points_of(seen(424, 150), 2500) + rng.normal(0, white_mm, (2500, 3))
    found = clean_cloud(SensorCloud(points.astype(np.float32)))
    assert found.noise.measured_mm == pytest.approx(white_mm, rel=0.25, abs=0.1)
    inner = found.points_mm[np.linalg.norm(found.points_mm[:, :2], axis=1) < 18]
    assert np.abs(off_mm(inner)).mean() < max(0.4 * white_mm, 0.2)
    if white_mm < 0.4:
        np.testing.assert_array_equal(found.points_mm, points.astype(np.float32))


@pytest.mark.parametrize("share", [0.2, 0.4])
def test_scattered_points_are_dropped_and_the_surface_stays(share):
    rng = np.random.default_rng(1)
    points = points_of(seen(424, 150), 2500)
    low, high = points.min(0), points.max(0)
    outliers = int(share * len(points))
    points[:outliers] = (low + high) / 2 + (rng.random((outliers, 3)) - 0.5) * 1.5 * (high - low)
    found = clean_cloud(SensorCloud(points.astype(np.float32)))
    far = np.abs(off_mm(points)) > 3
    assert (np.abs(off_mm(found.points_mm)) > 3).sum() < 0.1 * far.sum()
    assert len(found.points_mm) > min(0.75 * (len(points) - outliers), 999)  # or smoothed ones


def test_a_sparse_cloud_keeps_its_points_and_says_its_noise():
    rng = np.random.default_rng(2)
    points = points_of(seen(424, 150), 150) + rng.normal(0, 1.0, (150, 3))
    found = clean_cloud(SensorCloud(points.astype(np.float32)))
    np.testing.assert_array_equal(found.points_mm, points.astype(np.float32))
    assert found.noise.point_mm > 0.5
    few = SensorCloud(points[:30].astype(np.float32))
    assert clean_cloud(few) is few
