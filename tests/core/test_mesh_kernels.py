"""Points inside a surface: against solid angles, and shapes of known size; farthest points."""

import numpy as np
import pytest
import trimesh

from refused import refused
from render_objects import bumpy, winding_number
from tumortrack.core.mesh_kernels import farthest
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Mesh


def test_points_inside_agree_with_the_winding_number():
    mesh = bumpy(30, (10, 20, 30), 4)
    lower, upper = mesh.box_mm
    points = np.random.default_rng(1).uniform(lower - 5, upper + 5, (1500, 3))
    expected = winding_number(mesh, points) > 0.5
    assert 300 < expected.sum() < 1200
    np.testing.assert_array_equal(contains(mesh, points), expected)


def test_a_grid_in_line_with_the_faces_is_counted_exactly():
    box = trimesh.creation.box((1, 1, 1))
    mesh = Mesh(box.vertices, box.faces)
    grid = np.stack(np.meshgrid(*[np.arange(-1, 1.01, 0.1) + 0.05] * 3), -1).reshape(-1, 3)
    inside = contains(mesh, grid)
    assert inside.sum() == 10**3
    np.testing.assert_array_equal(inside, (np.abs(grid) < 0.5).all(1))
    assert not contains(mesh, grid[:0]).any()


def test_what_stands_inside_a_hollow_is_outside():
    outer, inner = trimesh.creation.icosphere(3, 10.0), trimesh.creation.icosphere(3, 5.0)
    inner.invert()
    both = trimesh.util.concatenate([outer, inner])
    points = np.array([[0.0, 0, 0], [0, 7, 0], [0, 0, 12], [-7, 1, 1]])
    inside = contains(Mesh(both.vertices, both.faces), points)
    np.testing.assert_array_equal(inside, [False, True, False, True])


@pytest.mark.parametrize("n", [1, 5, 16, 77])
def test_farthest_points_are_those_of_a_plain_search(n):
    points = np.random.default_rng(n).normal(size=(2, 3, n)).astype(np.float32)
    chosen = np.empty((2, min(n, 9)), np.int64)
    farthest(points, np.array([0, n - 1]), chosen)
    for cloud, found in zip(points, chosen, strict=True):
        away = np.full(n, np.inf)
        for step, newest in enumerate(found[:-1], start=1):
            away = np.minimum(away, ((cloud - cloud[:, [newest]]) ** 2).sum(0))
            assert away[found[step]] == pytest.approx(away.max(), rel=1e-6)
    assert chosen[:, 0].tolist() == [0, n - 1]
    for first in (-1, n):
        with refused(ValueError):
            farthest(points, np.array([0, first]), chosen)
