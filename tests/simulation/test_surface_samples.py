"""Which part points lie in, and how far from its surface."""

import numpy as np

from render_objects import sphere
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
