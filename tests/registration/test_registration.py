"""The canonical warp's parts: distances, motion, refinement, network, height map."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from itertools import pairwise

import msgspec
import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from elastic_objects import CENTER, RADII, SMALL, UP
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Motion
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.models.encoders.heightmap import HeightMapConfig, _spread, picture
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.registration.gauss_newton import GaussNewton, _prior, refine, size_of
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import PoseHypothesis, RegistrationNetwork
from tumortrack.registration.registration import Registration, _beside
from tumortrack.registration.rest_shape import RestShape, distance_of, shape_of
from tumortrack.simulate.elastic.body import build_body
from tumortrack.simulate.occupancy import labels_of, surface_distance
from tumortrack.training.presets import quick_network
from warp_objects import (
    ANATOMY,
    PLACE_MM,
    TURNED,
    nudged,
    placed,
    residual_rows,
    shape,
    slim_network,
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
    return motion.carry(vertices)


START = nudged(placed(), [4.0, -3, 5], [0.1, -0.08, 0.12])


# --- shape ---


@pytest.fixture(scope="module")
def ball():
    """Centre, radius and field of a ball."""
    solid = trimesh.creation.icosphere(subdivisions=5, radius=20)
    centre = np.array([100.0, 50, -300])
    return centre, 20.0, distance_of(Mesh(solid.vertices + centre, solid.faces))


@pytest.mark.parametrize("radius_mm", [12.0, 18.0, 19.5, 20.0, 20.5, 22.0, 26.0])
def test_a_balls_distance_and_slope_are_the_exact_ones(ball, radius_mm):
    centre, radius, field = ball
    outwards = np.random.default_rng(1).normal(size=(2000, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    points = (centre + radius_mm * outwards).astype(np.float32)
    distance, slope = with_slope(field, points)
    error = distance - (radius_mm - radius)
    assert np.abs(error).mean() < 0.05
    assert np.abs(error).max() < 0.2
    along = (slope * outwards).sum(1)
    assert np.abs(along - 1).mean() < 0.05
    assert np.linalg.norm(slope - outwards, axis=1).mean() < 0.1


def test_slopes_are_the_derivatives_of_the_distance(ball):
    centre, _, field = ball
    points = (centre + np.random.default_rng(2).uniform(-20, 20, (500, 3))).astype(np.float32)
    _, slope = with_slope(field, points)
    small = 0.02  # mm; few points cross into the next cell
    for axis, unit in enumerate(np.eye(3, dtype=np.float32)):
        ahead, behind = (with_slope(field, points + side * small * unit)[0] for side in (1, -1))
        wrong = np.abs((ahead - behind) / (2 * small) - slope[:, axis])
        assert np.quantile(wrong, 0.85) < 2e-3
        assert np.abs(slope[:, axis]).max() > 0.9


def test_labels_are_those_of_the_surfaces():
    points = (CENTER + np.random.default_rng(3).uniform(-1.1, 1.1, (4000, 3)) * RADII).astype(
        np.float32
    )
    labels, margin_mm = shape().labels_at(points)
    truth = labels_of(ANATOMY, points)
    clear = np.min([surface_distance(part, points) for part in ANATOMY.parts], axis=0) > 0.5
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(labels[clear], truth[clear])
    assert set(labels) == {0, 1, 2}
    assert margin_mm.min() >= 0
    label, margin = shape().labels_at((CENTER + np.array([[0, -8, 20]])).astype(np.float32))
    assert label == 2
    assert margin == pytest.approx(11, abs=0.2)  # the tumor's radius, from its middle


def test_a_shape_survives_its_arrays():
    arrays = shape().to_arrays()
    again = RestShape.from_arrays(arrays, 2)
    back = again.to_arrays()
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(back[name], array, err_msg=name)
    points = inside(200).astype(np.float32)
    np.testing.assert_array_equal(again.labels_at(points)[1], shape().labels_at(points)[1])
    np.testing.assert_array_equal(again.long_axis, shape().long_axis)
    assert again.half_turns is arrays["half_turns"]  # not found anew, which takes 0.2 s
    assert len(again.half_turns)
    for damaged in (np.full((1, 4, 4), np.nan), np.eye(4)):
        with pytest.raises(InputError, match="half turns are damaged"):
            RestShape.from_arrays({**arrays, "half_turns": damaged}, 2)
    for name in ("1.values_mm", "half_turns"):
        with pytest.raises(InputError, match=name):
            RestShape.from_arrays({k: v for k, v in arrays.items() if k != name}, 2)


def test_the_long_axis_is_the_ellipsoids():
    assert abs(shape().long_axis[2]) == pytest.approx(1, abs=1e-6)


# --- motion ---


def test_the_way_there_and_back_is_none():
    motion = placed()
    assert isinstance(motion, Motion)
    points = CENTER + 1.5 * (inside(500) - CENTER)
    there = motion.carry(points)
    rigid = (points - shape().body.center_ct) @ TURNED.T + PLACE_MM
    assert np.linalg.norm(there - rigid, axis=1).max() > 2  # it deforms
    np.testing.assert_allclose(motion.back(there), points, atol=0.02)
    undeformed = placed(share=0.0)
    np.testing.assert_allclose(undeformed.carry(points), rigid, atol=1e-3)
    homogeneous = np.column_stack([points, np.ones(len(points))])
    np.testing.assert_allclose((homogeneous @ motion.camera_from_ct.T)[:, :3], rigid, atol=1e-9)


@pytest.mark.parametrize("way", ["carry", "back", "covariance_mm2", "std_mm", "largest_std_mm"])
def test_what_is_no_list_of_finite_points_is_refused(way, unchecked):
    """NaN ended the process, and other shapes were read beyond their end."""
    motion, points = dataclasses.replace(placed(), covariance=np.eye(6 + SMALL.modes)), inside(5)
    ask = getattr(motion, way)
    assert np.isfinite(ask(points)).all()
    for wrong in (points[:, :2], points.T, points[0], points[None], np.hstack([points, points])):
        with pytest.raises(InputError, match="points are n x 3"):
            ask(wrong)
    points[[1, 3], 0] = np.nan, np.inf
    with pytest.raises(InputError, match="2 of 5 points have NaN or infinity"):
        ask(points)


def test_a_librarys_states_have_a_rarity_of_one_on_average():
    rarities = [placed(state).rarity for state in range(len(shape().body.states))]
    assert np.mean(rarities) == pytest.approx(1, abs=0.03)
    assert max(rarities) > 2
    mean = dataclasses.replace(placed(), coefficients=shape().body.mean)
    assert mean.rarity == 0


def test_standard_deviations_are_those_of_random_motions():
    base = placed()
    rng = np.random.default_rng(4)
    size = np.concatenate([np.full(3, 0.3), np.full(3, 0.008), np.full(20, 0.15)])
    mixed = rng.normal(size=(26, 26)) * size[:, None] / 5
    covariance = mixed @ mixed.T + np.diag((0.3 * size) ** 2)
    points = inside(40)
    told = dataclasses.replace(base, covariance=covariance).std_mm(points)
    places = []
    for change in rng.multivariate_normal(np.zeros(26), covariance, 600):
        turn = Rotation.from_rotvec(change[3:6]).as_matrix()
        moved = ElasticMotion(
            base.shape,
            base.rotation @ turn,
            base.centre_mm + base.rotation @ change[:3],
            base.coefficients + change[6:],
        )
        places.append(moved.carry(points))
    found = np.sqrt(np.var(places, axis=0).mean(1))
    assert told.max() > 1.3 * told.min()
    np.testing.assert_allclose(told, found, rtol=0.12)
    assert np.mean(told / found) == pytest.approx(1, abs=0.05)
    scaled = dataclasses.replace(base, covariance=covariance, std_scale=2.5).std_mm(points)
    np.testing.assert_allclose(scaled, 2.5 * told)
    assert base.std_mm(points) is None
    many = dataclasses.replace(base, covariance=covariance).std_mm(np.tile(points, (150, 1)))
    np.testing.assert_allclose(many.reshape(150, 40), np.tile(told, (150, 1)), rtol=1e-4)


# --- refinement ---


def test_more_points_make_surer_and_a_seen_side_is_surer_than_a_hidden_one():
    def deviations(points):
        return refine(shape(), points, START, GaussNewtonConfig()).motion.std_mm(inside(100))

    few, more = (deviations(surface(placed(), n)) for n in (60, 300))
    assert np.all(more < few)
    vertices = ORGAN.vertices_mm
    one_end = vertices[vertices[:, 2] > CENTER[2] + 10][::4]
    spread = refine(shape(), placed().carry(one_end), START, GaussNewtonConfig()).motion
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
        rows = residual_rows(points, (rotation, PLACE_MM + TURNED @ x[:3], x[6:]))
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
    fit = refine(shape(), seen, START, GaussNewtonConfig())
    target = inside(200)
    before = np.linalg.norm(START.carry(target) - truth.carry(target), axis=1)
    after = np.linalg.norm(fit.motion.carry(target) - truth.carry(target), axis=1)
    assert before.mean() > 5
    assert after.mean() < 0.8  # an ellipsoid may also be sheared along itself
    distances = shape().distances[0]
    for motion, least, most in ((START, 2, np.inf), (fit.motion, 0, 0.15)):
        off, _ = with_slope(distances, motion.back(unseen).astype(np.float32))
        assert least < np.abs(off).mean() < most
    assert np.abs(fit.motion.coefficients - shape().body.mean).max() > 1
    exact = refine(shape(), surface(placed(), 1200), placed(), GaussNewtonConfig())
    assert np.abs(exact.distances_mm).mean() < 0.15  # and the truth stays


def test_a_fifth_of_strays_does_not_matter():
    truth, target = placed(), inside(200)
    points = surface(truth, 1000)
    clean = refine(shape(), points, START, GaussNewtonConfig())
    spoiled = points.copy()
    strays = np.random.default_rng(6).permutation(1000)[:200]
    spoiled[strays] = PLACE_MM + np.random.default_rng(7).uniform(-80, 80, (200, 3))
    fit = refine(shape(), spoiled, START, GaussNewtonConfig())
    apart = fit.motion.carry(target) - clean.motion.carry(target)
    assert np.linalg.norm(apart, axis=1).mean() < 0.4
    assert np.abs(fit.distances_mm[strays]).mean() > 10


def test_an_end_of_the_organ_is_found_all_around_a_misleading_start(unchecked):
    vertices = ORGAN.vertices_mm
    seen = vertices[(vertices[:, 2] > CENTER[2]) & (placed().carry(vertices)[:, 2] < PLACE_MM[2])]
    points = placed().carry(seen[np.random.default_rng(9).permutation(len(seen))[:800]])
    across = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    middle = points.mean(0) + [0, 0, 15]
    start = dataclasses.replace(placed(), rotation=across @ TURNED, centre_mm=middle)
    method = Registration(None, shape(), GaussNewtonConfig())
    alone, around = (method.best_fit(points, [start], usual) for usual in (np.inf, 0.0))
    truth = refine(shape(), points, placed(), GaussNewtonConfig())
    assert alone.cost > 2 * truth.cost
    assert around.cost < 1.1 * truth.cost
    assert method.best_fit(points, [placed()], 0.0).cost <= truth.cost


def test_an_organ_that_was_turned_over_is_found_where_that_may_have_happened(unchecked):
    def bent(mesh):
        bend = 16 * ((mesh.vertices_mm[:, 2] - CENTER[2]) / RADII[2]) ** 2
        return mesh.moved(mesh.vertices_mm + np.outer(bend, [0.0, 1.0, 0.0]))

    banana = Anatomy(tuple(bent(part) for part in ANATOMY.parts))
    rest = shape_of(banana, build_body(banana, UP, SMALL, 3))
    rest = dataclasses.replace(rest, half_turns=np.zeros((0, 4, 4)))
    truth = ElasticMotion(rest, TURNED, PLACE_MM, rest.body.mean)
    places = truth.carry(banana.organ.vertices_mm)
    seen = places[places[:, 2] < PLACE_MM[2] - 4]
    points = seen[np.random.default_rng(9).permutation(len(seen))[:800]]
    over = Rotation.from_rotvec(np.pi * rest.long_axis).as_matrix()
    wrong = dataclasses.replace(truth, rotation=TURNED @ over)
    target, config = banana.tumors[0].vertices_mm, GaussNewtonConfig()
    methods = [Registration(None, rest, config, either_side=side) for side in (False, True)]
    off_mm = [
        np.linalg.norm(fit.motion.carry(target) - truth.carry(target), axis=1).mean()
        for fit in (method.best_fit(points, [wrong], 0.0) for method in methods)
    ]
    assert off_mm[0] > 10 * off_mm[1]
    assert off_mm[1] < 1.5


@pytest.mark.parametrize("times", [0.93, 1.0, 1.07])
def test_a_wrong_scale_of_the_camera_shows_in_the_fit(times):
    config = GaussNewtonConfig()
    points = times * surface(placed(), 1000)
    start = dataclasses.replace(START, centre_mm=times * START.centre_mm)
    found, gain = size_of(refine(shape(), points, start, config), Looks.of([points]), config)
    assert abs(found - times) < 0.6 * abs(times - 1) + 0.01  # the robust kernel reads too little
    assert (gain > 9.2) == (times != 1)


def test_every_step_lowers_the_cost_and_enough_steps_end(unchecked):
    points = surface(placed(), 500)
    steady = GaussNewtonConfig(steps=40, first_mm=3.0, last_mm=3.0)
    fits = [
        refine(shape(), points, START, msgspec.structs.replace(steady, steps=n))
        for n in (0, 1, 2, 4, 40)
    ]
    costs = [fit.cost for fit in fits]
    assert all(after < before for before, after in pairwise(costs[:4]))
    assert costs[4] <= costs[3] * 1.001
    assert costs[4] < 0.1 * costs[0]
    assert fits[4].steps < 40
    best = Registration(None, shape(), steady).best_fit(
        points, [nudged(placed(), [0, 0, 60], [0, 0, 0]), START]
    )
    alone = refine(shape(), points, START, steady)
    assert 0.97 * alone.cost < best.cost <= alone.cost


def test_starts_beside_a_fit_are_as_unlikely_as_was_asked_and_lead_back_to_it(unchecked):
    points = surface(placed(), 500)
    fit = refine(shape(), points, START, GaussNewtonConfig())
    starts = _beside(fit)
    precision = np.linalg.inv(fit.motion.covariance)
    turns = []
    for start, moved in starts:
        turn = Rotation.from_matrix(fit.motion.rotation.T @ start.rotation).as_rotvec()
        shift = fit.motion.rotation.T @ (start.centre_mm - fit.motion.centre_mm)
        off = np.concatenate([shift, turn, start.coefficients - fit.motion.coefficients])
        assert np.sqrt(off @ precision @ off) == pytest.approx(4.5)
        np.testing.assert_allclose(moved - fit.moved, off[:6], atol=1e-9)
        turns.append(turn)
        again = GaussNewton(shape(), points, start, GaussNewtonConfig(), moved)
        again.run(20)
        assert again.cost == pytest.approx(fit.cost, rel=0.03)
    turns = np.array(turns)
    np.testing.assert_allclose(turns[::2], -turns[1::2], atol=1e-9)
    assert np.linalg.matrix_rank(turns, tol=1e-3) == 3


def test_a_slow_general_optimiser_finds_the_same():
    config = GaussNewtonConfig(steps=60, enough_mm=1e-4)
    points = surface(placed(), 150) + np.random.default_rng(8).normal(0, 0.5, (150, 3))
    fit = refine(shape(), points, START, config)
    root = np.linalg.cholesky(_prior(shape(), config)).T
    weight = min(config.n_effective / len(points), 1.0) / config.sigma_mm**2

    def moved(x):
        turn = Rotation.from_rotvec(x[3:6]).as_matrix()
        centre = START.centre_mm + START.rotation @ x[:3]
        return START.rotation @ turn, centre, x[6:]

    def residuals(x):
        distance = residual_rows(points, moved(x))[:, -1].astype(float)
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
    apart = fit.motion.carry(inside(200)) - slow.carry(inside(200))
    assert np.linalg.norm(apart, axis=1).mean() < 0.5


# --- network ---


def taught(seed=0):
    torch.manual_seed(seed)
    network = RegistrationNetwork(slim_network())
    network.initialize(shape(), UP, inside(96))
    return network


def clouds(count=4, n=400):
    """One side of the organ in different states and poses; and those poses."""
    rng = np.random.default_rng(9)
    points, poses, places = [], [], []
    for state in range(count):
        turn = Rotation.from_euler("zx", rng.uniform([-3, -0.3], [3, 0.3])).as_matrix()
        motion = placed(state)
        motion = dataclasses.replace(motion, rotation=turn @ TURNED)
        seen = motion.carry(ORGAN.vertices_mm)
        seen = seen[seen[:, 2] < np.median(seen[:, 2])]
        points.append(seen[rng.permutation(len(seen))[:n]])
        poses.append(motion.camera_from_ct)
        places.append(motion.carry(inside(96)))
    return tuple(torch.tensor(np.array(v), dtype=torch.float32) for v in (points, poses, places))


def test_the_network_knows_what_it_was_told():
    network = taught()
    body = shape().body
    np.testing.assert_allclose(network.center_ct, body.center_ct, rtol=1e-6)
    np.testing.assert_allclose(network.points + network.center_ct, inside(96), atol=1e-3)
    np.testing.assert_allclose(network.std, body.states.std(0), rtol=1e-5)
    np.testing.assert_allclose(
        network.modes @ network.mean, body.modes_at(inside(96)) @ body.mean, atol=1e-4
    )
    facing = network.facing.numpy()
    np.testing.assert_allclose(facing @ np.array(UP), [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(facing @ facing.T, np.eye(3), atol=1e-6)
    assert {"center_ct", "modes", "long_axis"} <= network.state_dict().keys()  # they travel along
    with pytest.raises(InputError, match="decoder `warp`"):
        RegistrationNetwork(quick_network(3, 48.0))
    with pytest.raises(InputError, match="decoder of queries"):
        OccupancyNetwork(slim_network())


@pytest.mark.parametrize("degrees", [20.0, 90.0, 200.0])
def test_placements_move_with_the_cloud(degrees):
    network = taught().eval()
    points_mm, _, _ = clouds()
    turn = torch.tensor(
        Rotation.from_euler("z", degrees, degrees=True).as_matrix(), dtype=torch.float32
    )
    shift_mm = torch.tensor([12.0, -30.0, 60.0])
    with torch.no_grad():
        before = network(network.align(points_mm))
        after = network(network.align(points_mm @ turn.T + shift_mm))
    close = {"atol": 2e-2, "rtol": 0}
    torch.testing.assert_close(after.centre_mm, before.centre_mm @ turn.T + shift_mm, **close)
    torch.testing.assert_close(after.rotation, turn @ before.rotation, atol=2e-3, rtol=0)
    torch.testing.assert_close(after.coefficients, before.coefficients, **close)
    torch.testing.assert_close(after.right_way, before.right_way, **close)
    products = before.rotation @ before.rotation.transpose(1, 2)
    torch.testing.assert_close(products, torch.eye(3).expand(4, 3, 3), atol=1e-5, rtol=0)
    assert before.coefficients.std(0).max() > 1e-3  # the clouds matter


def test_of_two_ways_round_one_is_right():
    network = taught()
    points_mm, poses, _ = clouds()
    aligned = network.align(points_mm)
    sign = network.flip_sign(aligned, poses[:, :3, :3])
    assert set(sign.tolist()) <= {-1.0, 1.0}
    right = aligned.flipped(sign)
    assert network.flip_sign(right, poses[:, :3, :3]).tolist() == [1.0] * 4
    wrong = aligned.flipped(-sign)
    assert network.flip_sign(wrong, poses[:, :3, :3]).tolist() == [-1.0] * 4
    half_turn = torch.tensor([-1.0, -1.0, 1.0])
    torch.testing.assert_close(wrong.points, right.points * half_turn)
    one, other = network.flip_hypotheses(points_mm).centre_mm.split(len(points_mm))
    assert not torch.allclose(one, other, atol=1e-2)


@pytest.mark.parametrize(("off_mm", "expected"), [(0.0, 0.0), (10.0, 11.25), (3.0, 1.35)])
def test_the_loss_is_nothing_at_the_truth_and_known_beside_it(monkeypatch, off_mm, expected):
    network = taught()
    points_mm, poses, _ = clouds()
    coefficients = torch.tensor(shape().body.states[:4])
    moved = network.points + torch.einsum("pdm,bm->bpd", network.modes, coefficients)
    rotation = poses[:, :3, :3]
    centre = rotation @ network.center_ct + poses[:, :3, 3]
    places = moved @ rotation.transpose(1, 2) + centre[:, None]

    def at_the_truth(aligned):
        few = len(aligned.centre_mm)
        sure = torch.full((few,), 30.0 if few == 4 else -30.0)
        shifted = centre[:few] + torch.tensor([0.0, 0.0, off_mm])
        return PoseHypothesis(rotation[:few], shifted, coefficients[:few], sure)

    monkeypatch.setattr(network, "forward", at_the_truth)
    loss = network.loss(points_mm, places, torch.zeros(4, 96), poses)
    assert float(loss) == pytest.approx(expected, abs=2e-3)


def test_the_loss_falls_on_a_fixed_batch():
    network = taught()
    points_mm, poses, places = clouds()
    adam = torch.optim.Adam(network.parameters(), 1.5e-3)
    losses = []
    for _ in range(30):
        loss = network.loss(points_mm, places, torch.zeros(4, 96), poses)
        losses.append(float(loss.detach()))
        adam.zero_grad()
        loss.backward()
        adam.step()
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])


# --- height map ---


def scattered(n=300):
    generator = torch.Generator().manual_seed(1)
    return torch.rand(2, n, 3, generator=generator) * 2 - 1


def test_a_point_fills_the_pixels_about_it():
    pixels = 8
    middle = (torch.arange(pixels) + 0.5) / pixels * 2.5 - 1.25
    one = torch.stack([middle[5], middle[2], torch.tensor(0.7)])[None, None]
    seen, height, beside, height_beside = picture(one, pixels)[0]
    assert seen.nonzero().tolist() == [[2, 5]]  # rows are y
    assert float(height[2, 5]) == pytest.approx(0.7)
    assert beside.sum() == 9
    torch.testing.assert_close(height_beside[beside > 0], torch.full((9,), 0.7))
    between = one + torch.tensor([0.5, 0.5, 0.0]) * 2.5 / pixels
    assert picture(between, pixels)[0, 0].nonzero().tolist() == [[2, 5], [2, 6], [3, 5], [3, 6]]
    assert picture(one + torch.tensor([9.0, 0, 0]), pixels).abs().sum() == 0


def test_heights_are_means_weighted_by_nearness():
    """Two points in one pixel's column, and a share of a point between two pixels."""
    pixels = 8
    x = 0.5 / pixels * 2.5 - 1.25 + 2.5 / pixels * 3
    points = torch.tensor([[[x, x, 0.2], [x, x, 0.6], [x + 0.25 * 2.5 / pixels, x, -0.4]]])
    height = picture(points, pixels)[0, 1]
    assert float(height[3, 3]) == pytest.approx((0.2 + 0.6 - 0.75 * 0.4) / 2.75, abs=1e-5)
    assert float(height[3, 4]) == pytest.approx(-0.4, abs=1e-5)
    flat = scattered() * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 0.3])
    channels = picture(flat, 16)
    torch.testing.assert_close(channels[:, 1], 0.3 * channels[:, 0])
    torch.testing.assert_close(channels[:, 3], 0.3 * channels[:, 2])


def test_the_compiled_picture_is_the_plain_one():
    places = 9 * torch.rand(3, 500, 2, generator=torch.Generator().manual_seed(3)) - 1
    heights = torch.randn(3, 500, generator=torch.Generator().manual_seed(4))
    compiled = _spread(places, heights, 8)
    plain = [part.detach() for part in _spread(places.requires_grad_(), heights, 8)]
    assert float(plain[0].sum()) < 1400  # some lie beyond the border
    for one, other in zip(plain, compiled, strict=True):
        assert other.shape == (3, 1, 8, 8)
        torch.testing.assert_close(other, one, atol=1e-5, rtol=1e-5)


def test_neither_order_nor_number_of_a_clouds_points_matters_much():
    torch.manual_seed(0)
    encoder = HeightMapConfig().build()
    points = scattered(1000)
    points[..., 2] = 0.6 * points[..., 0] ** 2 + 0.3 * points[..., 1]  # a surface, as clouds are
    latent = encoder(points)
    assert latent.shape == (2, HeightMapConfig().latent_size)
    shuffled = points[:, torch.randperm(1000, generator=torch.Generator().manual_seed(2))]
    torch.testing.assert_close(encoder(shuffled), latent, atol=1e-4, rtol=1e-4)
    seen, often = picture(points, 32), picture(torch.cat([points, points], 1), 32)
    both = (seen[:, ::2] > 0) & (often[:, ::2] > 0)
    torch.testing.assert_close(often[:, 1::2][both], seen[:, 1::2][both], atol=1e-5, rtol=1e-5)
    assert both.sum() > 0.9 * (often[:, ::2] > 0).sum()
    repeated = encoder(torch.cat([points, points], 1))
    other = encoder(points * torch.tensor([1.0, -1.0, 1.0]))
    apart = [float((one - latent).norm().detach()) for one in (repeated, other)]
    assert apart[0] < 0.3 * apart[1]
    with pytest.raises(InputError, match="multiple of 8"):
        HeightMapConfig(pixels=20)


_FITTED = """
import sys
import numpy as np
from tumortrack.registration.motion import ElasticMotion
from tumortrack.models.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.rest_shape import RestShape
given = dict(np.load(sys.argv[1]))
points, rotation, centre = (given.pop(name) for name in ("points", "rotation", "centre"))
shape = RestShape.from_arrays(given, 2)
start = ElasticMotion(shape, rotation, centre, shape.body.mean)
print(refine(shape, points, start, GaussNewtonConfig(steps=3)).motion.coefficients.tobytes().hex())
"""


@pytest.mark.slow
def test_the_first_answer_of_a_machine_is_that_of_all_others(tmp_path):
    """Kernels compiled by this process and kernels found in numba's cache add up alike."""
    points, pose = surface(placed(), 300), {"rotation": START.rotation, "centre": START.centre_mm}
    np.savez(tmp_path / "shape.npz", points=points, **pose, **shape().to_arrays())
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    words = [sys.executable, "-c", _FITTED, str(tmp_path / "shape.npz")]
    compiled, found = (
        subprocess.run(words, env=environment, capture_output=True, check=True, timeout=600).stdout
        for _ in range(2)
    )
    assert len(compiled) > 300
    assert compiled == found
