"""What the elastic library cannot do, other minima and the camera's errors in the covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from elastic_objects import CENTER, RADII
from tumortrack.models.in_distribution import RIVAL_COST
from tumortrack.registration import kernels
from tumortrack.registration.choose import likeliest
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.discrepancy import (
    AMPLITUDES_MM,
    LENGTH_MM,
    NOISES_MM,
    _grouped,
    fit_discrepancy,
)
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.looks import Looks
from tumortrack.registration.uncertainty import posterior
from tumortrack.sense.noise import CalibrationConfig
from warp_objects import ANATOMY, method, nudged, placed, refined

CONFIG = GaussNewtonConfig()
VERTICES = ANATOMY.organ.vertices_mm
START = nudged(placed(), [2.0, -1, 3], [0.03, -0.04, 0.05])
# The camera sees the half towards its origin; the bump stands in the middle of it.
NORMALS = (VERTICES - CENTER) / RADII**2
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
PLACES = placed().carry(VERTICES)
FACING = -((NORMALS @ placed().rotation.T) * PLACES).sum(1) / np.linalg.norm(PLACES, axis=1)
TOP = VERTICES[FACING.argmax()]


def seen(bump_mm=0.0, width_mm=12.0):
    """The visible half, 0.15 mm of noise, and a bump outwards that no state of the library has."""
    height = bump_mm * np.exp(-(np.linalg.norm(VERTICES - TOP, axis=1) ** 2) / (2 * width_mm**2))
    moved = placed().carry(VERTICES + height[:, None] * NORMALS)
    return (moved + np.random.default_rng(0).normal(0, 0.15, moved.shape))[FACING > 0.2]


def judged(points):
    return posterior(refined(points, START, CONFIG).motion, Looks.of([points]), CONFIG)


@pytest.fixture(scope="module")
def plain():
    return judged(seen())


def test_without_a_discrepancy_there_is_hardly_any(plain):
    assert plain.discrepancy.amplitude_mm <= AMPLITUDES_MM[1]
    assert plain.discrepancy.noise_mm <= NOISES_MM[1]


def test_a_bump_widens_the_deviation_where_it_stands_and_less_where_it_does_not(plain):
    bumpy = judged(seen(bump_mm=3.0))
    assert bumpy.discrepancy.amplitude_mm >= 0.6
    below, hidden = TOP + 0.35 * (CENTER - TOP), CENTER - 0.9 * (TOP - CENTER)
    for motion, least in ((plain, 0.0), (bumpy, 0.3)):
        deep, far = motion.largest_std_mm(np.array([below, hidden]))
        assert deep > least
        assert far > deep  # what is not seen is less sure
    wider = bumpy.largest_std_mm(below[None]) / plain.largest_std_mm(below[None])
    assert wider > 1.5


def test_the_covariance_is_that_of_a_plain_gaussian_process():
    """All moments of places and residuals at once, conditioned without a shortcut."""
    rng = np.random.default_rng(5)
    places, points = rng.uniform(-40, 40, (60, 3)), rng.uniform(-40, 40, (20, 3))
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    slopes = np.column_stack([-normals, rng.normal(size=(60, 9))])
    bump = 2 * np.exp(-(np.linalg.norm(places - places[0], axis=1) ** 2) / (2 * 15**2))
    rows = np.column_stack([slopes, bump * normals[:, 2]])
    prior, effects = np.diag(rng.uniform(0.2, 2.0, 12)), rng.normal(size=(20, 3, 12))
    covariance, process = fit_discrepancy(rows, places, prior, np.zeros(12), 100.0)
    assert process.amplitude_mm > 0
    found = process.widened(effects, covariance, points.astype(np.float32))

    def alike(a, b):
        apart = np.linalg.norm(a[:, None] - b, axis=2)
        return process.amplitude_mm**2 * np.exp(-(apart**2) / (2 * LENGTH_MM**2))

    residuals = slopes @ prior @ slopes.T + alike(places, places) * (normals @ normals.T)
    residuals += process.noise_mm**2 * np.eye(60)
    for n, (effect, point) in enumerate(zip(effects, points, strict=True)):
        both = -effect @ prior @ slopes.T + alike(point[None], places) * normals.T
        own = effect @ prior @ effect.T + process.amplitude_mm**2 * np.eye(3)
        expected = own - both @ np.linalg.solve(residuals, both.T)
        np.testing.assert_allclose(found[n], expected, atol=0.01 * np.trace(expected))
        assert np.linalg.eigvalsh(expected)[0] > 0


def test_amplitude_and_noise_are_the_most_likely_pair():
    rng = np.random.default_rng(2)
    places = rng.uniform(-40, 40, (50, 3))
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    alike = np.exp(-(apart**2) / (2 * LENGTH_MM**2))
    mixed, per_noise = rng.normal(size=(50, 6)), rng.uniform(0.1, 0.3, 50)
    explained = mixed @ mixed.T + 1e-4 * np.eye(50)
    truth = explained + 1.2**2 * alike + np.diag(0.6**2 * per_noise)
    for _ in range(3):
        residuals = rng.multivariate_normal(np.zeros(50), truth)
        found = kernels.most_likely(
            explained, alike, per_noise, residuals, (AMPLITUDES_MM, NOISES_MM)
        )
        told = {
            (a, s): multivariate_normal(
                np.zeros(50), explained + a**2 * alike + np.diag(s**2 * per_noise)
            ).logpdf(residuals)
            for a in AMPLITUDES_MM
            for s in NOISES_MM
        }
        assert found == max(told, key=told.__getitem__)
        assert 0.3 <= found[0] <= 4.8


def test_groups_are_those_of_the_nearest_of_points_that_lie_far_apart():
    points = np.random.default_rng(3).uniform(0, 50, (400, 3))
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    for _ in range(63):
        nearest = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(1)
        chosen.append(int(nearest.argmax()))
    expected = np.linalg.norm(points[:, None] - points[chosen], axis=2).argmin(1)
    np.testing.assert_array_equal(_grouped(points), expected)
    twice = np.array([[0.0, 0, 0], [9, 0, 0], [0, 0, 0], [9, 0, 0]])
    np.testing.assert_array_equal(np.unique(_grouped(twice)), [0, 1])  # none is empty


def fit(motion, cost):
    looks = Looks.of([np.zeros((3, 3))])
    return RegistrationResult(motion, looks, cost, 0.0, cost, np.zeros(3), 1, np.zeros(6))


def best_of(fits):
    return likeliest(fits, method().prior)


def test_two_minima_widen_the_covariance_by_their_distance():
    motion = replace(placed(), covariance=1e-4 * np.eye(26))
    away = replace(motion, centre_mm=motion.centre_mm + [0, 6.0, 0])
    best = best_of([fit(away, 12.0), fit(motion, 10.0)])
    share = math.exp(-1) / (1 + math.exp(-1))
    assert best.cost == 10
    assert [rival.cost for rival in best.rivals] == [12.0]
    points = VERTICES[:5]
    wider = best.motion.covariance_mm2(points) - motion.covariance_mm2(points)
    np.testing.assert_allclose(wider, np.tile(np.diag([0, 36 * share, 0]), (5, 1, 1)), atol=1e-6)


def test_neither_the_same_minimum_nor_an_unlikely_one_is_a_rival():
    motion = replace(placed(), covariance=0.01 * np.eye(26))
    same = replace(motion, centre_mm=motion.centre_mm + [0, 0.1, 0])
    away = replace(motion, centre_mm=motion.centre_mm + [0, 6.0, 0])
    assert best_of([fit(motion, 10.0), fit(same, 10.5)]).rivals == ()
    assert best_of([fit(motion, 10.0), fit(away, 10.1 + RIVAL_COST)]).rivals == ()
    first = best_of([fit(motion, 10.0), fit(away, 11.0)])
    assert len(best_of([first, fit(away, 11.5)]).rivals) == 1  # the same one again
    turned = best_of([first, fit(away, 9.0)])  # one of them won after all
    assert [rival.cost for rival in turned.rivals] == [10.0]


def test_the_cameras_calibration_widens_along_the_line_of_sight():
    motion = replace(placed(), covariance=1e-4 * np.eye(26))
    camera = CalibrationConfig(offset_mm=3.0, scale=0.02)
    wider = replace(motion, calibration=camera).covariance_mm2(VERTICES[:50])
    wider -= motion.covariance_mm2(VERTICES[:50])
    places = motion.carry(VERTICES[:50])
    draws = np.random.default_rng(4).uniform(-1, 1, (2, 40_000)) * [[3.0], [0.02]]
    for covariance, place in zip(wider[::10], places[::10], strict=True):
        depth = place[2] + draws[0] + draws[1] * place[2]
        seen_there = place / place[2] * depth[:, None]
        np.testing.assert_allclose(covariance, np.cov(seen_there.T), atol=0.08)
