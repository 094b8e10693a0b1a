"""The registration's parts: distances, motion, refinement."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from elastic_objects import CENTER, RADII, SMALL
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Motion
from tumortrack.core.types import Mesh
from tumortrack.organ.rest_shape import RestShape, distance_of
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import prior_precision
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.search import turned_starts
from warp_objects import (
    ANATOMY,
    PLACE_MM,
    TURNED,
    descent,
    method,
    nudged,
    placed,
    refined,
    shape,
    with_slope,
)

ORGAN = ANATOMY.organ


def inside(count, seed=0):
    """Points (n, 3) of the CT within nine tenths of the organ."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radius = 0.9 * rng.uniform(0, 1, (count, 1)) ** (1 / 3)
    return directions * radius * RADII + CENTER


def surface(motion, count, seed=0):
    """Points of the deformed surface, from all sides, camera frame."""
    rng = np.random.default_rng(seed)
    vertices = ORGAN.vertices_mm[rng.permutation(len(ORGAN.vertices_mm))[:count]]
    return motion.forward(vertices)


START = nudged(placed(), [4.0, -3, 5], [0.1, -0.08, 0.12])


# --- shape ---


def test_a_balls_distance_and_slope_are_the_exact_ones():
    solid, centre = (
        trimesh.creation.icosphere(subdivisions=5, radius=20),
        np.array([100.0, 50, -300]),
    )
    field = distance_of(Mesh(solid.vertices + centre, solid.faces))
    outwards = np.random.default_rng(1).normal(size=(1400, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    radius_mm = np.repeat([12.0, 18.0, 19.5, 20.0, 20.5, 22.0, 26.0], 200)
    points = centre + radius_mm[:, None] * outwards
    distance, slope = with_slope(field, points.astype(np.float32))
    error = np.abs(distance - (radius_mm - 20))
    assert error.reshape(7, -1).mean(1).max() < 0.05
    assert error.max() < 0.2
    assert np.linalg.norm(slope - outwards, axis=1).reshape(7, -1).mean(1).max() < 0.1


def test_a_shape_survives_its_arrays():
    arrays = shape().to_arrays()
    again = RestShape.from_arrays(arrays, 2)
    back = again.to_arrays()
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array, err_msg=name)
    points = inside(200).astype(np.float32)
    np.testing.assert_array_equal(again.labels_at(points)[1], shape().labels_at(points)[1])
    np.testing.assert_allclose(np.abs(again.long_axis_mm), [0, 0, 96], atol=0.01)
    with refused(InputError, "1.values_mm"):
        RestShape.from_arrays({k: v for k, v in arrays.items() if k != "1.values_mm"}, 2)
    for wrong in (arrays["1.values_mm"][:1], np.full_like(arrays["1.values_mm"], np.nan)):
        with pytest.raises(InputError):  # a kernel would read beyond it
            RestShape.from_arrays({**arrays, "1.values_mm": wrong}, 2)


# --- motion ---


def test_the_way_there_and_back_is_none():
    motion = placed()
    assert isinstance(motion, Motion)
    points = CENTER + 1.5 * (inside(500) - CENTER)
    there = motion.forward(points)
    rigid = (points - shape().body.center_ct) @ TURNED.T + PLACE_MM
    assert np.linalg.norm(there - rigid, axis=1).max() > 2  # it deforms
    np.testing.assert_allclose(motion.inverse(there), points, atol=0.02)
    undeformed = placed(share=0.0)
    np.testing.assert_allclose(undeformed.forward(points), rigid, atol=1e-3)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    np.testing.assert_allclose(
        (homogeneous @ motion.camera_from_deformed_ct.T)[:, :3], rigid, atol=1e-9
    )


@pytest.mark.parametrize(
    "way", ["forward", "inverse", "covariance_mm2", "std_mm", "largest_std_mm"]
)
def test_what_is_no_list_of_finite_points_is_refused(way, unchecked):
    """NaN ended the process, and other shapes were read beyond their end."""
    motion, points = dataclasses.replace(placed(), covariance=np.eye(6 + SMALL.modes)), inside(5)
    ask = getattr(motion, way)
    assert np.isfinite(ask(points)).all()
    for wrong in (points[:, :2], points.T, points[0], points[None], np.hstack([points, points])):
        with pytest.raises(InputError):
            ask(wrong)
    points[[1, 3], 0] = np.nan, np.inf
    with refused(InputError, 2, 5):
        ask(points)


# --- refinement ---


def test_more_points_make_surer_and_a_seen_side_is_surer_than_a_hidden_one():
    def deviations(points):
        return refined(points, START).motion.std_mm(inside(100))

    few, more = (deviations(surface(placed(), n)) for n in (60, 300))
    assert np.all(more < few)
    vertices = ORGAN.vertices_mm
    one_end = vertices[vertices[:, 2] > CENTER[2] + 10][::4]
    spread = refined(placed().forward(one_end), START).motion
    ends = CENTER + np.array([[0, 0, 40.0], [0, 0, -40.0]])
    seen, hidden = spread.std_mm(ends)
    assert hidden > 1.5 * seen


@pytest.mark.parametrize(("share", "tolerance"), [(0.0, 0.03), (0.5, 0.3)])
def test_the_derivatives_are_those_of_the_distances(share, tolerance):
    """To first order in the state: exactly so for an organ at rest."""
    motion = placed(share=share)
    points = surface(nudged(motion, [1, 2, -1], [0.02, 0, 0.03]), 400) + 0.3
    state = np.concatenate([np.zeros(6), motion.coefficients])

    def distances(x):
        rotation = TURNED @ Rotation.from_rotvec(x[3:6]).as_matrix()
        moved = ElasticMotion(shape(), rotation, PLACE_MM + TURNED @ x[:3], x[6:])
        rows = moved.residual_rows(points)
        return rows[:, -1], rows[:, :-1]

    _, rows = distances(state)
    assert np.abs(rows).max() > 10  # a turn moves the ends
    step = np.concatenate([np.full(3, 0.05), np.full(3, 0.002), np.full(20, 0.05)])
    for n, size in enumerate(step):
        change = np.zeros(26)
        change[n] = size
        ahead, behind = (distances(state + side * change)[0].astype(float) for side in (1, -1))
        slope = (ahead - behind) / (2 * size)
        wrong = np.linalg.norm(slope - rows[:, n])
        assert wrong < tolerance * max(np.linalg.norm(slope), 0.3 * np.sqrt(len(points))), n


def test_a_known_pose_and_state_are_found_again():
    truth = placed()
    points = surface(truth, 2500)
    seen, unseen = points[:1200], points[1200:]
    fit = refined(seen, START)
    target = inside(200)
    before = np.linalg.norm(START.forward(target) - truth.forward(target), axis=1)
    after = np.linalg.norm(fit.motion.forward(target) - truth.forward(target), axis=1)
    assert before.mean() > 5
    assert after.mean() < 0.8  # an ellipsoid may also be sheared along itself
    distances = shape().distances[0]
    for motion, least, most in ((START, 2, np.inf), (fit.motion, 0, 0.15)):
        off, _ = with_slope(distances, motion.inverse(unseen).astype(np.float32))
        assert least < np.abs(off).mean() < most
    assert np.abs(fit.motion.coefficients - shape().body.mean).max() > 1
    exact = refined(surface(placed(), 1200), placed())
    assert np.abs(exact.distances_mm).mean() < 0.15  # and the truth stays


def test_a_fifth_of_strays_does_not_matter():
    truth, target = placed(), inside(200)
    points = surface(truth, 1000)
    clean = refined(points, START)
    spoiled = points.copy()
    outliers = np.random.default_rng(6).permutation(1000)[:200]
    spoiled[outliers] = PLACE_MM + np.random.default_rng(7).uniform(-80, 80, (200, 3))
    fit = refined(spoiled, START)
    apart = fit.motion.forward(target) - clean.motion.forward(target)
    assert np.linalg.norm(apart, axis=1).mean() < 0.4
    assert np.abs(fit.distances_mm[outliers]).mean() > 10


@pytest.mark.parametrize("times", [0.93, 1.0, 1.07])
def test_a_wrong_scale_of_the_camera_shows_in_the_fit(times):
    config = GaussNewtonConfig()
    points = times * surface(placed(), 1000)
    start = dataclasses.replace(START, centre_mm=times * START.centre_mm)
    fit = refined(points, start, config)
    size = fit.views.apparent_size(fit.motion, config)
    # The robust kernel reads too little.
    assert abs(size.times - times) < 0.6 * abs(times - 1) + 0.01
    assert (size.gain > 9.2) == (times != 1)
    assert size.gain == pytest.approx(((size.times - 1) / size.std) ** 2)


def test_the_best_of_several_starts_wins_wherever_it_stands():
    points = surface(placed(), 500)
    steady = GaussNewtonConfig(steps=40, first_mm=3.0, last_mm=3.0)
    alone, far = refined(points, START, steady), nudged(placed(), [0, 0, 60], [0, 0, 0])
    for starts in ([START, far], [far, START]):
        best = method(steady).best_fit(MultiViewCloud.from_points([points]), starts)
        # A little less where a start beside it ends nearer to the minimum.
        assert 0.97 * alone.cost < best.cost <= alone.cost


def test_starts_beside_a_fit_are_as_unlikely_as_was_asked_and_lead_back_to_it():
    points = surface(placed(), 500)
    fit = refined(points, START)
    starts = turned_starts(fit.motion, fit.pose_offset)
    precision = np.linalg.inv(fit.motion.covariance)
    turns = []
    for start, moved in starts:
        turn = Rotation.from_matrix(fit.motion.rotation.T @ start.rotation).as_rotvec()
        shift = fit.motion.rotation.T @ (start.centre_mm - fit.motion.centre_mm)
        off = np.concatenate([shift, turn, start.coefficients - fit.motion.coefficients])
        assert np.sqrt(off @ precision @ off) == pytest.approx(4.5)
        np.testing.assert_allclose(moved - fit.pose_offset, off[:6], atol=1e-9)
        turns.append(turn)
        again = descent(points, start, GaussNewtonConfig(), moved)
        again.run(20)
        assert again.cost == pytest.approx(fit.cost, rel=0.03)
    turns = np.array(turns)
    np.testing.assert_allclose(turns[::2], -turns[1::2], atol=1e-9)
    assert np.linalg.matrix_rank(turns, tol=1e-3) == 3


def test_a_slow_general_optimiser_finds_the_same():
    config = GaussNewtonConfig(steps=60, enough_mm=1e-4)
    points = surface(placed(), 150) + np.random.default_rng(8).normal(0, 0.5, (150, 3))
    fit = refined(points, START, config)
    root = np.linalg.cholesky(prior_precision(shape(), config)).T
    weight = min(config.n_effective / len(points), 1.0) / config.sigma_mm**2

    def moved(x):
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        centre = START.centre_mm + START.rotation @ x[:3]
        return START.rotation @ turn, centre, x[6:]

    def residuals(x):
        distance = ElasticMotion(shape(), *moved(x)).residual_rows(points)[:, -1].astype(float)
        robust = np.sqrt(weight) * distance / np.sqrt(1 + (distance / config.last_mm) ** 2)
        off = np.concatenate([x[:6], x[6:] - shape().body.mean])
        return np.concatenate([robust, root @ off])

    truth = placed()  # from START it ends far away: nothing widens its kernel
    turn = Rotation.from_matrix(START.rotation.T @ truth.rotation).as_rotvec()
    shift = START.rotation.T @ (truth.centre_mm - START.centre_mm)
    begin = np.concatenate([shift, turn, truth.coefficients])
    scale = np.concatenate([np.ones(3), np.full(3, 0.02), np.ones(20)])
    found = least_squares(residuals, begin, diff_step=1e-2, x_scale=scale)
    slow = ElasticMotion(shape(), *moved(found.x))
    assert fit.cost == pytest.approx(2 * found.cost, rel=0.02)
    away = fit.motion.forward(inside(200)) - slow.forward(inside(200))
    assert np.linalg.norm(away, axis=1).mean() < 0.5
