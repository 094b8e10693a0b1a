"""What noise, a camera's depths and other minima do to a fit, its size and its uncertainty."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tumortrack.core.camera import d405, deproject
from tumortrack.core.render import render_depth
from tumortrack.core.report import SizeFit
from tumortrack.core.types import DepthError, PointNoise
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import RegistrationResult, refine
from tumortrack.registration.in_distribution import RIVAL_COST
from tumortrack.registration.multi_view import MultiViewCloud, depth_share, kernel_width_mm, lies_on
from tumortrack.registration.registration import select_best
from warp_objects import ANATOMY, method, placed, shape

CONFIG, ORGAN, MOTION = GaussNewtonConfig(), ANATOMY.organ, placed()
SEEN = deproject(render_depth(MOTION.forward(ORGAN.vertices_mm), ORGAN.faces, d405(424, 240)))
FRONT = SEEN[np.random.default_rng(0).choice(len(SEEN), 1500, replace=False)]


def views_of(points, noise=None, **more):
    noises = () if noise is None else [noise]
    return MultiViewCloud.from_points([np.asarray(points, np.float32)], noises=noises, **more)


def noisy_front(noise_mm, seed):
    """Along the line of sight; white noise that nobody averages away."""
    noise = np.random.default_rng(seed).normal(0, noise_mm, (len(FRONT), 1))
    return FRONT + noise * FRONT / FRONT[:, 2:]


# --- noise ---


@pytest.mark.parametrize("noise_mm", [0.8, 1.5, 3.0])
def test_a_right_fits_cost_grows_by_what_is_foreseen(noise_mm):
    noise, costs = PointNoise(noise_mm, noise_mm, 0.0), []
    for places, known in ((FRONT, PointNoise()), (noisy_front(noise_mm, 1), noise)):
        views, width = views_of(places, known), kernel_width_mm(CONFIG, noise)
        squares = MOTION.residual_rows(views.points_mm)[:, -1] ** 2
        costs.append(views.weight(CONFIG) * (squares / (1 + squares / width**2)).sum())
        foreseen = views.noise_cost(CONFIG)
    assert foreseen == pytest.approx(costs[1] - costs[0], rel=0.25)
    shared = views_of(FRONT, PointNoise(noise_mm, noise_mm, 0.2))
    whole = 1 / (CONFIG.sigma_mm**2 / CONFIG.n_effective + 0.2**2)
    assert len(FRONT) * shared.weight(CONFIG) == pytest.approx(whole)


def test_noise_makes_no_outliers():
    points = noisy_front(2.0, 2)
    quiet = refine(shape(), views_of(points), MOTION, CONFIG)
    told = refine(shape(), views_of(points, PointNoise(2.0, 2.0, 0.05)), MOTION, CONFIG)
    assert told.outliers < 0.01 < quiet.outliers


def test_noise_does_not_make_the_organ_larger():
    """It is in a point's distance and in the ray to it: their product has a mean."""
    times = {0.0: [], 1.0: []}
    for noise_mm, found in times.items():
        for seed in range(6):
            noise = PointNoise(noise_mm, noise_mm, 0.03 * noise_mm)
            views = views_of(noisy_front(noise_mm, seed), noise)
            fit = refine(shape(), views, MOTION, CONFIG)
            found.append(views.apparent_size(fit.motion, CONFIG).times)
    larger = np.subtract(times[1.0], times[0.0])
    assert np.mean(larger) < 0.035  # 0.055 where the product has a mean


def test_a_lobe_that_was_left_out_is_found_again():
    """Of the points a third was taken for another piece; a lump of something else lies beside."""
    hidden = MOTION.forward(ORGAN.vertices_mm)
    hidden = hidden[hidden[:, 2] > np.percentile(hidden[:, 2], 90)]  # its far side
    assert lies_on(MOTION, FRONT, 2.0).mean() > 0.97
    assert not lies_on(MOTION, hidden, 2.0).any()
    right = FRONT[:, 0] > np.percentile(FRONT[:, 0], 66)
    lump = FRONT[right][:200] + [0, 0, -12.0]
    candidates = np.concatenate([FRONT[right], lump]).astype(np.float32)
    views = views_of(FRONT[~right], candidates_mm=candidates)
    first = refine(shape(), views, MOTION, CONFIG)
    whole = method().with_all_points(first, views)
    taken = len(whole.views.points_mm) - (~right).sum()
    assert taken == pytest.approx(right.sum(), abs=0.05 * right.sum())
    middles = ORGAN.vertices_mm[::7] * 0.5 + ORGAN.vertices_mm.mean(0) * 0.5
    off_mm = [
        np.linalg.norm(fit.motion.forward(middles) - MOTION.forward(middles), axis=1).mean()
        for fit in (whole, first)
    ]
    assert off_mm[0] < off_mm[1]


# --- depths ---


def size(times):
    return SizeFit(times=times, gain=((times - 1) / 0.02) ** 2, std=0.02)


@pytest.mark.parametrize("times", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("stated", [DepthError(0.5), DepthError(4.0, 0.03)])
def test_the_error_of_depths_is_the_posterior_about_what_was_measured(times, stated):
    """Against draws of the camera's error and of the size as it is read, weighted by the latter."""
    rng, prior = np.random.default_rng(1), stated.share(150.0)
    uniform = rng.uniform(-1, 1, (200_000, 2)) @ [stated.offset_mm / 150, stated.scale]
    assert prior == pytest.approx(uniform.std(), rel=0.01)
    drawn = prior * rng.standard_normal(400_000)
    weights = np.exp(-(((times - 1 - drawn) / 0.02) ** 2) / 2)
    expected = np.sqrt(np.average(drawn**2, weights=weights))
    assert depth_share(size(times), 150.0, stated) == pytest.approx(expected, rel=0.02)


def test_a_right_camera_leaves_nothing_and_an_organ_that_looks_large_speaks_against_others():
    assert depth_share(size(1.03), 150.0, DepthError()) == 0
    right, large = (depth_share(size(times), 150.0, None) for times in (1.0, 1.05))
    assert right < DepthError(5.0, 0.02).share(150.0)
    assert large > 1.2 * right
    assert 0.5 < depth_share(size(3.0), 150.0, None) < 2  # another organ: no overflow


def test_a_cameras_depths_widen_along_the_line_of_sight():
    motion, points = replace(MOTION, covariance=1e-4 * np.eye(26)), ORGAN.vertices_mm[:50:10]
    wider = replace(motion, depth_share=0.02).covariance_mm2(points) - motion.covariance_mm2(points)
    draws = 1 + 0.02 * np.random.default_rng(4).standard_normal(40_000)
    for covariance, place in zip(wider, motion.forward(points), strict=True):
        np.testing.assert_allclose(covariance, np.cov((draws[:, None] * place).T), atol=0.12)


# --- other minima ---


def fit_of(motion, cost):
    views = MultiViewCloud.from_points([np.zeros((3, 3))])
    return RegistrationResult(motion, views, cost, 0.0, cost, np.zeros(3), 1, np.zeros(6))


def best_of(*fits):
    return select_best(fits, method().prior)


def test_two_minima_widen_the_covariance_by_their_distance():
    motion = replace(MOTION, covariance=1e-4 * np.eye(26))
    away = replace(motion, centre_mm=motion.centre_mm + [0, 6.0, 0])
    best = best_of(fit_of(away, 12.0), fit_of(motion, 10.0))
    share = math.exp(-1) / (1 + math.exp(-1))
    assert (best.cost, [alternative.cost for alternative in best.alternatives]) == (10, [12.0])
    points = ORGAN.vertices_mm[:5]
    wider = best.motion.covariance_mm2(points) - motion.covariance_mm2(points)
    np.testing.assert_allclose(wider, np.tile(np.diag([0, 36 * share, 0]), (5, 1, 1)), atol=1e-6)


def test_neither_the_same_minimum_nor_an_unlikely_one_is_a_alternative():
    motion = replace(MOTION, covariance=0.01 * np.eye(26))
    same, away = (replace(motion, centre_mm=motion.centre_mm + [0, mm, 0]) for mm in (0.1, 6.0))
    assert best_of(fit_of(motion, 10.0), fit_of(same, 10.5)).alternatives == ()
    assert best_of(fit_of(motion, 10.0), fit_of(away, 10.1 + RIVAL_COST)).alternatives == ()
    first = best_of(fit_of(motion, 10.0), fit_of(away, 11.0))
    assert len(best_of(first, fit_of(away, 11.5)).alternatives) == 1  # the same one again
    turned = best_of(first, fit_of(away, 9.0))  # one of them won after all
    assert [alternative.cost for alternative in turned.alternatives] == [10.0]
