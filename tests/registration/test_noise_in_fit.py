"""What noise does to a fit: to its weight, cost and size, and to which points it takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tumortrack.core.types import PointNoise
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.looks import Looks, kernel_width_mm, lies_on
from tumortrack.registration.uncertainty import apparent_size
from tumortrack.sense.camera import d405, deproject
from tumortrack.sense.render import render_depth
from warp_objects import ANATOMY, method, placed, shape

CONFIG, ORGAN = GaussNewtonConfig(), ANATOMY.organ
MOTION = placed()


def front_of(motion, count=1500, seed=0):
    """Points of the side that a camera sees."""
    places = motion.carry(ORGAN.vertices_mm)
    points = deproject(render_depth(places, ORGAN.faces, d405(424, 240)))
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


FRONT = front_of(MOTION)


def looks_of(points, noise=None, **more):
    noises = () if noise is None else [noise]
    return Looks.of([np.asarray(points, np.float32)], noises=noises, **more)


def test_the_weight_of_a_look_is_of_the_model_and_of_the_noise_that_is_shared():
    quiet = looks_of(FRONT)
    assert quiet.weight(CONFIG) == pytest.approx(CONFIG.n_effective / len(FRONT))
    noisy = looks_of(FRONT, PointNoise(1.2, 1.2, 0.2))
    whole = 1 / (CONFIG.sigma_mm**2 / CONFIG.n_effective + 0.2**2)
    assert len(FRONT) * noisy.weight(CONFIG) == pytest.approx(whole)


@pytest.mark.parametrize("noise_mm", [0.8, 1.5, 3.0])
def test_a_right_fits_cost_grows_by_what_is_foreseen(noise_mm):
    """Along the line of sight; of white noise that nobody averages away."""
    rng, along = np.random.default_rng(1), FRONT / FRONT[:, 2:]
    points = FRONT + rng.normal(0, noise_mm, (len(FRONT), 1)) * along
    costs = []
    for places, noise in ((FRONT, PointNoise()), (points, PointNoise(noise_mm, noise_mm, 0.0))):
        looks = looks_of(places, noise)
        # The same kernel, so that noise alone tells.
        width = kernel_width_mm(CONFIG, PointNoise(noise_mm, noise_mm, 0.0))
        squares = MOTION.residual_rows(looks.points_mm)[:, -1] ** 2
        costs.append(looks.weight(CONFIG) * (squares / (1 + squares / width**2)).sum())
        foreseen = looks.noise_cost(CONFIG)
    assert foreseen == pytest.approx(costs[1] - costs[0], rel=0.25)


def test_noise_makes_no_outliers():
    rng, along = np.random.default_rng(2), FRONT / FRONT[:, 2:]
    points = FRONT + rng.normal(0, 2.0, (len(FRONT), 1)) * along
    quiet = refine(shape(), looks_of(points), MOTION, CONFIG)
    told = refine(shape(), looks_of(points, PointNoise(2.0, 2.0, 0.05)), MOTION, CONFIG)
    assert told.strays < 0.01 < quiet.strays


def test_noise_does_not_make_the_organ_larger():
    """It is in a point's distance and in the ray to it: their product has a mean."""
    along, times = FRONT / FRONT[:, 2:], {0.0: [], 1.0: []}
    for noise_mm, found in times.items():
        for seed in range(6):
            rng = np.random.default_rng(seed)
            points = FRONT + rng.normal(0, noise_mm, (len(FRONT), 1)) * along
            looks = looks_of(points, PointNoise(noise_mm, noise_mm, 0.03 * noise_mm))
            fit = refine(shape(), looks, MOTION, CONFIG)
            found.append(apparent_size(fit.motion, looks, CONFIG).times)
    larger = np.subtract(times[1.0], times[0.0])
    assert np.mean(larger) < 0.035  # 0.055 where the product has a mean


def test_what_lies_on_the_organ_faces_the_camera():
    hidden = MOTION.carry(ORGAN.vertices_mm)
    hidden = hidden[hidden[:, 2] > np.percentile(hidden[:, 2], 90)]  # its far side
    assert lies_on(MOTION, FRONT, 2.0).mean() > 0.97
    assert not lies_on(MOTION, hidden, 2.0).any()
    assert not lies_on(MOTION, FRONT - [0, 0, 10.0], 2.0).any()


def test_a_lobe_that_was_left_out_is_found_again():
    """Of the points a third was taken for another piece; a lump of something else lies beside."""
    right = FRONT[:, 0] > np.percentile(FRONT[:, 0], 66)
    lump = FRONT[right][:200] + [0, 0, -12.0]
    candidates = np.concatenate([FRONT[right], lump]).astype(np.float32)
    looks = looks_of(FRONT[~right], candidates_mm=candidates)
    first = refine(shape(), looks, MOTION, CONFIG)
    whole = method().with_all_points(first, looks)
    taken = len(whole.looks.points_mm) - (~right).sum()
    assert taken == pytest.approx(right.sum(), abs=0.05 * right.sum())
    middles = ORGAN.vertices_mm[::7] * 0.5 + ORGAN.vertices_mm.mean(0) * 0.5
    truth = MOTION.carry(middles)

    def off_mm(fit):
        return np.linalg.norm(fit.motion.carry(middles) - truth, axis=1).mean()

    assert off_mm(whole) < off_mm(first)
    same = method().with_all_points(whole, replace(whole.looks, candidates_mm=None))
    assert same is whole
