"""A registration model at work: made in seconds, saved, asked, refused, questioned about points."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import tumortrack as tt
from elastic_objects import CENTER
from refused import refused
from stories import answered, tumortrack
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Motion
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import labels_of, surface_distance
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.io.model_folder import save_model
from tumortrack.io.ply import write_cloud_ply
from tumortrack.io.scene_folder import draw_targets
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from warp_objects import ANATOMY, shape


@pytest.fixture(scope="module")
def model(slim_model):
    return load_model(slim_model, "cpu")


@pytest.fixture(scope="module")
def estimate(tracker, stages):
    return tracker.locate(stages[0].cloud, grid=48, seed=3)


def test_points_inside_are_found_within_millimetres_wherever_the_camera_stands(
    tracker, stages, estimate
):
    targets = draw_targets(ANATOMY, 0).points_ct
    errors, rigid_errors = [], []
    for stage in stages:
        motion = tracker.locate(stage.cloud, grid=16).motion
        truth = stage.forward(targets)
        errors.append(np.linalg.norm(motion.forward(targets) - truth, axis=1).mean())
        middle = truth - truth.mean(0) + stage.cloud.points_mm.mean(0)
        rigid_errors.append(np.linalg.norm(middle - truth, axis=1).mean())
    assert np.median(rigid_errors) > 15  # the cloud's middle is no answer
    assert np.median(errors) < 3.5
    turn = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    away = stages[0].cloud.points_mm @ turn.T + [5, -8, 60]
    moved = tracker.locate(SensorCloud(away.astype(np.float32)), grid=16, seed=3)
    expected = estimate.motion.forward(targets) @ turn.T + [5, -8, 60]
    assert np.linalg.norm(moved.motion.forward(targets) - expected, axis=1).mean() < 0.5


def test_an_estimate_answers_in_arrays(tracker, stages, estimate):
    points_ct = ANATOMY.organ.vertices_mm
    moved = estimate.forward(points_ct)
    np.testing.assert_array_equal(moved, estimate.motion.forward(points_ct))
    np.testing.assert_allclose(estimate.inverse(moved), points_ct, atol=0.05)
    rest_mm = transform_points(estimate.camera_from_ct, points_ct)
    best = np.linalg.norm(rest_mm - moved, axis=1)
    assert best.max() < 25
    for axis in range(3):  # no rigid motion lies nearer
        for step in (-1.0, 1.0):
            off = np.linalg.norm(rest_mm + step * np.eye(3)[axis] - moved, axis=1)
            assert (off**2).mean() > (best**2).mean()
    assert list(estimate.parts) == list(estimate.report.parts)
    assert list(estimate.tumors) == [name for name in estimate.parts if "tumor" in name]
    for name, part in estimate.tumors.items():
        assert part.mesh is estimate.meshes[name]
        np.testing.assert_array_equal(part.center_mm, estimate.report.parts[name].center_mm)
        known = estimate.assessment.shown.get(name)
        assert part.error_bound95_mm == (known.error_bound95_mm if known else None)
    points_mm = np.array(stages[0].cloud.points_mm, np.float64)
    same = [tracker.locate(cloud, grid=16).parts for cloud in (points_mm, SensorCloud(points_mm))]
    np.testing.assert_array_equal(same[0]["kidney"].center_mm, same[1]["kidney"].center_mm)
    unmoved = replace(estimate, motion=None)
    with pytest.raises(InputError):
        unmoved.forward(points_ct)
    with pytest.raises(InputError):
        tracker.locate([[0.0, 0.0, 100.0]])


def test_one_call_locates_with_a_folder_or_a_model(slim_model, model, stages, estimate):
    points_mm = np.array(stages[0].cloud.points_mm, np.float64)
    for case, points in ((slim_model, points_mm), (str(slim_model), stages[0].cloud)):
        found = tt.locate(case, points, grid=48, seed=3)
        np.testing.assert_array_equal(found.cloud.points_mm, estimate.cloud.points_mm)
    assert isinstance(tt.locate(model, points_mm, grid=16), tt.Estimate)
    with refused(InputError, "1000"):
        tt.locate(model, points_mm / 1000)


def test_the_same_cloud_and_seed_give_the_same_estimate(tracker, stages, estimate):
    again = tracker.locate(stages[0].cloud, grid=48, seed=3)
    np.testing.assert_array_equal(again.cloud.points_mm, estimate.cloud.points_mm)
    np.testing.assert_array_equal(again.cloud.probability, estimate.cloud.probability)
    np.testing.assert_array_equal(again.volume.labels, estimate.volume.labels)
    other = tracker.locate(stages[0].cloud, grid=48, seed=4)
    assert not np.array_equal(other.cloud.points_mm[:100], estimate.cloud.points_mm[:100])
    with refused(InputError, "-1"):
        tracker.locate(stages[0].cloud, seed=-1)


def test_a_loaded_model_says_the_same_bit_for_bit(model, stages, tmp_path, estimate):
    (tmp_path / "again").mkdir()
    save_model(model, tmp_path / "again")
    again = load_model(tmp_path / "again", "cpu")
    assert again.calibration == model.calibration
    assert again.in_distribution == model.in_distribution
    found = Tracker(again).locate(stages[0].cloud, grid=48, seed=3)
    np.testing.assert_array_equal(found.cloud.points_mm, estimate.cloud.points_mm)
    np.testing.assert_array_equal(found.cloud.probability, estimate.cloud.probability)
    for name, mesh in estimate.meshes.items():
        np.testing.assert_array_equal(found.meshes[name].vertices_mm, mesh.vertices_mm)


def test_meshes_are_the_cts_carried_along(estimate):
    assert isinstance(estimate.motion, Motion)
    for name, part in zip(ANATOMY.names, ANATOMY.parts, strict=True):
        mesh = estimate.meshes[name]
        np.testing.assert_array_equal(mesh.vertices_mm, estimate.motion.forward(part.vertices_mm))
        np.testing.assert_array_equal(mesh.faces, part.faces)
        np.testing.assert_allclose(
            estimate.motion.inverse(mesh.vertices_mm), part.vertices_mm, atol=0.05
        )
        told = estimate.report.parts[name]
        assert told.volume_ml == pytest.approx(part.volume_mm3 / 1000, rel=0.15)
        assert 0 < told.center_std_mm < 30
        axes, along = np.array(told.center_axes), np.array(told.center_axes_std_mm)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        assert along[0] > 1.05 * along[2] > 0
        assert np.sqrt((along**2).mean()) == pytest.approx(told.center_std_mm)
        part = estimate.motion.shape.anatomy_ct.parts[told.label - 1]
        known = estimate.motion.covariance_mm2(part.box_mm.mean(0)[None])[0]
        np.testing.assert_allclose(axes @ known @ axes.T, np.diag(along**2), atol=1e-4)


def test_labels_of_points_and_voxels_agree_with_the_meshes(estimate):
    moved = Anatomy(tuple(estimate.meshes[name] for name in ANATOMY.names))
    cloud = estimate.cloud
    points = cloud.points_mm.astype(float)
    clear = np.min([surface_distance(part, points) for part in moved.parts], axis=0) > 0.7
    assert clear.mean() > 0.7
    np.testing.assert_array_equal(cloud.labels[clear], labels_of(moved, points[clear]))
    index = np.argwhere(estimate.volume.labels >= 0)
    affine = estimate.volume.camera_from_index
    places = index @ affine[:3, :3].T + affine[:3, 3]
    rows = np.random.default_rng(0).permutation(len(index))[:3000]
    truth = labels_of(moved, places[rows])
    given = estimate.volume.labels.reshape(-1)[rows]
    assert (truth == given).mean() > 0.999
    assert len(cloud.points_mm) == pytest.approx(
        40_000 * ANATOMY.organ.volume_mm3 / np.prod(np.ptp(moved.organ.box_mm, axis=0)), rel=0.15
    )
    probability = cloud.probability  # higher away from surfaces
    assert probability.min() >= 0.5
    assert probability.max() <= 1
    points_ct = estimate.motion.inverse(estimate.cloud.points_mm).astype(np.float32)
    _, margin_mm = shape().labels_at(points_ct)
    near, deep = (probability[side].mean() for side in (margin_mm < 0.5, margin_mm > 6))
    assert deep > near + 0.1


def random_points(low, high):
    return np.random.default_rng(0).uniform(low, high, (2000, 3))


def ball(radius_mm):
    """The side of a ball that a camera sees."""
    points = trimesh.creation.icosphere(4, radius_mm).vertices
    return points[points[:, 2] < 0] + [0, 0, 160]


NO_ORGANS = {
    "one point": np.full((300, 3), [0.0, 0, 140]),
    "large table": random_points([-100, -100, 149.5], [100, 100, 150.5]),
    "small table": random_points([-35, -35, 149.5], [35, 35, 150.5]),
    "cube": random_points([-40, -40, 110], [40, 40, 190]),
    "small cube": random_points([-8, -8, 130], [8, 8, 146]),
    "organ-sized cube": random_points([-28, -28, 130], [28, 28, 186]),
    "ball": ball(60),
    "round ball": ball(45),
    "small ball": ball(12),
}


@pytest.mark.parametrize("name", NO_ORGANS)
def test_what_is_no_organ_is_refused(tracker, name):
    with pytest.raises(NoEstimate):
        tracker.locate(SensorCloud(NO_ORGANS[name].astype(np.float32)), grid=16)


def test_the_command_says_where_points_of_the_ct_are(slim_model, stages, estimate, tmp_path):
    write_cloud_ply(tmp_path / "cloud.ply", stages[0].cloud.points_mm)
    points = np.round(CENTER + np.array([[0, -8, 20.0], [10, 5, -30], [0, 0, 44]]), 3)
    lines = [f"p{n},{','.join(map(str, p))}" for n, p in enumerate(points)]
    (tmp_path / "asked.csv").write_text("\n".join(["name,x,y,z", *lines, ""]))
    out = tmp_path / "out"
    command = [
        "locate",
        slim_model,
        tmp_path / "cloud.ply",
        "--out",
        out,
        "--grid",
        48,
        "--seed",
        3,
    ]
    answered(tumortrack(*command, "--map", tmp_path / "asked.csv", "--device", "cpu"))
    rows = list(csv.DictReader((out / "points.csv").open()))
    assert [row["name"] for row in rows] == ["p0", "p1", "p2"]
    places = np.array([[float(row[f"camera_{axis}"]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(places, estimate.motion.forward(points), atol=0.02)
    unsure = [float(row["std_mm"]) for row in rows]
    np.testing.assert_allclose(unsure, estimate.motion.std_mm(points), rtol=0.02)
    assert min(unsure) > 0
    truth = stages[0].forward(points)
    assert np.linalg.norm(places - truth, axis=1).mean() < 6
    report = json.loads((out / "report.json").read_text())
    assert report["map"]["points"] == 3
    rigid = np.array(report["motion"]["camera_from_ct"])
    np.testing.assert_allclose(rigid, estimate.camera_from_ct, atol=0.05)
    answered(tumortrack(*command, "--map", out / "points.csv", "--device", "cpu", "--overwrite"))
    assert list(csv.DictReader((out / "points.csv").open())) == rows


def test_clouds_of_an_organ_as_never_seen_are_answered(tracker, stages):
    """Half of the surface hidden, and millimetres of noise: still the organ."""
    cloud = stages[1].cloud.points_mm
    half = cloud[cloud[:, 0] > np.median(cloud[:, 0])]
    rng = np.random.default_rng(2)
    for points in (half, cloud + rng.normal(0, 1.5, cloud.shape)):
        found = tracker.locate(SensorCloud(points.astype(np.float32)), grid=16)
        assert all(part.found for part in found.report.parts.values())
    certain, part = (  # an ellipsoid fits the other way round too
        replace(tracker.locate(SensorCloud(points), grid=16).motion, alternatives=())
        for points in (cloud, half)
    )
    vertices = ANATOMY.organ.vertices_mm
    assert part.std_mm(vertices).mean() > certain.std_mm(vertices).mean()
