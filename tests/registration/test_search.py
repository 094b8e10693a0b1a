"""The search: its kernel, what is allowed, and poses that are found from nothing."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from elastic_objects import CENTER, RADII, UP
from pose_objects import OVER, PLACE_MM, lying, seen
from tumortrack.core.estimate import FollowOptions
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.io.case import load_case
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.in_distribution import RIVAL_COST
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.registration.registration import Registration
from tumortrack.registration.search import APART_MM, PosePrior, Search, distance_mm
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, TURNED, placed, shape, shape_of, with_slope
from warp_objects import PLACE_MM as ELLIPSOID_MM

UP_CT = np.array(UP)
LIMITED, ANYHOW = PosePrior(UP_CT, 30.0), PosePrior(UP_CT, 180.0)


@pytest.fixture(scope="module")
def rest(phantom_case):
    """The phantom, with a body that is quickly made."""
    anatomy = load_case(phantom_case).anatomy
    return shape_of(anatomy)


def over(motion):
    """The same place, the other side up."""
    return replace(motion, rotation=OVER.as_matrix() @ motion.rotation)


def tumors_off_mm(motion, truth):
    vertices = np.concatenate([one.vertices_mm for one in truth.shape.anatomy_ct.tumors])
    return np.linalg.norm(motion.forward(vertices) - truth.forward(vertices), axis=1).mean()


# --- the kernel ---


def plainly_descended(points, widths_mm, rotation, centre):
    """``Search.descend`` of one start, as arrays of all points in double precision."""
    damping = np.diag(np.repeat([0.02**2, 1.0], 3))

    def rows():
        offsets = (points - centre) @ rotation
        off, slope = with_slope(
            shape().distances[0], (offsets + shape().body.center_ct).astype(np.float32)
        )
        return off.astype(float), np.column_stack([-slope, -np.cross(offsets, slope)])

    for width in widths_mm:
        off, slopes = rows()
        weight = 1 / (1 + (off / width) ** 2) ** 2
        curvature = (slopes.T * weight) @ slopes / len(off) + damping
        change = np.linalg.solve(curvature, slopes.T @ (weight * off) / len(off))
        for part, most in ((slice(0, 3), 25.0), (slice(3, 6), 0.5)):
            change[part] *= min(1.0, most / np.linalg.norm(change[part]))
        centre = centre - rotation @ change[:3]
        rotation = rotation @ Rotation.from_rotvec(-change[3:]).as_matrix()
    square = (rows()[0] / 3.0) ** 2
    return rotation, centre, (square / (1 + square)).mean()


def test_a_descent_is_that_of_plain_arithmetic():
    points = placed(share=0.0).forward(ANATOMY.organ.vertices_mm[::25]).astype(np.float32)
    widths_mm = np.array([10.0, 6.0, 3.0])
    turns = Rotation.from_rotvec([[0.1, -0.2, 0.1], [0.0, 0.0, 1.5], [0.8, 0.3, -0.4]]).as_matrix()
    rotations = np.ascontiguousarray(TURNED @ turns)
    centres = ELLIPSOID_MM + [[5.0, -3, 8], [0, 30, 0], [-60, 0, 40]]
    starts = zip(rotations, centres, strict=True)
    expected = [plainly_descended(points, widths_mm, *start) for start in starts]
    costs = Search(shape(), LIMITED).descend(points, widths_mm, rotations, centres)
    for n, (rotation, centre, cost) in enumerate(expected):
        np.testing.assert_allclose(rotations[n], rotation, atol=2e-3)
        np.testing.assert_allclose(centres[n], centre, atol=0.05)
        assert costs[n] == pytest.approx(cost, rel=0.01, abs=1e-3)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), [np.eye(3)] * 3, atol=1e-9)
    assert costs[0] < 0.1 * costs[2]


# --- what is allowed ---


def test_what_is_allowed_costs_nothing_and_what_is_not_the_more_the_farther():
    facing = Rotation.align_vectors([[0.0, 0, -1]], [UP_CT])[0]
    tilts = np.array([0.0, 29.0, 42.0, 50.0, 60.0, 90.0, 180.0])
    rotations = (Rotation.from_euler("y", tilts[:, None], degrees=True) * facing).as_matrix()
    np.testing.assert_allclose(LIMITED.tilt_degrees_of(rotations), tilts, atol=1e-5)
    costs = LIMITED.cost(rotations)
    assert (costs[:3] == 0).all()
    assert (np.diff(costs[2:]) > 0).all()
    np.testing.assert_array_equal(LIMITED.excludes(rotations), costs > RIVAL_COST)
    assert LIMITED.excludes(rotations[-1])
    turned = Rotation.from_euler("z", 77, degrees=True).as_matrix() @ rotations
    np.testing.assert_allclose(LIMITED.cost(turned), costs, atol=1e-9)  # about the line of sight
    assert (ANYHOW.cost(Rotation.random(50, random_state=0).as_matrix()) == 0).all()
    either = replace(LIMITED, allow_flip=True)
    np.testing.assert_allclose(either.cost(OVER.as_matrix() @ rotations), either.cost(rotations))
    np.testing.assert_allclose(either.cost(rotations), LIMITED.cost(rotations) * (tilts <= 90))


# --- poses ---


@pytest.mark.parametrize(
    ("turn_degrees", "tilt_degrees", "hidden"),
    [
        *((turn, (15.0, -20.0), 0.0) for turn in (0, 95, 170, 260)),
        *((turn, (10.0, 10.0), 0.4) for turn in (20, 140)),
    ],
)
def test_a_pose_is_found_from_nothing(rest, turn_degrees, tilt_degrees, hidden):
    truth = lying(rest, turn_degrees, tilt_degrees)
    views, search = MultiViewCloud.from_points([seen(truth, hidden)]), Search(rest, LIMITED)
    first, *others = starts = search.starts(views)
    for start, again in zip(starts, search.starts(views), strict=True):
        np.testing.assert_array_equal(start.rotation, again.rotation)
        np.testing.assert_array_equal(start.centre_mm, again.centre_mm)
    assert distance_mm(first, truth) < 2.5
    assert min(distance_mm(one, first) for one in others) > APART_MM
    assert LIMITED.excludes(starts[-1].rotation)  # the other side up was tried
    fit = Registration(rest, GaussNewtonConfig(), LIMITED).register(views)
    assert tumors_off_mm(fit.motion, truth) < 0.7
    assert fit.excluded_pose is None


@pytest.mark.parametrize("seed", range(3))
def test_any_rotation_is_found_where_all_are_allowed(rest, seed):
    unconstrained = Rotation.random(random_state=seed).as_matrix()
    truth = replace(lying(rest, 0), rotation=unconstrained)
    views = MultiViewCloud.from_points([seen(truth)])
    assert distance_mm(Search(rest, ANYHOW).starts(views)[0], truth) < 2.5
    fit = Registration(rest, GaussNewtonConfig(), ANYHOW).register(views)
    assert tumors_off_mm(fit.motion, truth) < 0.7


@pytest.mark.parametrize("degrees", [(50.0,), (50.0, -50.0)])
def test_several_looks_are_searched_as_one(rest, degrees):
    truth, poses = lying(rest, 140, (10.0, 5.0)), []
    for angle in degrees:
        turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        poses.append(rigid(turn, PLACE_MM - turn @ PLACE_MM))
    clouds = [seen(truth, 0.4), *(seen(truth, 0.0, pose) for pose in poses)]
    views = MultiViewCloud.from_points(clouds, poses)
    assert distance_mm(Search(rest, LIMITED).starts(views)[0], truth) < 2.5
    fit = Registration(rest, GaussNewtonConfig(), LIMITED).register(views)
    assert tumors_off_mm(fit.motion, truth) < 0.7


# --- the other side up ---


@pytest.fixture(scope="module")
def model(elastic_model):
    return load_model(elastic_model)


@pytest.mark.parametrize("turn_degrees", [0, 100, 200])
def test_an_organ_that_lies_upside_down_is_told_and_found_where_that_is_allowed(
    model, turn_degrees
):
    truth = over(lying(model.shape, turn_degrees))
    cloud = SensorCloud(seen(truth))
    tracker = Tracker(model)
    found = tracker.locate(cloud, grid=16)
    excluded_pose = found.report.fit_cost.excluded_pose
    assert excluded_pose.less > RIVAL_COST
    assert excluded_pose.tilt_degrees == pytest.approx(180, abs=3)
    assert found.quality == "poor"
    assert tumors_off_mm(found.motion, truth) > 20
    assert tracker.locate(SensorCloud(seen(over(truth))), grid=16).quality == "good"
    scene = model.config.scene
    pose = msgspec.structs.replace(scene.pose, rotations="full")
    scene = msgspec.structs.replace(scene, pose=pose)
    unconstrained = replace(model, config=msgspec.structs.replace(model.config, scene=scene))
    for right in (
        Tracker(unconstrained).locate(cloud, grid=16),
        tracker.follow(cloud, how=FollowOptions(allow_flip=True)),  # it was seen a moment ago
    ):
        assert right.report.fit_cost.excluded_pose is None
        assert right.quality == "good"
        assert tumors_off_mm(right.motion, truth) < 1.5


def test_an_organ_nearly_the_same_from_below_may_lie_upside_down(slim_model):
    """A compliant ellipsoid: the wrong side fits as well as usual, and the other one better."""

    def compliant(mesh):
        bend_mm = 2 * ((mesh.vertices_mm[:, 2] - CENTER[2]) / RADII[2]) ** 2
        return mesh.with_vertices(mesh.vertices_mm + np.outer(bend_mm, [0.0, 1.0, 0.0]))

    banana = Anatomy(tuple(compliant(part) for part in ANATOMY.parts))
    known = load_model(slim_model)
    trained = {**known.provenance, "validation_far": 0.0}
    noisy = msgspec.structs.replace(known.calibration, usual_cost=20.0)  # its scenes have no noise
    bowed = shape_of(banana)
    tracker = Tracker(replace(known, shape=bowed, provenance=trained, calibration=noisy))
    upright = lying(bowed, 30)
    found, right = (
        tracker.locate(SensorCloud(seen(one)), grid=16) for one in (over(upright), upright)
    )
    cost = found.report.fit_cost
    assert cost.now < cost.usual
    assert cost.excluded_pose.less > 0
    assert (found.quality, found.finding.kind) == ("poor", "upside_down")
    assert right.report.fit_cost.excluded_pose is None
