"""Labelled points: correct, distributed as configured, and carried along by deformations."""

import numpy as np
import pytest

from refused import refused
from render_objects import ELLIPSOIDS, anatomy, winding_number
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import labels_of, surface_distance
from tumortrack.simulation.deform.base import View
from tumortrack.simulation.deform.drag import CONFIGURATIONS, DragConfig
from tumortrack.simulation.scene import OccupancyConfig
from tumortrack_occupancy.training.query_points import OccupancyPool

ANATOMY = anatomy()
VIEW = View(ANATOMY, lambda points_ct: points_ct[:, 1] < -10)
SMALL = OccupancyConfig(per_side=100, pool=12_000)


@pytest.fixture(scope="module")
def pool():
    return OccupancyPool(ANATOMY, SMALL, seed=4)


def analytic(points):
    """Labels by the ellipsoids' equations, and how far (about, mm) the nearest surface is."""
    labels, clear = np.zeros(len(points), np.uint8), np.full(len(points), np.inf)
    for label, (axes, center) in enumerate(ELLIPSOIDS, start=1):
        scaled = np.linalg.norm((points - np.array(center)) / np.array(axes), axis=1)
        labels[scaled < 1] = label
        clear = np.minimum(clear, np.abs(scaled - 1) * min(axes))
    return labels, clear


def test_labels_agree_with_the_ellipsoids(pool):
    points, labels = pool.draw(np.random.default_rng(0))
    truth, clear = analytic(points)
    sure = clear > 0.2  # the meshes' facets lie up to 0.1 mm inside the ellipsoids
    assert sure.mean() > 0.8
    np.testing.assert_array_equal(labels[sure], truth[sure])
    assert set(labels) == {0, 1, 2, 3}
    assert labels.dtype == np.uint8


def test_every_draw_has_k_points_on_each_side_of_each_part_and_15_percent_far(pool):
    k, total = 100, round(600 / 0.85)
    for seed in range(5):
        points, labels = pool.draw(np.random.default_rng(seed))
        assert len(points) == len(labels) == total
        for n, (axes, center) in enumerate(ELLIPSOIDS):
            scaled = np.linalg.norm((points - np.array(center)) / np.array(axes), axis=1)
            own = scaled[2 * k * n : 2 * k * (n + 1)]
            assert (own[:k] < 1).all()  # inside is inside
            assert (own[k:] > 0.995).all()  # facets lie a little inside the ellipsoid
            assert (labels[2 * k * n : 2 * k * n + k] > n).all()
        far = points[600:]
        assert np.ptp(far, axis=0).min() > 100  # beyond the organ's 56 and 48 mm
        assert len(np.unique(points[:200], axis=0)) == 200


def test_kept_points_are_the_nearest_and_outside_the_wall(pool):
    rng = np.random.default_rng(0)
    for part, mesh in zip(pool.parts, ANATOMY.parts, strict=True):
        assert part.distance_mm.min() > SMALL.wall_mm
        chosen = part.nearest(100, rng)
        outside = chosen[100:]
        assert np.median(part.distance_mm[outside]) < 0.6 * np.median(
            part.distance_mm[~part.inside]
        )
        lower, upper = mesh.box_mm
        half = (upper - lower) / 2 * SMALL.box_factor
        offset = np.abs(part.points_ct - (lower + upper) / 2)
        assert (offset <= half + 1e-3).all()
        assert (offset.max(0) > 0.99 * half).all()


def test_even_points_measure_volume(pool):
    _, labels = pool.parts[0].draw_evenly(np.random.default_rng(0), 10_000)
    volumes = [np.prod(axes) * 4 / 3 * np.pi for axes, _ in ELLIPSOIDS]
    box = np.prod(2 * 1.5 * np.array(ELLIPSOIDS[0][0]))
    assert (labels > 0).mean() == pytest.approx(volumes[0] / box, rel=0.05)
    for label in (2, 3):
        assert (labels == label).mean() == pytest.approx(volumes[label - 1] / box, rel=0.25)


def test_pools_and_draws_replay():
    small = OccupancyConfig(per_side=20, pool=2000)
    one, two, other = (OccupancyPool(ANATOMY, small, seed) for seed in (7, 7, 8))
    for a, b in zip(
        one.draw(np.random.default_rng(1)), two.draw(np.random.default_rng(1)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
    points = one.draw(np.random.default_rng(1))[0]
    assert not np.array_equal(points, one.draw(np.random.default_rng(2))[0])
    assert not np.array_equal(points, other.draw(np.random.default_rng(1))[0])


def test_a_pool_too_small_for_a_part_is_refused():
    with refused(InputError, 256):
        OccupancyPool(ANATOMY, OccupancyConfig(per_side=256, pool=1000), 0)


@pytest.mark.parametrize(
    ("steps", "changes"), [(CONFIGURATIONS[3], 0.002), (((16, 33.3, 2), (8, 11.7, 1)), 0.04)]
)
def test_labels_travel_through_a_deformation(pool, steps, changes):
    points, labels = (values[::2] for values in pool.draw(np.random.default_rng(5)))
    drags = DragConfig(steps=steps).sample(VIEW, np.random.default_rng(5))
    moved = drags.apply(points)
    assert np.linalg.norm(moved - points, axis=1).max() > 2
    oracle = np.zeros(len(moved), np.uint8)
    clear = np.full(len(moved), np.inf)
    for label, part in enumerate(ANATOMY.parts, start=1):
        deformed = part.with_vertices(drags.apply(part.vertices_mm))
        oracle[winding_number(deformed, moved) > 0.5] = label
        clear = np.minimum(clear, surface_distance(deformed, moved))
    sure = clear > 0.3
    assert sure.mean() > 0.8
    assert np.mean(oracle[sure] != labels[sure]) < 0.005
    stale = labels_of(ANATOMY, moved)  # the undeformed anatomy is no answer
    assert np.mean(stale[sure] != labels[sure]) > changes
