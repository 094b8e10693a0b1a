"""The dense volume: where voxels lie, pieces, closed surfaces of known fields."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from dense_objects import dense_margins
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import OccupancyCloud
from tumortrack.registration.frame import grid_over
from tumortrack_occupancy.volume import (
    drop_islands,
    keep_largest_pieces,
    part_surfaces,
)

NAMES = ("kidney", "tumor_1")
CENTRE = np.array([4.0, -7.0, 140.0])


def two_spheres(points_mm: np.ndarray) -> torch.Tensor:
    """Logits of an organ of radius 30 mm and a tumor of radius 10 mm at its top, (n, 3)."""
    organ = 30 - np.linalg.norm(points_mm - CENTRE, axis=1)
    tumor = 10 - np.linalg.norm(points_mm - CENTRE - [0, 0, -25], axis=1)
    inside = np.maximum(organ, tumor)
    outside = np.where(inside > 0, 0.0, -inside)
    logits = np.column_stack([outside, np.maximum(inside, 0), np.maximum(inside, 0) + tumor])
    return torch.tensor(logits, dtype=torch.float32)


@pytest.fixture(scope="module")
def dense():
    box = np.stack([CENTRE - [32, 32, 40], CENTRE + [32, 32, 32]]).astype(np.float32)
    camera_from_index, shape = grid_over(box, 64)
    return (*dense_margins(two_spheres, camera_from_index, shape), camera_from_index)


def test_the_grid_is_cubic_and_covers_the_points():
    box = np.array([[-40.0, 0, 100], [10, 30, 120]])
    camera_from_index, shape = grid_over(box, 50)
    assert max(shape) == 50
    np.testing.assert_allclose(np.diag(camera_from_index)[:3], camera_from_index[0, 0])
    corners = transform_points(camera_from_index, np.array([[0.0, 0, 0], np.array(shape) - 1.0]))
    half = camera_from_index[0, 0] / 2
    assert (corners[0] - half <= box[0]).all()
    assert (corners[1] + half >= box[1]).all()


def test_labels_at_voxel_centres_are_those_of_the_field(dense):
    margins, labels, camera_from_index = dense
    index = np.argwhere(np.ones(labels.shape, bool))
    logits = two_spheres(transform_points(camera_from_index, index.astype(float)))
    np.testing.assert_array_equal(labels.ravel(), logits.argmax(1).numpy())
    assert margins.shape == (2, *labels.shape)
    assert set(np.unique(labels)) == {0, 1, 2}


def test_surfaces_are_closed_outward_and_in_place(dense):
    margins, labels, camera_from_index = dense
    meshes = part_surfaces(margins, labels, camera_from_index, NAMES)
    for mesh in meshes.values():
        assert trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).is_watertight
        assert mesh.volume_mm3 > 0
    tumor = meshes["tumor_1"]
    radius = np.linalg.norm(tumor.vertices_mm - CENTRE - [0, 0, -25], axis=1)
    voxel = camera_from_index[0, 0]
    assert np.percentile(np.abs(radius - 10), 95) < 0.2 * voxel
    assert np.abs(radius - 10).max() < voxel  # where tumor, organ and outside meet
    assert meshes["kidney"].box_mm[0][2] == pytest.approx(CENTRE[2] - 35, abs=0.3)


def test_a_field_that_is_zero_at_voxels_still_gives_a_closed_surface():
    shape = (12, 12, 12)
    labels = np.zeros(shape, np.uint8)
    labels[3:8, 3:8, 3:8] = 1
    margins = np.zeros((1, *shape), np.float16)
    margins[0, 4:7, 4:7, 4:7] = 1.0  # the rest is a tie, inside and outside alike
    mesh = part_surfaces(margins, labels, np.eye(4), ("kidney",))["kidney"]
    assert trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).is_watertight


def test_islands_go_to_what_surrounds_them():
    labels = np.zeros((20, 10, 10), np.uint8)
    labels[1:12, 1:9, 1:9] = 1
    labels[3:6, 3:6, 3:6] = 2
    labels[9, 5, 5] = 2  # a tumor's island
    labels[16:18, 4, 4] = 1  # the organ's
    labels[18, 8, 8] = 2  # a tumor's, outside the organ
    kept = keep_largest_pieces(labels, 2)
    assert kept[9, 5, 5] == 1
    assert kept[16:].max() == 0
    assert (kept == 2).sum() == (kept[3:6, 3:6, 3:6] == 2).sum() == 27
    assert (kept > 0).sum() == 11 * 8 * 8


def test_a_part_without_a_voxel_has_no_surface(dense):
    margins, labels, camera_from_index = dense
    only_organ = np.minimum(labels, 1)
    assert set(part_surfaces(margins, only_organ, camera_from_index, NAMES)) == {"kidney"}


def test_points_of_dropped_islands_leave_the_cloud_too():
    """An organ with an island outside it and a tumor with an island inside the organ."""
    found = np.zeros((40, 30, 30), np.uint8)
    found[5:25, 5:25, 5:25] = 1
    found[8:12, 8:12, 8:12] = 2
    found[20:22, 20:22, 20:22] = 2  # the tumor's island
    found[32:36, 10:14, 10:14] = 1  # the organ's
    kept = keep_largest_pieces(found, 2)
    camera_from_index = np.diag([2.0, 2.0, 2.0, 1.0])
    camera_from_index[:3, 3] = [-30.0, -20.0, 100.0]
    rng = np.random.default_rng(0)
    index = rng.uniform(0, 1, (30_000, 3)) * (np.array(found.shape) - 1)
    labels = found[tuple(np.rint(index).astype(int).T)]
    inside = labels > 0
    points = transform_points(camera_from_index, index)[inside]
    probability = rng.uniform(size=inside.sum())
    cloud = OccupancyCloud(points, labels[inside], probability, 7)
    clean = drop_islands(cloud, found, kept, camera_from_index)
    truth = kept[tuple(np.rint(index[inside]).astype(int).T)]
    assert (truth == 0).sum() > 10
    assert ((truth == 1) & (cloud.labels == 2)).sum() > 3
    np.testing.assert_array_equal(clean.labels, truth[truth > 0])
    np.testing.assert_array_equal(clean.points_mm, cloud.points_mm[truth > 0])
    np.testing.assert_array_equal(clean.probability, cloud.probability[truth > 0])
    assert clean.stamp_ns == 7
    assert drop_islands(cloud, found, found, camera_from_index) is cloud
