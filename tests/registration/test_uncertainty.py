"""Other minima and the camera's errors in the covariance."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tumortrack.models.in_distribution import RIVAL_COST
from tumortrack.registration.choose import likeliest
from tumortrack.registration.gauss_newton import RegistrationResult
from tumortrack.registration.looks import Looks
from warp_objects import ANATOMY, method, placed

VERTICES = ANATOMY.organ.vertices_mm


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


def test_a_cameras_depths_widen_along_the_line_of_sight():
    motion = replace(placed(), covariance=1e-4 * np.eye(26))
    wider = replace(motion, depth_share=0.02).covariance_mm2(VERTICES[:50])
    wider -= motion.covariance_mm2(VERTICES[:50])
    places = motion.carry(VERTICES[:50])
    draws = 1 + 0.02 * np.random.default_rng(4).standard_normal(40_000)
    for covariance, place in zip(wider[::10], places[::10], strict=True):
        np.testing.assert_allclose(covariance, np.cov((draws[:, None] * place).T), atol=0.12)
