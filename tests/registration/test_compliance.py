"""The fit with compliance: what the library's states cannot follow."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from elastic_objects import CENTER, RADII
from tumortrack.core.evidence import Landmark, Touch
from tumortrack.organ.rest_shape import error_covariance_mm2
from tumortrack.registration.compliance import (
    Groups,
    Linear,
    Means,
    RefinedFit,
    refine_compliance,
    with_compliance,
)
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.evidence import EvidenceTerms
from tumortrack.registration.gauss_newton import GaussNewton, prior_precision, refine
from tumortrack.registration.motion import POSE
from tumortrack.registration.multi_view import MultiViewCloud
from warp_objects import ANATOMY, nudged, placed, refined

CONFIG = GaussNewtonConfig()
VERTICES = ANATOMY.organ.vertices_mm
START = nudged(placed(), [2.0, -1, 3], [0.03, -0.04, 0.05])
# The camera sees the half towards its origin; TOP is the middle of it.
NORMALS = (VERTICES - CENTER) / RADII**2
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)
PLACES = placed().forward(VERTICES)
FACING = -((NORMALS @ placed().rotation.T) * PLACES).sum(1) / np.linalg.norm(PLACES, axis=1)
TOP = VERTICES[FACING.argmax()]


def pressed(seed):
    """The organ under forces in many places, which the library does not have."""
    motion = with_compliance(placed())
    forces = np.random.default_rng(seed).normal(0, 8, motion.shape.body.compliance.shape[-1])
    forces[:12] = 0  # the smoothest, which the library has as well
    return motion.changed(np.concatenate([np.zeros(POSE + len(placed().coefficients)), forces]))


def seen(motion, noise_mm=0.15):
    """The visible half."""
    moved = motion.forward(VERTICES)
    return (moved + np.random.default_rng(0).normal(0, noise_mm, moved.shape))[FACING > 0.2]


def test_a_state_of_the_library_stays_as_it_is_with_its_alternatives():
    fit = refined(seen(placed()), START, CONFIG)
    alternative = fit.motion, 0.2
    fit = replace(fit, motion=replace(fit.motion, alternatives=(alternative,)))
    compliant = refine_compliance(fit, CONFIG)
    assert compliant.compliance_std_mm == 0.5
    assert compliant.motion.alternatives == (alternative,)
    off = [
        np.linalg.norm(m.forward(VERTICES) - PLACES, axis=1) for m in (fit.motion, compliant.motion)
    ]
    assert off[1].mean() < off[0].mean()
    assert off[1].max() < off[0].max()
    places = np.array([TOP, CENTER - 0.9 * (TOP - CENTER)])  # seen, and not
    across, motion = (
        placed().rotation @ NORMALS[FACING.argmax()],
        replace(compliant.motion, alternatives=()),
    )
    near, far = np.sqrt([across @ each @ across for each in motion.covariance_mm2(places)])
    assert far > 1.5 * near > 0


def test_forces_anywhere_are_followed_where_they_are_seen():
    left_mm, stds_mm = [], []
    for seed in range(6):
        fit = refined(seen(pressed(seed)), START, CONFIG)
        compliant = refine_compliance(fit, CONFIG)
        stds_mm.append(compliant.compliance_std_mm)
        left_mm.append([np.abs(each.distances_mm).mean() for each in (fit, compliant)])
    of_library, of_refined = np.mean(left_mm, axis=0)
    assert of_refined < 0.7 * of_library
    assert sum(std_mm > 0.5 for std_mm in stds_mm) >= 5  # or by states that spread farther


def test_how_far_the_prior_holds_a_part_is_how_far_it_moves_without_some_of_it():
    views = MultiViewCloud.from_points([seen(placed(share=1.5), 0.0)])
    near = msgspec.structs.replace(CONFIG, first_mm=CONFIG.last_mm, enough_mm=1e-4)
    fit = refine(START.shape, views, START, near)
    middles_ct, precision = fit.motion.shape.middles_ct, prior_precision(START.shape, CONFIG)
    less = 0.05
    more, body, mean = (1 - less) ** -0.5, START.shape.body, START.shape.body.mean
    states = (mean + more * (body.states - mean)).astype(np.float32)
    wider = replace(START.shape, body=replace(body, states=states))
    wide = {name: more * getattr(near, name) for name in ("shift_mm", "turn_rad")}
    wide = msgspec.structs.replace(near, **wide)
    np.testing.assert_allclose(prior_precision(wider, wide), (1 - less) * precision, rtol=0.02)
    freer = GaussNewton(wider, views, fit.motion, wide, fit.pose_offset)
    freer.run(40)
    away_mm = freer.result().motion.forward(middles_ct) - fit.motion.forward(middles_ct)
    slope = precision @ np.append(fit.pose_offset, fit.motion.coefficients - START.shape.body.mean)
    held_mm = RefinedFit(
        fit.motion, views, fit.distances_mm, 1, 0.5, 0.1, slope, None
    ).prior_pull_mm
    assert min(held_mm) > 0.1
    np.testing.assert_allclose(held_mm, np.linalg.norm(away_mm, axis=1) / less, rtol=0.4)


def test_an_organ_near_the_mean_has_a_narrow_prior_and_one_far_off_a_wide_one():
    spreads = []
    for share in (0.0, 1.0, 2.5):
        fit = refined(seen(placed(share=share)), START, CONFIG)
        start = with_compliance(fit.motion)
        near, points_ct = fit.views.residuals(start, CONFIG), start.inverse(fit.views.points_mm)
        groups = Groups.near(fit, Means.from_residuals(near, points_ct), CONFIG, None, 0.4)
        spreads.append(groups.select_best()[1])
    assert spreads[0] < 0.9
    assert spreads == sorted(spreads)
    assert spreads[2] > 1.2


@pytest.mark.parametrize("std_mm", [0.5, 6.0])
def test_the_evidence_is_that_of_all_unknowns(std_mm):
    fit = refined(seen(pressed(0)), START, CONFIG)
    start, scale = with_compliance(fit.motion), 0.7
    near = fit.views.residuals(start, CONFIG)
    means = Means.from_residuals(near, start.inverse(fit.views.points_mm))
    rows = means.rows
    motion, field = rows[:, :-1], np.eye(len(rows))  # what neighbours share: an unknown a group
    slopes, distances_mm = np.concatenate([motion, field], axis=1), rows[:, -1]
    precision = np.zeros((slopes.shape[1],) * 2)
    known, count = POSE + len(fit.motion.coefficients), motion.shape[1]
    precision[:known, :known] = prior_precision(fit.motion.shape, CONFIG)
    precision[known:count, known:count] = np.eye(count - known) / std_mm**2
    shared = scale**2 * error_covariance_mm2(means.middles_ct) + 1e-9 * field
    precision[count:, count:] = np.linalg.inv(shared)
    off = np.zeros(len(precision))
    off[:known] = np.append(fit.pose_offset, fit.motion.coefficients - fit.motion.shape.body.mean)
    weight = fit.views.weight(CONFIG) * means.counts
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
    expected += np.linalg.slogdet(curvature)[1] - np.linalg.slogdet(precision)[1]
    cost = Groups.near(fit, means, CONFIG, None, scale).cost(std_mm, steps=40)
    assert cost == pytest.approx(expected, rel=1e-3)


def test_what_neighbours_and_tools_share_is_as_if_it_were_unknown():
    fit = refined(seen(pressed(1)), START, CONFIG)
    start, scale = with_compliance(fit.motion), 0.7
    how = {"std_mm": 0.8, "shared_std_mm": 1.5}
    touches = [Touch(place_mm=tuple(p), tool="a", **how) for p in PLACES[FACING < -0.2][::300]]
    inner = CENTER + [5.0, 0, 3]
    touches.append(
        Landmark(point_ct=tuple(inner), place_mm=tuple(start.forward(inner[None])[0]), **how)
    )
    evidence = EvidenceTerms.from_evidence(touches, ("kidney", "tumor_1"))
    views = replace(fit.views, evidence=evidence)
    near, terms = views.residuals(start, CONFIG), evidence.at(start)
    count = near.by_motion.shape[1]
    precision = np.eye(count)
    at = Linear.at(start, fit.pose_offset, near, views, precision, terms, scale)
    error = start.shape.model_error
    places = np.concatenate([views.points_mm, evidence.places_mm])
    field = np.eye(len(error.nodes_ct))[error.nearest(start.inverse(places))]
    nodes, tools, points = field.shape[1], terms.by_shifts.shape[1], len(views.points_mm)
    shifts = np.concatenate([np.zeros((points, tools)), terms.by_shifts])
    rows = np.concatenate([near.by_motion, terms.by_motion])
    every = np.zeros((len(rows), count + nodes + tools))
    every[:, :count], every[:, count + nodes :] = rows, shifts
    every[: len(field), count : count + nodes] = field  # a landmark lies on no surface
    weights = np.append(near.weights, terms.weights)
    whole = every.T @ (every * weights[:, None])
    whole[:count, :count] += precision
    whole[count : count + nodes, count : count + nodes] += error.precision / scale**2
    whole[count + nodes :, count + nodes :] += np.eye(tools)
    inverse = np.linalg.inv(whole)[:count, :count]
    np.testing.assert_allclose(np.linalg.inv(at.curvature), inverse, rtol=1e-5, atol=1e-8)
    off_mm = np.append(near.distances_mm, terms.residuals_mm)
    slope = every.T @ (weights * off_mm)
    slope[:count] += np.append(fit.pose_offset, start.coefficients - start.shape.body.mean)
    step = np.linalg.solve(whole, slope)[:count]
    np.testing.assert_allclose(
        np.linalg.solve(at.curvature, at.gradient), step, rtol=1e-4, atol=1e-7
    )
