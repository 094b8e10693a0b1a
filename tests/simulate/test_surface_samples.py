"""Which part points lie in, and how far from its surface."""

import numpy as np
import pytest

from render_objects import ellipsoid, sphere, winding_number
from tumortrack.core.mesh_query import labels_of, surface_distance
from tumortrack.core.types import Anatomy


def test_a_tumor_wins_over_the_organ_and_the_later_over_the_earlier():
    nested = Anatomy((sphere(30, (0, 0, 0)), sphere(12, (0, 0, 0)), sphere(5, (8, 0, 0))))
    points = np.array([[40.0, 0, 0], [20, 0, 0], [-8, 0, 0], [8, 0, 0], [12.5, 0.1, 0.2]])
    np.testing.assert_array_equal(labels_of(nested, points), [0, 1, 2, 3, 3])


def test_distance_to_a_sphere_is_about_right():
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2000, 3))
    radius = rng.uniform(5, 30, 2000)
    points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * radius[:, None]
    true = np.abs(radius - 15)
    distance = surface_distance(sphere(15, (0, 0, 0)), points)
    assert (distance > true - 0.03).all()  # of samples of the surface: never too near ...
    assert (distance - true)[true > 2].max() < 0.1  # ... and hardly too far
    assert distance[true < 0.2].max() < 0.5


@pytest.mark.parametrize("finer", [2, 4])
def test_distances_are_those_to_the_nearest_sample_of_a_surface(finer):
    mesh = ellipsoid((20, 9, 14), (3, 4, 5), finer)
    points = np.random.default_rng(1).uniform(-40, 40, (300, 3))
    corners = mesh.vertices_mm[mesh.faces]
    shares = np.array([(1, 1, 1), (4, 1, 1), (1, 4, 1), (1, 1, 4), (1, 1, 0), (0, 1, 1), (1, 0, 1)])
    inner = np.einsum("fkx,wk->wfx", corners, shares / shares.sum(1, keepdims=True)).reshape(-1, 3)
    samples = np.concatenate([mesh.vertices_mm, inner])
    nearest = np.linalg.norm(points[:, None] - samples, axis=2).min(1)
    distance = surface_distance(mesh, points)
    np.testing.assert_allclose(distance[nearest < 2], nearest[nearest < 2], rtol=1e-6)
    assert (distance - nearest).min() > -1e-4
    assert (distance - nearest).max() < (1e-4 if finer == 2 else 0.1)  # long edges: all are near


def test_ray_parity_agrees_with_winding_numbers():
    part = ellipsoid((20, 9, 14), (3, 4, 5), 3)
    points = np.random.default_rng(0).uniform(-25, 25, (1500, 3))
    inside = winding_number(part, points) > 0.5
    np.testing.assert_array_equal(labels_of(Anatomy((part,)), points) == 1, inside)
    assert 50 < inside.sum() < 400
