"""Several views of a still organ as one: places of cameras, contradictions, the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from scipy.spatial.transform import Rotation

from live_objects import small_setting
from refused import refused
from stories import answered, refusal, tumortrack
from tumortrack.core import store
from tumortrack.core.camera import d405, deproject
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.render import render_depth
from tumortrack.core.report import Cause
from tumortrack.core.types import DepthFrame, SensorCloud, View
from tumortrack.io.depth_files import depth_png, intrinsics_json, read_poses
from tumortrack.live.values import CameraView, Observation
from tumortrack.live.views import Scan, ViewsLocator
from tumortrack.registration import compliance as bend_module
from tumortrack.registration import multi_view as module
from tumortrack.registration.compliance import refine_compliance
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.motion import seen_from_first
from tumortrack.registration.multi_view import CAMERA_STD, MultiViewCloud
from tumortrack.registration.search import PosePrior, Search
from tumortrack.segmentation import RegionConfig
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, PLACE_MM, nudged, placed, shape

CAMERA, SMALL = d405(424, 240), d405(320, 180)
ORGAN = ANATOMY.organ
INNER = (ORGAN.vertices_mm + ORGAN.vertices_mm.mean(0))[::5] / 2
REST = placed(share=0.0)  # one side of a compliant ellipsoid leaves its state open
SHIFT_MM, TURN_RAD = [1.2, -0.8, 0.9], [0.01, -0.015, 0.008]


def around(degrees, shift_mm=(0.0, 0, 0), turn_rad=(0.0, 0, 0)):
    """camera_from_view of a camera that was led round the organ, and stands elsewhere by this (its
    axes, about the organ's centre)."""
    turn = Rotation.from_rotvec([0, np.deg2rad(degrees), 0]).as_matrix()
    small = Rotation.from_rotvec(turn_rad).as_matrix()
    there = rigid(turn, PLACE_MM - turn @ PLACE_MM)
    return there @ rigid(small, PLACE_MM - small @ PLACE_MM + shift_mm)


def image(motion, camera_from_view, seed=0, camera=CAMERA):
    """What a camera sees there of the organ alone, 0.2 mm of noise."""
    places = transform_points(np.linalg.inv(camera_from_view), motion.forward(ORGAN.vertices_mm))
    depth_mm = render_depth(places, ORGAN.faces, camera).depth_mm
    noise = np.random.default_rng(seed).normal(0, 0.2, depth_mm.shape)
    return DepthFrame((depth_mm + noise).astype(np.float32), camera)


def points_of(frame):
    return SensorCloud(deproject(frame).astype(np.float32))


def view(motion, camera_from_view, stated=None, seed=0):
    frame = image(motion, camera_from_view, seed)
    return View(points_of(frame), frame, camera_from_view if stated is None else stated)


@pytest.fixture
def tracker(slim_model, monkeypatch):
    """Starts are near the truth, before whichever camera, and the ellipsoid, which looks the same
    after half a turn, is turned nowhere else; nor do the cameras' places speak against a pose."""
    model = load_model(slim_model, "cpu")
    near = nudged(replace(REST, shape=model.shape), [3.0, -2, 4], [0.06, -0.05, 0.08])
    starts = [seen_from_first(near, np.linalg.inv(around(degrees))) for degrees in (0, 50, -50, 60)]
    monkeypatch.setattr(Search, "starts", lambda self, views, again=False: starts)
    monkeypatch.setattr(PosePrior, "cost", lambda self, rotations: np.zeros(rotations.shape[:-2]))
    trained = {**model.provenance, "validation_far": 0.0}
    noisy = structs.replace(model.calibration, usual_cost=15.0)  # its scenes have no noise
    return Tracker(replace(model, provenance=trained, calibration=noisy))


def located(tracker, first, *others):
    return tracker.locate(first.cloud, grid=16, full_view=first.full_view, views=others)


def off_mm(estimate, truth):
    return np.linalg.norm(estimate.motion.forward(INNER) - truth.forward(INNER), axis=1).mean()


def test_two_looks_see_more_than_one(tracker):
    errors, stated = [], []
    for seed, place_mm in enumerate(([0.0, 0, 0], [2, -1, 1], [-1, 1, 2], [0, 2, -2])):
        truth = nudged(REST, place_mm, np.multiply(place_mm, 0.03))
        first, second = (view(truth, around(degrees), seed=seed) for degrees in (0, 60))
        one, two = located(tracker, first), located(tracker, first, second)
        errors.append([off_mm(one, truth), off_mm(two, truth)])
        stated.append(replace(two.motion, alternatives=()).std_mm(INNER).mean())
        assert two.quality == "good"
        assert two.report.points == len(first.cloud.points_mm) + len(second.cloud.points_mm)
    one, two = np.median(errors, axis=0)
    assert two < 0.8 * one
    off_mm_two, along_an_axis_mm = np.array(errors)[:, 1], np.array(stated)
    assert (off_mm_two < np.sqrt(3) * along_an_axis_mm).all()


def test_a_camera_that_stands_elsewhere_is_corrected(tracker, monkeypatch):
    truth = REST
    first, real = view(truth, around(0)), around(60, SHIFT_MM, TURN_RAD)
    exact = located(tracker, first, view(truth, real))
    wrong = view(truth, real, around(60))
    found = located(tracker, first, wrong)
    apart = np.linalg.norm(exact.motion.forward(INNER) - found.motion.forward(INNER), axis=1)
    assert apart.max() < 1.0
    views = found.report.views
    assert views.shift_mm[0] == views.turn_degrees[0] == 0
    assert views.shift_mm[1] == pytest.approx(np.linalg.norm(SHIFT_MM), abs=0.6)
    near, stated = np.linalg.inv(real), around(60)
    for pose, least, most in ((views.camera_from_view[1], 0, 0.7), (stated, 1, 3)):
        there = transform_points(near @ pose, PLACE_MM[None])[0]
        assert least < np.linalg.norm(there - PLACE_MM) < most
    assert found.quality == "good"
    monkeypatch.setattr(module, "CAMERA_STD", CAMERA_STD * 1e-4)
    trusting = located(tracker, first, wrong)
    assert trusting.report.views.shift_mm[1] < 0.01
    assert trusting.report.fit_cost.now > 1.5 * found.report.fit_cost.now
    assert trusting.quality == "poor"
    compliant = np.linalg.norm(exact.motion.forward(INNER) - trusting.motion.forward(INNER), axis=1)
    assert compliant.mean() > 2 * apart.mean()


def test_the_order_of_looks_does_not_matter(tracker):
    truth, poses = REST, [around(degrees) for degrees in (0, 50, -50)]
    frames = [image(truth, pose, seed) for seed, pose in enumerate(poses)]
    found = []
    for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        into = np.linalg.inv(poses[order[0]])
        views = [View(points_of(frames[n]), frames[n], into @ poses[n]) for n in order]
        estimate = located(tracker, *views)
        assert np.allclose(estimate.report.views.camera_from_view[0], np.eye(4))
        found.append(transform_points(poses[order[0]], estimate.motion.forward(INNER)))
    for other in found[1:]:
        assert np.linalg.norm(other - found[0], axis=1).max() < 0.8


def test_what_a_further_cameras_pose_errs_by_leaves_the_organ_less_sure(monkeypatch):
    config, middle_ct = GaussNewtonConfig(), ORGAN.vertices_mm.mean(0, keepdims=True)
    seen = [points_of(image(REST, pose)).points_mm[::25] for pose in (np.eye(4), around(60))]
    views = MultiViewCloud.from_points(seen, [around(60)])
    fit = refine(shape(), views, REST, config)
    stds_mm = []
    for share in (0.01, 1.0, 10.0):
        monkeypatch.setattr(bend_module, "CAMERA_STD", share * CAMERA_STD)
        stds_mm.append(float(refine_compliance(fit, config).motion.largest_std_mm(middle_ct)[0]))
    alone = refine_compliance(
        refine(shape(), MultiViewCloud.from_points(seen[:1]), REST, config), config
    )
    stds_mm.append(float(alone.motion.largest_std_mm(middle_ct)[0]))
    assert np.all(np.diff(stds_mm) > 0)  # a camera that stands anywhere still tells the shape


def test_a_pose_far_off_or_an_organ_that_moved_is_no_good_estimate(tracker):
    first, wrong = view(REST, around(0)), around(60, [4.0, 3.0, -3.0])
    found = located(tracker, first, view(REST, wrong, around(60)))
    assert (found.quality, found.finding.kind, found.finding.values["view"]) == ("poor", "poses", 2)
    assert [one.cause for one in found.causes] == [Cause.POSES]
    turned = replace(nudged(REST, [0, 0, 0], [0.3, 0.5, 0.4]), coefficients=REST.coefficients)
    try:
        moved = located(tracker, first, view(turned, around(60)))
    except NoEstimate as error:
        moved = error
    else:
        assert moved.quality == "poor"
    assert [one.cause for one in moved.causes] == [Cause.POSES]


def test_a_view_that_sees_through_refuses(tracker):
    truth = REST
    first, second = (view(truth, around(degrees)) for degrees in (0, 60))
    half = second.full_view.depth_mm.copy()
    half[:, half.shape[1] // 2 :] = np.nanmax(half) + 60  # a wall where half of it should be
    with pytest.raises(NoEstimate) as told:
        located(tracker, first, replace(second, full_view=DepthFrame(half, CAMERA)))
    assert [one.cause for one in told.value.causes] == [Cause.POSES]


# --- files ---


def poses_json(**changed):
    poses = [around(degrees).tolist() for degrees in (0, 60)]
    return {"fixed_from_camera": poses, "unit": "mm", "frame_id": "base_link"} | changed


def of_poses(*poses):
    return {"fixed_from_camera": [np.asarray(pose).tolist() for pose in poses]}


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (of_poses(np.eye(4)), "2 views"),
        (of_poses(np.eye(4), np.diag([1.0, 1, -1, 1])), "view 2"),  # mirrored
        (of_poses(np.eye(4)[:3], np.eye(4)[:3]), "view 1"),
        (of_poses(*[np.full((4, 4), np.nan)] * 2), "view 1"),
        (of_poses(*[rigid(np.eye(3), np.full(3, 1e306))] * 2) | {"unit": "m"}, "view 1"),
        ({"unit": "inch"}, "unit"),
        ({"robot": 1}, "robot"),
    ],
)
def test_bad_poses_are_refused(tmp_path, changed, named):
    (tmp_path / "poses.json").write_text(json.dumps(poses_json(**changed)))
    with refused(InputError, "poses.json", named):
        read_poses(tmp_path / "poses.json", 2)


def test_poses_in_metres_become_millimetres(tmp_path):
    poses = np.array([around(degrees) for degrees in (0, 60)])
    poses[:, :3, 3] /= 1000
    (tmp_path / "poses.json").write_text(json.dumps(poses_json(**of_poses(*poses), unit="m")))
    frame_id, (_, second) = read_poses(tmp_path / "poses.json", 2)
    assert frame_id == "base_link"
    np.testing.assert_allclose(second, around(60), atol=1e-9)


def test_the_command_takes_several_views(slim_model, tmp_path):
    truth = placed(share=0.0)
    names = "left.png", "right.png"
    for name, degrees, camera in zip(names, (0, 60), (CAMERA, SMALL), strict=True):
        frame = image(truth, around(degrees), degrees, camera)
        (tmp_path / name).write_bytes(depth_png(frame))
        (tmp_path / name).with_suffix(".json").write_text(json.dumps(intrinsics_json(camera)))
    (tmp_path / "poses.json").write_text(json.dumps(poses_json()))
    left, right = (tmp_path / name for name in names)
    first, second = (["--intrinsics", path.with_suffix(".json")] for path in (left, right))
    poses, out = ["--poses", tmp_path / "poses.json"], tmp_path / "out"
    given = ["--out", out, *first, "--range", 50, 400, "--device", "cpu", "--grid", 32]
    for views, options, named in (
        ([left, right], [], "--poses"),
        ([left], poses, "--poses"),
        ([left, right, left], poses, "3 views"),
        ([left, right], poses, "320 x 180"),
        ([left, right], [*poses, *second, *second], "2 views"),
    ):
        assert named in refusal(tumortrack("locate", slim_model, *views, *given, *options))
    assert not out.exists()
    answered(tumortrack("locate", slim_model, left, right, *given, *poses, *second))
    report = json.loads((out / "report.json").read_text())
    views = report["views"]
    assert views["clouds_sha256"] == [store.sha256_of(path) for path in (left, right)]
    assert views["poses_sha256"] == store.sha256_of(poses[1])
    assert views["frame_id"] == "base_link"
    assert max(views["shift_mm"]) < 1
    vertices = truth.shape.anatomy_ct.organ.vertices_mm
    middle = truth.forward(vertices).mean(0)  # which way round it lies nobody can tell
    assert np.linalg.norm(report["parts"]["kidney"]["center_mm"] - middle) < 5


def test_an_organ_is_followed_by_several_cameras_and_by_one_that_goes_round(tracker):
    """Where the last frame's camera stood elsewhere, the search starts where it put the organ."""
    follower, second_ns = Follower(tracker, FollowerConfig(rescan_s=100.0)), 10**9
    found = []
    for n, degrees in enumerate(((0, 60), (0, 60), (50,), (-50, 0))):
        lead = around(degrees[0])
        views = [view(REST, around(one), np.linalg.inv(lead) @ around(one), n) for one in degrees]
        before = around((0, 0, 0, 50)[n])
        here = replace(views[0].cloud, stamp_ns=1 + n * second_ns // 10)
        way = np.linalg.inv(lead) @ before
        estimate = follower.locate(here, views[0].full_view, views=views[1:], camera_from_last=way)
        found.append(transform_points(lead, estimate.motion.forward(INNER)))
        assert ("follow" in estimate.report.timings) == (n > 0)
        assert ("refine" in estimate.report.timings) == (n == 0)
        box_mm = follower.last_box_mm(here.stamp_ns, lead)
        whole = transform_points(lead, estimate.motion.forward(ORGAN.vertices_mm))
        assert np.allclose(box_mm.mean(0), (whole.min(0) + whole.max(0)) / 2, atol=6)
        assert len(estimate.report.views.shift_mm) == 2 if len(degrees) == 2 else True
    for other in found:
        assert np.linalg.norm(other - REST.forward(INNER), axis=1).mean() < 1.0


def test_a_scan_takes_three_looks_from_apart_and_says_what_each_added(tracker):
    second_ns = 10**9

    def seen(degrees, stamp_s, truth=REST):
        one = view(truth, around(degrees), seed=round(10 * stamp_s))
        cloud = replace(one.cloud, stamp_ns=round(stamp_s * second_ns))
        frame = replace(one.full_view, stamp_ns=cloud.stamp_ns)
        return CameraView(1, Observation(frame, 0), around(degrees)), cloud

    def ask(scan, *view):
        """An answer, or the number of views so far; -1: it was begun anew."""
        try:
            return scan.take(*seen(*view))
        except NoEstimate as error:
            values = error.finding.values
            return values.get("views", -1) if error.finding.kind == "scan_waits" else -1

    scan = Scan(tracker)
    # The third is too near the first; before the fifth the first two are over 5 s old.
    views = [(0, 1.0), (20, 1.5), (50, 2.0), (-50, 7.5), (0, 8.0)]
    assert [ask(scan, *view) for view in views] == [1, 1, 2, 1, 2]
    found = ask(scan, 50, 9.0)
    there = transform_points(around(50), found.motion.forward(INNER))
    assert np.linalg.norm(there - REST.forward(INNER), axis=1).mean() < 1.0
    stated = [f"{mm:.1f} mm" for mm in found.report.scan.error_bound95_mm]
    assert len(stated) == 3
    assert ", then ".join(stated) in scan.summary
    bounds = found.assessment.bounds  # of all views
    worst_mm = max(each.error_bound95_mm for name, each in bounds.items() if name != "kidney")
    assert stated[-1] == f"{worst_mm:.1f} mm"
    follower = Follower(tracker, FollowerConfig(rescan_s=100.0))
    follower.begin(found)  # the answer took long: the organ rests
    assert "follow" in follower.locate(seen(50, 12.0)[1]).report.timings
    views = ViewsLocator(follower, small_setting(), RegionConfig(), 1.0, 0)
    views.scan = Scan(tracker)
    for degrees, stamp_s in ((-50, 7.5), (0, 8.0)):
        with pytest.raises(NoEstimate):
            views.locate([seen(degrees, stamp_s)])
    views.locate([seen(50, 9.0)])
    assert views.scanned == scan.summary  # what the live page shows from then on
    turned, scan = nudged(REST, [12.0, 0, 0], [0, 0, 0.3]), Scan(tracker)
    asked = [ask(scan, 0, 1.0, REST), ask(scan, 50, 2.0, turned), ask(scan, -50, 3.0, REST)]
    assert asked == [1, 2, -1]  # the organ moved between the views
