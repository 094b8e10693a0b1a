"""The registration's kernels against plain forms: flow, sums, chances, rasters; a steady loop."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from elastic_objects import CENTER, RADII
from reports import looked
from tumortrack.core.estimate import FollowOptions
from tumortrack.core.process import parallel_for, parallel_map
from tumortrack.core.types import SensorCloud
from tumortrack.organ.flow import BLOCK, steps_for
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.estimate import look_up, nearest_lookup
from tumortrack.registration.gauss_newton import prior_precision
from tumortrack.registration.locator import RegistrationLocator
from tumortrack.registration.motion import ElasticMotion
from tumortrack.tracking.model_files import load_model
from warp_objects import (
    ANATOMY,
    PLACE_MM,
    TURNED,
    descent,
    nudged,
    placed,
    refined,
    shape,
    with_slope,
)


def about(count, seed=0, reach=1.6):
    """Points (n, 3) of the CT in the organ's box and round it, some beyond the lattice."""
    way = np.random.default_rng(seed).uniform(-reach, reach, (count, 3))
    return (CENTER + way * RADII).astype(np.float32)


def plainly_followed(velocity, points, steps):
    """``flow.follow`` in double precision: one array of all points, steps in a loop."""
    body = shape().body
    axes = [body.origin_mm[a] + body.spacing_mm * np.arange(velocity.shape[a]) for a in range(3)]
    lower, upper = np.array([axis[0] for axis in axes]), np.array([axis[-1] for axis in axes])
    field = RegularGridInterpolator(axes, velocity.astype(float))

    def speed(places):
        return field(np.clip(places, lower, upper - 0.001 * body.spacing_mm))

    places = points.astype(float)
    last, middle = speed(places), None
    for step in range(steps):
        if step == steps // 2:
            middle = places + (0.5 / steps * last if steps % 2 else 0)
        last = speed(places + 0.5 / steps * last)
        places = places + last / steps
    return places, middle


# --- flow ---


@pytest.mark.parametrize("count", [1, BLOCK, 3 * BLOCK + 5, 9000])
def test_points_go_where_a_plain_loop_takes_them(count):
    body, motion = shape().body, placed()
    velocity = (body.modes @ motion.coefficients).astype(np.float32)
    np.testing.assert_allclose(body.velocity(motion.coefficients), velocity, atol=2e-5)
    steps = steps_for(velocity, body.spacing_mm)
    slope = max(np.abs(np.diff(velocity, axis=a)).max() for a in range(3)) / body.spacing_mm
    assert steps == np.clip(np.ceil(10 * slope), 3, 24)
    points = about(count)
    truth, _ = plainly_followed(velocity, points, steps)
    assert np.linalg.norm(truth - points, axis=1).max() > (1 if count > 1 else 0)
    np.testing.assert_allclose(body.follow(velocity, points), truth, atol=2e-4)
    carried = (truth - body.center_ct) @ TURNED.T + PLACE_MM
    np.testing.assert_allclose(motion.forward(points), carried, atol=2e-4)
    rest = body.follow(-velocity, (carried - PLACE_MM) @ TURNED + body.center_ct)
    np.testing.assert_allclose(motion.inverse(carried), rest, atol=2e-4)


def test_parts_are_all_done_once_and_errors_come_back():
    done = np.zeros(10_000, int)
    parallel_for(lambda part: done.__setitem__(part, done[part] + 1), len(done), 300)
    assert (done == 1).all()
    with pytest.raises(ZeroDivisionError):
        parallel_for(lambda part: 1 // (part.start - 9900), len(done), 300)
    assert parallel_map(lambda n: n * n, range(7)) == [0, 1, 4, 9, 16, 25, 36]
    with pytest.raises(ZeroDivisionError):
        parallel_map(lambda n: 1 // n, [2, 1, 0])


# --- refinement ---


@pytest.mark.parametrize("state", [5, 73])
def test_sums_are_those_of_the_rows_and_rows_those_of_plain_arithmetic(state):
    body, motion = shape().body, placed(state)
    points = motion.forward(ANATOMY.organ.vertices_mm[::5]).astype(np.float32)
    points += np.random.default_rng(1).normal(0, 1.5, points.shape).astype(np.float32)
    motion = replace(motion, coefficients=0.9 * motion.coefficients)
    rows = motion.residual_rows(points).astype(float)
    config = GaussNewtonConfig(first_mm=2.0, n_effective=1e6)  # each point weighs one
    begun, precision = descent(points, motion, config), prior_precision(shape(), config)
    begun.run(0)
    equations = begun.state
    np.testing.assert_array_equal(equations.distances_mm, rows[:, -1])
    assert np.abs(equations.distances_mm).max() > 2
    pulled = rows / (1 + (rows[:, -1:] / 2.0) ** 2)
    sums = pulled.T @ pulled
    most = np.abs(sums).max()
    np.testing.assert_allclose(equations.curvature, sums[:-1, :-1] + precision, atol=1e-5 * most)
    from_mean = np.concatenate([np.zeros(6), motion.coefficients - body.mean])
    np.testing.assert_allclose(
        equations.gradient, sums[:-1, -1] + precision @ from_mean, atol=1e-5 * most
    )

    velocity, field = body.velocity(-motion.coefficients), shape().distances[0]
    offsets = (points.astype(float) - motion.centre_mm) @ motion.rotation
    rest, middle = plainly_followed(
        velocity, offsets + body.center_ct, steps_for(velocity, body.spacing_mm)
    )
    distances, outwards = with_slope(field, rest.astype(np.float32))
    np.testing.assert_allclose(rows[:, -1], distances, atol=1e-3)
    by_modes = -np.einsum("ndm,nd->nm", body.modes_at(middle), outwards)
    plain = np.concatenate([-outwards, -np.cross(offsets, outwards), by_modes], axis=1)
    same = np.isclose(rows[:, :-1], plain, atol=0.02).all(1)  # others lie on a cell's border
    assert same.mean() > 0.99


def plainly_refined(points, start, config):
    """``refine`` in a plain loop: pose, coefficients, cost and number of steps."""
    body, precision = shape().body, prior_precision(shape(), config)
    rotation, centre, coefficients = start.rotation, start.centre_mm, start.coefficients
    moved, weight = np.zeros(6), min(config.n_effective / len(points), 1) / config.sigma_mm**2
    step, settled = 0, False
    while True:
        motion = ElasticMotion(shape(), rotation, centre, coefficients)
        rows = motion.residual_rows(points).astype(float)
        width = max(config.last_mm, config.first_mm * config.narrowing**step)
        pulled = rows[:, :-1] / (1 + (rows[:, -1:] / width) ** 2) ** 2
        off = np.concatenate([moved, coefficients - body.mean])
        if settled or step == config.steps:
            square = (rows[:, -1] / config.last_mm) ** 2
            robust = (config.last_mm**2 * square / (1 + square)).sum()
            return (rotation, centre, coefficients), weight * robust + off @ precision @ off, step
        curvature = weight * pulled.T @ rows[:, :-1] + precision
        change = -np.linalg.solve(curvature, weight * pulled.T @ rows[:, -1] + precision @ off)
        centre = centre + rotation @ change[:3]
        rotation = rotation @ Rotation.from_rotvec(change[3:6]).as_matrix()
        coefficients, moved = coefficients + change[6:], moved + change[:6]
        settled = np.abs(change).max() < config.enough_mm and width == config.last_mm
        step += 1


@pytest.mark.parametrize("steps", [0, 20])
def test_a_refinement_is_that_of_a_plain_loop(steps):
    config, start = GaussNewtonConfig(steps=steps), nudged(placed(), [3, -2, 5], [0.1, -0.05, 0.1])
    points = placed().forward(ANATOMY.organ.vertices_mm[::3])
    fit = refined(points, start, config)
    (rotation, centre, coefficients), cost, gone = plainly_refined(points, start, config)
    assert fit.steps == gone
    assert gone < 20
    assert fit.cost == pytest.approx(cost, rel=1e-3)
    np.testing.assert_allclose(fit.motion.rotation, rotation, atol=1e-4)
    np.testing.assert_allclose(fit.motion.centre_mm, centre, atol=2e-3)
    np.testing.assert_allclose(fit.motion.coefficients, coefficients, atol=2e-3)
    np.testing.assert_allclose(fit.motion.rotation @ fit.motion.rotation.T, np.eye(3), atol=1e-9)


def test_a_descent_goes_on_where_it_was_stopped():
    points = placed().forward(ANATOMY.organ.vertices_mm[::3])
    start = nudged(placed(), [3, -2, 5], [0.1, -0.05, 0.1])
    whole = refined(points, start)
    halves = descent(points, start)
    halves.run(2)
    assert halves.cost > 2 * whole.cost
    for steps in (4, 0, 20, 20, 0):
        halves.run(steps)
    again = halves.result()
    assert (again.cost, again.steps) == (whole.cost, whole.steps)
    np.testing.assert_array_equal(again.motion.coefficients, whole.motion.coefficients)
    np.testing.assert_array_equal(again.motion.covariance, whole.motion.covariance)
    assert start.centre_mm[2] == nudged(placed(), [3, -2, 5], [0, 0, 0]).centre_mm[2]


def test_labels_and_margins_are_those_of_the_distances():
    points = about(9000, 4)
    labels, margin_mm = shape().labels_at(points)
    distances = np.stack([with_slope(field, points)[0] for field in shape().distances])
    plain = np.where(distances[1] < 0, 2, (distances[0] < 0).astype(int))
    assert set(np.unique(plain)) == {0, 1, 2}
    np.testing.assert_allclose(margin_mm, np.abs(distances).min(0), atol=1e-5)
    clear = margin_mm > 1e-5
    assert clear.mean() > 0.999
    np.testing.assert_array_equal(labels[clear], plain[clear])


def test_the_nearest_place_is_nearest_but_for_a_nodes_width():
    places, points = CENTER + np.random.default_rng(5).uniform(-1, 1, (200, 3)) * RADII, about(3000)
    points = points[((points > places.min(0)) & (points < places.max(0))).all(1)]
    found = np.linalg.norm(points - places[look_up(*nearest_lookup(places), points)], axis=1)
    apart = np.linalg.norm(points[:, None] - places, axis=2).min(1)
    assert (found <= apart + 2 * np.sqrt(3)).all()
    assert np.mean(found == apart.astype(found.dtype)) > 0.6


def test_covariances_follow_from_where_small_changes_take_points():
    """Finite differences of ``forward`` by each unknown; modes halfway are of first order."""
    points, mixed = about(60, 4, 0.9), np.random.default_rng(3).normal(size=(26, 26)) * 0.05
    base = replace(placed(share=0.3), covariance=mixed @ mixed.T)
    slopes, small = [], 1e-2
    for unit in np.eye(26) * small:
        ahead, behind = (
            replace(
                base,
                rotation=base.rotation @ Rotation.from_rotvec(sign * unit[3:6]).as_matrix(),
                centre_mm=base.centre_mm + sign * base.rotation @ unit[:3],
                coefficients=base.coefficients + sign * unit[6:],
            ).forward(points)
            for sign in (1, -1)
        )
        slopes.append((ahead - behind) / (2 * small))
    expected = np.einsum("pna,pq,qnb->nab", slopes, base.covariance, slopes)
    found = base.covariance_mm2(points)
    apart = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert apart.max() < 0.05
    variances = np.linalg.eigvalsh(found)
    assert variances[:, 2].max() > 2 * variances[:, 0].max()
    np.testing.assert_allclose(base.std_mm(points), np.sqrt(variances.mean(1)), rtol=1e-6)
    np.testing.assert_allclose(base.largest_std_mm(points), np.sqrt(variances[:, 2]), rtol=1e-6)
    scaled = replace(base, std_scale=2.5)
    np.testing.assert_allclose(scaled.std_mm(points), 2.5 * base.std_mm(points))
    many = base.covariance_mm2(np.tile(points, (100, 1)))  # on several threads
    np.testing.assert_allclose(many, np.tile(found, (100, 1, 1)), rtol=1e-4, atol=1e-6)


def test_the_covariance_of_poses_follows_from_what_small_changes_do():
    """Finite differences of place and turn by each unknown; far fits and the depths widen it."""
    points, mixed = about(9, 4, 0.9), np.random.default_rng(3).normal(size=(26, 26)) * 0.05
    base = replace(placed(share=0.3), covariance=mixed @ mixed.T, std_scale=1.3)
    slopes, small = [], 1e-2
    for unit in np.eye(26) * small:
        ways = []
        for changed in (base.changed(unit), base.changed(-unit)):
            turn = Rotation.from_matrix(changed.rotation @ base.rotation.T).as_rotvec()
            ways.append(np.hstack([changed.forward(points), np.tile(turn, (len(points), 1))]))
        slopes.append((ways[0] - ways[1]) / (2 * small))
    expected = 1.3**2 * np.einsum("pna,pq,qnb->nab", slopes, base.covariance, slopes)
    found = base.pose_covariance(points)
    apart = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert apart.max() < 0.05
    np.testing.assert_allclose(found[:, 3:, 3:], expected[:, 3:, 3:], rtol=1e-4, atol=1e-9)
    other = nudged(base, [3, -2, 5], [0.1, -0.05, 0.1])
    wider = replace(base, alternatives=((other, 0.2),), depth_share=0.01).pose_covariance(points)
    assert np.linalg.eigvalsh(wider - found).min() > -1e-9
    turn = base.rotation @ [0.1, -0.05, 0.1]
    more = (wider - found)[:, 3:, 3:] / 1.3**2
    np.testing.assert_allclose(more, np.tile(0.2 * np.outer(turn, turn), (9, 1, 1)), atol=1e-6)
    assert replace(base, covariance=None).pose_covariance(points) is None


# --- frames ---


def test_frames_leave_no_memory_behind(slim_model, unchecked):
    locator = RegistrationLocator(load_model(slim_model, "cpu"))
    vertices = placed().forward(ANATOMY.organ.vertices_mm)
    seen = vertices[vertices[:, 2] < np.median(vertices[:, 2])]
    rng, last, sizes = np.random.default_rng(0), None, []
    tracemalloc.start()
    for frame in range(60):
        cloud = (seen + rng.normal(0, 0.2, 3)).astype(np.float32)
        last = locator.follow(looked(SensorCloud(cloud, frame)), last, FollowOptions())
        sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert "follow" in last.report.timings
    # A leak shows in every stretch of twenty frames; what another thread holds for a moment, or
    # something loaded once, in twenty stretches at most.
    grown = np.subtract(sizes[35:], sizes[15:-20])
    # One cloud a frame that stayed would be 240,000.
    assert np.quantile(grown, 0.25) < 60_000
