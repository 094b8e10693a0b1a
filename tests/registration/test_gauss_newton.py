"""The registration's compiled kernels against plain forms: flow, sums, chances, rasters.

And a steady loop.
"""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from covering import cover
from elastic_objects import CENTER, RADII
from reports import looked
from tumortrack.core.estimate import FollowOptions
from tumortrack.core.process import parallel_for, parallel_map
from tumortrack.core.types import Mesh, SensorCloud
from tumortrack.imaging.raster import label_grid, winding_numbers
from tumortrack.registration import registration
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import GaussNewton, prior_precision
from tumortrack.registration.kernels import look_up, probabilities
from tumortrack.registration.locator import RegistrationLocator, nearest_lookup
from tumortrack.registration.looks import Looks
from tumortrack.registration.motion import ElasticMotion
from tumortrack.simulate.elastic.flow import BLOCK, steps_for
from tumortrack.tracking.model_files import load_model
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


@pytest.mark.parametrize("count", [1, BLOCK - 1, BLOCK, 3 * BLOCK + 5, 9000])
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
    np.testing.assert_allclose(motion.carry(points), carried, atol=2e-4)
    rest = body.follow(-velocity, (carried - PLACE_MM) @ TURNED + body.center_ct)
    np.testing.assert_allclose(motion.back(carried), rest, atol=2e-4)


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
    points = motion.carry(ANATOMY.organ.vertices_mm[::5]).astype(np.float32)
    points += np.random.default_rng(1).normal(0, 1.5, points.shape).astype(np.float32)
    motion = replace(motion, coefficients=0.9 * motion.coefficients)
    rows = motion.residual_rows(points).astype(float)
    config = GaussNewtonConfig(first_mm=2.0, n_effective=1e6)  # each point weighs one
    begun, precision = descent(points, motion, config), prior_precision(shape(), config)
    begun.run(0)
    equations = begun._state
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


@pytest.mark.parametrize("noise_mm", [0.1, 3.0])
def test_the_gradient_is_half_of_the_costs_slope(noise_mm):
    """Gauss-Newton minimises rho only if a squared distance weighs rho'(r) / (2 r). Of an organ at
    rest the rows are exact."""
    points = placed(share=0).carry(ANATOMY.organ.vertices_mm[::5])
    points += np.random.default_rng(1).normal(0, noise_mm, points.shape)
    config = GaussNewtonConfig(first_mm=GaussNewtonConfig().last_mm)

    def begun(shift_mm):
        moved = replace(placed(share=0), centre_mm=PLACE_MM + TURNED @ (np.array(shift_mm) + 1))
        descends = descent(points, moved, config)
        descends.run(0)
        return descends

    for axis in range(3):
        small_mm = 0.001
        step = small_mm * np.eye(3)[axis]
        slope = (begun(step).cost - begun(-step).cost) / (2 * small_mm)
        assert 2 * begun([0, 0, 0])._state.gradient[axis] == pytest.approx(slope, rel=0.02)
        assert abs(slope) > 1


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


@pytest.mark.parametrize("steps", [0, 3, 20])
def test_a_refinement_is_that_of_a_plain_loop(steps):
    config, start = GaussNewtonConfig(steps=steps), nudged(placed(), [3, -2, 5], [0.1, -0.05, 0.1])
    points = placed().carry(ANATOMY.organ.vertices_mm[::3])
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
    points = placed().carry(ANATOMY.organ.vertices_mm[::3])
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


def test_the_best_of_many_starts_wins_wherever_it_stands():
    points = placed().carry(ANATOMY.organ.vertices_mm[::3])
    near = nudged(placed(), [3, -2, 5], [0.1, -0.05, 0.1])
    far = [nudged(placed(), [0, 0, 30.0 * n], [0, 0, 1.0 * n]) for n in (1, 2, 3)]
    alone = refined(points, near)
    for starts in ([near, *far], [*far, near]):
        fit = method().best_fit(Looks.of([points]), starts)
        # A little less where a start beside it ends nearer to the minimum.
        assert 0.97 * alone.cost < fit.cost <= alone.cost


def test_starts_that_are_far_behind_are_given_up(monkeypatch):
    gone = []

    class Noted(GaussNewton):
        def run(self, steps):
            super().run(steps)
            gone.append((self, self.steps))

    monkeypatch.setattr(registration, "GaussNewton", Noted)
    points = placed().carry(ANATOMY.organ.vertices_mm[::3])
    near = nudged(placed(), [3, -2, 5], [0.1, -0.05, 0.1])
    far = nudged(placed(), [60, 0, 60], [0, 0, 1.0])
    steady = GaussNewtonConfig(enough_mm=0)  # never settles
    method(steady).best_fit(Looks.of([points]), [far, near])
    most = {}
    for tried, steps in gone[:3]:  # the two hypotheses; the rest begins beside the better one
        most[tried] = max(steps, most.get(tried, 0))
    assert sorted(most.values()) == [6, steady.steps]
    assert min(most, key=lambda tried: tried.cost) is max(most, key=most.__getitem__)


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
    rng = np.random.default_rng(5)
    places = CENTER + rng.uniform(-1, 1, (200, 3)) * RADII
    points = about(3000, 6)
    found = np.linalg.norm(points - places[look_up(*nearest_lookup(places), points)], axis=1)
    apart = np.linalg.norm(points[:, None] - places, axis=2)
    inside = ((points > places.min(0)) & (points < places.max(0))).all(1)
    assert inside.mean() > 0.2
    assert (found[inside] <= apart.min(1)[inside] + 2 * np.sqrt(3)).all()
    assert np.mean(found[inside] == apart.min(1)[inside].astype(found.dtype)) > 0.6
    own = look_up(*nearest_lookup(places), places.astype(np.float32))
    assert np.mean(own == np.arange(200)) > 0.9


def test_covariances_are_those_of_plain_products():
    rng = np.random.default_rng(2)
    base, points = placed(), about(300, 3, 0.9)
    mixed = rng.normal(size=(26, 26)) * 0.05
    motion = type(base)(
        base.shape,
        base.rotation,
        base.centre_mm,
        base.coefficients,
        mixed @ mixed.T + 1e-4 * np.eye(26),
    )
    velocity = base.shape.body.velocity(base.coefficients)
    steps = steps_for(velocity, base.shape.body.spacing_mm)
    places, middle = plainly_followed(velocity, points, steps)
    offsets, modes = places - base.shape.body.center_ct, base.shape.body.modes_at(middle)
    rows = np.empty((len(points), 3, 26))
    for axis, along in enumerate(np.eye(3)):
        tiled = np.tile(along, (len(points), 1))
        rows[:, axis] = np.column_stack([tiled, np.cross(offsets, tiled), modes[:, axis]])
    rows = base.rotation @ rows
    covariance = rows @ motion.covariance @ rows.transpose(0, 2, 1)
    variances = np.linalg.eigvalsh(covariance)
    assert np.ptp(variances) > 0.1
    np.testing.assert_allclose(
        motion.covariance_mm2(points), covariance, atol=1e-3 * variances.max()
    )
    np.testing.assert_allclose(motion.std_mm(points), np.sqrt(variances.mean(1)), rtol=1e-3)
    np.testing.assert_allclose(motion.largest_std_mm(points), np.sqrt(variances[:, 2]), rtol=1e-3)


def test_covariances_follow_from_where_small_changes_take_points():
    """Finite differences of ``carry`` by each unknown; modes halfway are of first order."""
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
            ).carry(points)
            for sign in (1, -1)
        )
        slopes.append((ahead - behind) / (2 * small))
    expected = np.einsum("pna,pq,qnb->nab", slopes, base.covariance, slopes)
    found = base.covariance_mm2(points)
    apart = np.linalg.norm(found - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))
    assert apart.max() < 0.05
    across = np.abs(expected[:, [0, 0, 1], [1, 2, 2]])
    assert across.max() > 0.2 * np.trace(expected, axis1=1, axis2=2).max() / 3


def test_chances_are_the_normal_distributions():
    margins = np.linspace(0, 30, 5000, dtype=np.float32)
    which = np.arange(5000, dtype=np.int32) % 3
    std_mm = np.array([0.3, 1.0, 4.0])
    told = probabilities(margins, 1 / std_mm, which)
    np.testing.assert_allclose(told, ndtr(margins / std_mm[which]), atol=3e-7)
    assert told.min() == 0.5
    assert told.max() == 1


# --- labels on a grid ---


def plain_winding(mesh, frame_from_index, size):
    """Winding numbers by ``cover`` and a sum along each ray."""
    index = (mesh.vertices_mm - frame_from_index[:3, 3]) @ np.linalg.inv(frame_from_index[:3, :3]).T
    triangles = index[mesh.faces]
    a, b = (triangles[:, n, :2] - triangles[:, 0, :2] for n in (1, 2))
    enters = -np.sign(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).astype(int)
    enters = enters * int(np.sign(np.linalg.det(frame_from_index[:3, :3])))
    steps = np.zeros((*size[:2], size[2] + 1), int)
    for tri, i, j, depth in cover(triangles, size[:2]):
        k = np.clip(np.ceil(depth), 0, size[2]).astype(int)
        np.add.at(steps, (i, j, k), enters[tri])
    return steps.cumsum(2)[:, :, :-1]


@pytest.mark.parametrize(("seed", "mirror"), [(0, 1), (1, -1), (2, 1)])
def test_labels_of_every_voxel_are_those_of_the_plain_form(seed, mirror):
    turn = Rotation.random(random_state=seed).as_matrix() @ np.diag([2.1, 2.4, mirror * 1.9])
    size = (36, 44, 52)
    frame_from_index = np.eye(4)
    frame_from_index[:3, :3] = turn
    frame_from_index[:3, 3] = CENTER - turn @ (
        np.array(size) / 2 + [0.3, 9, 4]
    )  # part lies outside
    labels = np.zeros(size, np.uint8)
    for label, part in enumerate(ANATOMY.parts, start=1):
        plain = plain_winding(part, frame_from_index, size)
        assert np.array_equal(winding_numbers(part, frame_from_index, size), plain)
        labels[plain != 0] = label
    assert set(np.unique(labels)) == {0, 1, 2}
    assert np.array_equal(label_grid(ANATOMY, frame_from_index, size), labels)


def test_open_and_nested_surfaces_wind_as_in_the_plain_form():
    whole = ANATOMY.organ
    few = Mesh(whole.vertices_mm, whole.faces[len(whole.faces) // 3 :])
    vertices = np.concatenate([whole.vertices_mm, CENTER + 0.6 * (whole.vertices_mm - CENTER)])
    twice = Mesh(vertices, np.concatenate([whole.faces, whole.faces + len(whole.vertices_mm)]))
    frame_from_index = np.diag([3.0, 3, 3, 1])
    frame_from_index[:3, 3] = CENTER - [60.3, 59.2, 60.7]
    for mesh, most in ((few, 1), (twice, 2)):
        plain = plain_winding(mesh, frame_from_index, (40, 40, 40))
        found = winding_numbers(mesh, frame_from_index, (40, 40, 40))
        assert np.array_equal(found, plain)
        assert found.max() == most


# --- frames ---


def test_frames_leave_no_memory_behind(slim_model, unchecked):
    locator = RegistrationLocator(load_model(slim_model, "cpu"))
    vertices = placed().carry(ANATOMY.organ.vertices_mm)
    seen = vertices[vertices[:, 2] < np.median(vertices[:, 2])]
    rng, last, sizes = np.random.default_rng(0), None, []
    tracemalloc.start()
    for frame in range(120):
        cloud = (seen + rng.normal(0, 0.2, 3)).astype(np.float32)
        last = locator.follow(looked(SensorCloud(cloud, frame)), last, FollowOptions())
        sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert "follow" in last.report.timings
    # A leak shows in every stretch of twenty frames; what another thread holds for a moment, or
    # something loaded once, in twenty stretches at most.
    grown = np.subtract(sizes[60:], sizes[40:-20])
    # One cloud a frame that stayed would be 240,000.
    assert np.quantile(grown, 0.25) < 60_000
