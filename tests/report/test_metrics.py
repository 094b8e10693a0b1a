"""Metrics against analytic answers and independent implementations."""

from dataclasses import astuple
from functools import partial

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import directed_hausdorff
from trimesh.triangles import closest_point

from covering import cover
from refused import refused
from report_objects import ball
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import nearest_places, surface_samples
from tumortrack.core.raster import voxelise
from tumortrack.core.types import Anatomy, CameraLabels, Mesh
from tumortrack.report.metrics import (
    box_center_distance,
    distance_to_surface,
    label_grid,
    label_ious,
    mean_iou,
    outward_miss,
    surface_distances,
)

sphere = partial(ball, subdivisions=4)


def box(size_mm, center_mm=(0.0, 0.0, 0.0)):
    solid = trimesh.creation.box(size_mm)
    return Mesh(solid.vertices + np.array(center_mm), solid.faces)


def lumpy(seed, radius_mm=15.0):
    """A ball with random smooth bumps."""
    rng = np.random.default_rng(seed)
    smooth = sphere(radius_mm)
    waves, bumps = rng.normal(0, 0.12, (3, 3)), rng.normal(0, 1.2, (3, 3))
    return smooth.with_vertices(smooth.vertices_mm + np.sin(smooth.vertices_mm @ waves) @ bumps)


def grid(low_mm, step_mm):
    camera_from_index = np.diag([step_mm, step_mm, step_mm, 1.0])
    camera_from_index[:3, 3] = low_mm
    return camera_from_index


def test_balls_are_as_far_apart_as_their_radii_and_their_shift():
    found = surface_distances(sphere(20), sphere(23))
    for value in astuple(found):
        assert value == pytest.approx(3.0, abs=0.03)
    found = surface_distances(sphere(20, (4, 0, 0)), sphere(20))
    assert found.hausdorff_mm == pytest.approx(4.0, abs=0.02)
    # |d(p)| = 4 |cos| about, over the sphere: mean 2, and 95 % of the area below 0.95 * 4.
    assert found.surface_mm == pytest.approx(2.0, abs=0.05)
    assert found.hausdorff_95_mm == pytest.approx(3.8, abs=0.05)


def test_one_sided_asks_whether_the_estimate_lies_near_the_truth():
    part, whole = sphere(10, (30, 0, 0)), sphere(10)
    both = trimesh.util.concatenate(
        [trimesh.Trimesh(m.vertices_mm, m.faces) for m in (part, whole)]
    )
    estimate = Mesh(both.vertices, both.faces)
    assert surface_distances(estimate, whole).hausdorff_one_sided_mm == pytest.approx(30, abs=0.1)
    assert surface_distances(whole, estimate).hausdorff_one_sided_mm == pytest.approx(0, abs=1e-6)


@given(st.integers(0, 10_000))
@example(758)  # a corner whose triangles are thin
@settings(max_examples=8, deadline=None)
def test_distances_obey_their_laws(seed):
    a, b = (Mesh(m.vertices_mm, m.faces) for m in (lumpy(seed), lumpy(seed + 1)))
    there, back = surface_distances(a, b, 2.0), surface_distances(b, a, 2.0)
    assert there.hausdorff_mm == back.hausdorff_mm
    assert there.hausdorff_mm == max(there.hausdorff_one_sided_mm, back.hausdorff_one_sided_mm)
    assert there.surface_mm == pytest.approx(back.surface_mm)
    assert there.surface_mm < there.hausdorff_95_mm <= there.hausdorff_mm
    assert surface_distances(a, a, 2.0).hausdorff_mm < 1e-6
    turn = trimesh.transformations.rotation_matrix(1.0, (1, 2, 3))[:3, :3]
    turned = [m.with_vertices(m.vertices_mm @ turn.T + 100) for m in (a, b)]
    assert surface_distances(*turned, 2.0).hausdorff_mm == pytest.approx(there.hausdorff_mm)


def uneven(seed):
    """Triangles from needles to plates, some of them points or lines."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(0, [30.0, 20.0, 3.0], (150, 3))
    vertices[1], vertices[3] = vertices[0], (vertices[2] + vertices[4]) / 2
    faces = [[0, 1, 5], [2, 3, 4], *rng.integers(0, 150, (200, 3))]
    return Mesh(vertices, np.array(faces))


def test_samples_carry_the_whole_area_evenly():
    mesh = lumpy(3)
    points, area = surface_samples(mesh, 0.5)
    assert area.sum() == pytest.approx(trimesh.Trimesh(mesh.vertices_mm, mesh.faces).area)
    assert distance_to_surface(points, mesh).max() < 1e-9
    # First moments: sums over samples equal the exact integrals over the triangles.
    corners = mesh.vertices_mm[mesh.faces]
    size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
                          axis=1) / 2  # fmt: skip
    np.testing.assert_allclose(area @ points, size @ corners.mean(1), rtol=1e-9, atol=1e-6)


def test_empty_surfaces_are_refused():
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    with refused(InputError):
        surface_distances(sphere(5), nothing)


def test_box_centers():
    assert box_center_distance(box((9, 9, 9), (3, 4, 0)), sphere(2)) == pytest.approx(5.0)


def test_a_shared_edge_belongs_to_one_triangle():
    corners = np.array([[0.0, 0, 0], [8, 0, 0], [8, 8, 0], [0, 8, 0]])
    square = corners[np.array([[0, 1, 2], [0, 2, 3]])]
    hits = np.zeros((10, 10), int)
    for _, i, j, _ in cover(square, (10, 10)):
        np.add.at(hits, (i, j), 1)
    assert hits.max() == 1
    assert hits.sum() == 64


@pytest.mark.parametrize("seed", range(4))
def test_voxels_agree_with_an_independent_inside_test(seed):
    mesh = lumpy(seed)
    rng = np.random.default_rng(seed)
    oblique = np.eye(4)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    oblique[:3, :3] = turn * [0.9, 1.1, 1.3]
    oblique[:3, 3] = -oblique[:3, :3] @ [20, 20, 20]
    inside = voxelise(mesh, oblique, (40, 41, 42))
    index = np.stack(np.meshgrid(*map(np.arange, inside.shape), indexing="ij"), -1).reshape(-1, 3)
    points = index @ oblique[:3, :3].T + oblique[:3, 3]
    oracle = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).contains(points)
    assert inside.sum() > 5000
    assert np.count_nonzero(inside.ravel() != oracle) <= 2  # float32 rays of the oracle


def test_voxel_volume_of_analytic_shapes():
    # Corners between voxel centres: the count is exact.
    cube = voxelise(box((10, 12, 14)), grid((-9.75, -9.75, -9.75), 0.5), (40, 40, 40))
    assert cube.sum() == 20 * 24 * 28
    # Faces exactly through voxel centres: half-open, so still the exact volume.
    assert voxelise(box((10, 12, 14)), grid((-10, -10, -10), 0.5), (40, 40, 40)).sum() == 13440
    filled = voxelise(sphere(10, subdivisions=5), grid((-12, -12, -12), 0.25), (96, 96, 96))
    assert filled.sum() * 0.25**3 == pytest.approx(4 / 3 * np.pi * 1000, rel=3e-3)


def test_voxels_beyond_the_grid_are_cut_and_overlaps_leave_no_hole():
    half = voxelise(box((10, 10, 10)), grid((0.25, -9.75, -9.75), 0.5), (40, 40, 40))
    assert half.sum() == 10 * 20 * 20
    low_cut = voxelise(box((10, 10, 10)), grid((-9.75, -9.75, 0.25), 0.5), (40, 40, 40))
    assert low_cut.sum() == 20 * 20 * 10
    assert not voxelise(sphere(3, (99, 0, 0)), grid((-9, -9, -9), 1.0), (18, 18, 18)).any()
    two = trimesh.util.concatenate(
        [trimesh.creation.box((10, 10, 10)), trimesh.creation.box((10, 10, 20))]
    )
    union = voxelise(Mesh(two.vertices, two.faces), grid((-14.75,) * 3, 0.5), (60, 60, 60))
    assert union.sum() == 20 * 20 * 40


def test_tumor_wins_over_organ():
    anatomy = Anatomy((box((20, 20, 20)), box((6, 6, 6), (8, 0, 0))))
    labels = label_grid(anatomy, grid((-14.5,) * 3, 1.0), (30, 30, 30))
    assert np.bincount(labels.ravel())[1:].tolist() == [20**3 - 5 * 36, 6**3]


def test_ious_of_shifted_boxes_are_exact():
    reference = Anatomy((box((20, 20, 20)), box((6, 6, 6))))
    shifted = Anatomy((box((20, 20, 20), (1, 0, 0)), box((6, 6, 6), (2, 0, 0))))
    frame, shape = grid((-14.5,) * 3, 1.0), (30, 30, 30)
    estimate = CameraLabels(label_grid(shifted, frame, shape), frame)
    ious = label_ious(estimate, reference)
    assert ious["tumor_1"] == pytest.approx(4 / 8)
    # Common organ box 19 x 20 x 20 without either tumor (together 8 x 6 x 6); each has 8000 - 216.
    common = 19 * 400 - 8 * 36
    assert ious["kidney"] == pytest.approx(common / (2 * (8000 - 216) - common))
    assert mean_iou(ious) == pytest.approx((ious["kidney"] + ious["tumor_1"]) / 2)


@pytest.mark.parametrize(("shift", "radius", "expected"), [(3, 10, 3), (0, 12, 0), (1, 8, 3)])
def test_the_outward_miss_of_balls(shift, radius, expected):
    reference, estimate = sphere(10.0), sphere(radius, (shift, 0, 0))
    assert outward_miss(estimate, reference) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(
    "target",
    [lumpy(7), box((22, 25, 28), (2, 1, 0)), uneven(3), sphere(12.0)],
    ids=["fine", "coarse", "uneven", "round"],
)
def test_nearest_places_are_those_of_all_triangles(target):
    """Points near to it, far from it, on it, and where all of it is equally far."""
    rng = np.random.default_rng(1)
    points = np.concatenate([
        surface_samples(lumpy(6), 4.0)[0][::5], rng.normal(0, 80.0, (30, 3)),
        target.vertices_mm[:20], np.zeros((1, 3)),
    ])  # fmt: skip
    triangles = target.vertices_mm[target.faces]
    each = (closest_point(triangles, np.tile(p, (len(triangles), 1))) for p in points)
    exact = np.array(
        [np.linalg.norm(q - p, axis=1).min() for p, q in zip(points, each, strict=True)]
    )
    places = nearest_places(target, points)
    np.testing.assert_allclose(np.linalg.norm(places - points, axis=1), exact, atol=1e-6)
    assert np.linalg.norm(nearest_places(target, places) - places, axis=1).max() < 1e-6
    assert (distance_to_surface(points, target) == np.linalg.norm(points - places, axis=1)).all()


def test_truth_outside_the_estimates_grid_counts_as_missed():
    reference = Anatomy((box((20, 20, 20)),))
    whole, half = grid((-14.5,) * 3, 1.0), grid((0.5, -14.5, -14.5), 1.0)
    for frame, shape, iou in ((whole, (30, 30, 30), 1.0), (half, (30, 30, 30), 0.5)):
        estimate = CameraLabels(label_grid(reference, frame, shape), frame)
        assert label_ious(estimate, reference)["kidney"] == pytest.approx(iou)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_hausdorff_agrees_with_scipy_on_dense_samples(seed):
    a, b = lumpy(seed), lumpy(seed + 10)
    dense_a, dense_b = (trimesh.sample.sample_surface(
        trimesh.Trimesh(m.vertices_mm, m.faces, process=False), 60_000, seed=0
    )[0] for m in (a, b))  # fmt: skip
    there, back = directed_hausdorff(dense_a, dense_b)[0], directed_hausdorff(dense_b, dense_a)[0]
    found = surface_distances(a, b)
    assert found.hausdorff_one_sided_mm == pytest.approx(there, abs=0.12)
    assert found.hausdorff_mm == pytest.approx(max(there, back), abs=0.12)
    assert found.hausdorff_mm > 1.0
