"""The fit with compliance: what the library's states cannot follow."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from elastic_objects import CENTER, RADII
from tumortrack.registration import bend as module
from tumortrack.registration.bend import (
    _grouped,
    _Groups,
    _means_of_groups,
    _with_compliance,
    bend,
)
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import GaussNewton, prior_precision, refine
from tumortrack.registration.kernels import POSE
from tumortrack.registration.looks import Looks
from tumortrack.registration.uncertainty import held_by_prior_mm
from warp_objects import ANATOMY, nudged, placed, refined

CONFIG = GaussNewtonConfig()
VERTICES = ANATOMY.organ.vertices_mm
START = nudged(placed(), [2.0, -1, 3], [0.03, -0.04, 0.05])
# The camera sees the half towards its origin; TOP is the middle of it.
NORMALS = (VERTICES - CENTER) / RADII**2
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
PLACES = placed().carry(VERTICES)
FACING = -((NORMALS @ placed().rotation.T) * PLACES).sum(1) / np.linalg.norm(PLACES, axis=1)
TOP = VERTICES[FACING.argmax()]


def pressed(seed):
    """The organ under forces in many places, which the library does not have."""
    motion = _with_compliance(placed())
    forces = np.random.default_rng(seed).normal(0, 8, motion.shape.body.compliance.shape[-1])
    forces[:12] = 0  # the smoothest, which the library has as well
    return motion.changed(np.concatenate([np.zeros(POSE + len(placed().coefficients)), forces]))


def seen(motion, noise_mm=0.15):
    """The visible half."""
    moved = motion.carry(VERTICES)
    return (moved + np.random.default_rng(0).normal(0, noise_mm, moved.shape))[FACING > 0.2]


def test_a_state_of_the_library_stays_as_it_is():
    fit = refined(seen(placed()), START, CONFIG)
    bent = bend(fit, CONFIG)
    assert bent.compliance_std_mm == 0.5
    apart = np.linalg.norm(bent.motion.carry(VERTICES) - fit.motion.carry(VERTICES), axis=1)
    assert apart.max() < 0.6
    assert bent.cost <= fit.cost + 0.1


def test_forces_anywhere_are_followed_where_they_are_seen():
    left_mm = []
    for seed in range(6):
        fit = refined(seen(pressed(seed)), START, CONFIG)
        bent = bend(fit, CONFIG)
        assert bent.compliance_std_mm > 0.5
        assert bent.cost < fit.cost
        left_mm.append([np.abs(each.distances_mm).mean() for each in (fit, bent)])
    of_library, of_bent = np.mean(left_mm, axis=0)
    assert of_bent < 0.7 * of_library


def test_how_far_the_prior_holds_a_part_is_how_far_it_moves_without_some_of_it():
    looks = Looks.of([seen(placed(share=1.5), 0.0)])
    near = msgspec.structs.replace(CONFIG, first_mm=CONFIG.last_mm, enough_mm=1e-4)
    fit = refine(START.shape, looks, START, near)
    middles_ct, precision = fit.motion.shape.middles_ct, prior_precision(START.shape, CONFIG)
    less = 0.05
    freer = GaussNewton(START.shape, looks, fit.motion, near, fit.moved, (1 - less) * precision)
    freer.run(40)
    away_mm = freer.result().motion.carry(middles_ct) - fit.motion.carry(middles_ct)
    slope = precision @ np.append(fit.moved, fit.motion.coefficients - START.shape.body.mean)
    held_mm = held_by_prior_mm(fit.motion, slope)
    assert min(held_mm) > 0.1
    np.testing.assert_allclose(held_mm, np.linalg.norm(away_mm, axis=1) / less, rtol=0.4)
    bent = bend(fit, CONFIG)
    slopes = np.split(bent.prior_slope, [len(slope)])
    np.testing.assert_allclose(slopes[0], slope, atol=0.2 * np.abs(slope).max())
    forces = bent.motion.coefficients[len(fit.motion.coefficients) :]
    np.testing.assert_allclose(slopes[1], forces / bent.compliance_std_mm**2)


def test_what_is_not_seen_is_less_sure():
    bent = bend(refined(seen(placed()), START, CONFIG), CONFIG)
    places = np.array([TOP, CENTER - 0.9 * (TOP - CENTER)])
    across = placed().rotation @ NORMALS[FACING.argmax()]
    near, far = np.sqrt([across @ each @ across for each in bent.motion.covariance_mm2(places)])
    assert far > 1.5 * near > 0


@pytest.mark.parametrize("std_mm", [0.5, 6.0])
def test_the_evidence_is_that_of_all_unknowns(std_mm, monkeypatch):
    monkeypatch.setattr(module, "_LINEAR_STEPS", 40)  # until the weights stay
    fit = refined(seen(pressed(0)), START, CONFIG)
    start = _with_compliance(fit.motion)
    some_mm = fit.looks.points_mm[:: module._EVERY]
    rows, counts = _means_of_groups(start.residual_rows(some_mm), start.back(some_mm))
    slopes, distances_mm = rows[:, :-1], rows[:, -1]
    precision = np.zeros((slopes.shape[1],) * 2)
    known = POSE + len(fit.motion.coefficients)
    precision[:known, :known] = prior_precision(fit.motion.shape, CONFIG)
    precision[known:, known:] = np.eye(len(precision) - known) / std_mm**2
    off = np.zeros(len(precision))
    off[:known] = np.append(fit.moved, fit.motion.coefficients - fit.motion.shape.body.mean)
    weight = module._EVERY * fit.looks.weight(CONFIG) * counts
    change = np.zeros(len(precision))
    for _ in range(40):  # Gauss-Newton steps of all unknowns
        residuals_mm = distances_mm + slopes @ change
        weights = weight / (1 + residuals_mm**2) ** 2
        curvature = slopes.T @ (weights[:, None] * slopes) + precision
        slope = slopes.T @ (weights * residuals_mm) + precision @ (off + change)
        change -= np.linalg.solve(curvature, slope)
    squares = (distances_mm + slopes @ change) ** 2
    expected = weight @ (squares / (1 + squares / 4))
    expected += (off + change) @ precision @ (off + change)
    expected += 0.3 * (np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(precision)[1])
    cost = _Groups.near(fit, start, CONFIG, None).cost(std_mm)
    assert cost == pytest.approx(expected, rel=1e-4)


def test_rivals_and_looks_stay():
    fit = refined(seen(placed()), START, CONFIG)
    rival = fit.motion, 0.2
    fit = replace(fit, motion=replace(fit.motion, rivals=(rival,)))
    bent = bend(fit, CONFIG)
    assert bent.motion.rivals == (rival,)
    assert bent.looks is fit.looks


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
