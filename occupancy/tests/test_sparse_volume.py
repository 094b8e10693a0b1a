"""The volume from few queries equals the dense one, voxel by voxel."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dense_objects import dense_margins
from tumortrack.registration.frame import grid_over
from tumortrack_occupancy.sparse import (
    START_MM,
    InterpolationLimit,
    halved_lattice,
    query_uncertain,
    sparse_logits,
    sparse_margins,
)
from tumortrack_occupancy.volume import lattice_over, margins_on, part_surfaces

NAMES = ("kidney", "tumor_1", "tumor_2")


class Field:
    """Logits of a wavy organ with two balls in or at it; counts the queries."""

    def __init__(self, seed, small_mm=8.0):
        rng = np.random.default_rng(seed)
        self.turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        self.half_mm = rng.uniform([40, 22, 18], [60, 32, 26])
        self.waves = rng.normal(size=(4, 3)) / 12
        self.balls = [(self._near(rng), 12.0), (self._near(rng), small_mm / 2)]
        self.queries = 0

    def _near(self, rng):
        way = rng.normal(size=3)
        return self.turn @ (self.half_mm * way / np.linalg.norm(way) * rng.uniform(0.2, 1.0))

    def __call__(self, points):
        self.queries += len(points)
        points = points.astype(np.float64)
        at = points @ self.turn / self.half_mm
        organ = 25 * (1 - np.linalg.norm(at, axis=1))
        organ += 1.5 * np.sin(points @ self.waves.T).sum(1)
        balls = [radius - np.linalg.norm(points - middle, axis=1) for middle, radius in self.balls]
        inside = np.maximum.reduce([organ, *balls])
        logits = np.column_stack([-inside, inside, *(inside + 3 * ball for ball in balls)])
        return torch.tensor(logits, dtype=torch.float32)


def both(field, grid, start_mm=START_MM):
    box = np.array([[-66.0, -66, -66], [66, 66, 66]])
    camera_from_index, shape = grid_over(box, grid)
    sparse = sparse_margins(field, camera_from_index, shape, start_mm)
    few, field.queries = field.queries, 0
    dense = dense_margins(field, camera_from_index, shape)
    return sparse, dense, few, field.queries, camera_from_index


@pytest.mark.slow
@given(st.integers(0, 10**6), st.sampled_from([93, 130]))
@settings(max_examples=4, deadline=None, derandomize=True)
def test_voxels_are_those_of_the_dense_volume(seed, grid):
    (margins, labels), (all_margins, all_labels), few, many, _ = both(Field(seed), grid)
    # One voxel of two million at the kinks where balls meet the organ, in one field of ten.
    assert (labels != all_labels).sum() <= 3
    assert ((margins > 0) != (all_margins > 0)).sum() <= 6
    assert few < many / 2


@pytest.mark.slow
def test_at_the_paper_s_grid_most_queries_are_saved():
    (_, labels), (_, all_labels), few, many, _ = both(Field(3), 200)
    assert np.array_equal(labels, all_labels)
    assert many > 10 * few


def test_surfaces_are_those_of_the_dense_volume():
    (margins, labels), (all_margins, all_labels), _, _, camera_from_index = both(Field(8), 110)
    mine = part_surfaces(margins, labels, camera_from_index, NAMES)
    theirs = part_surfaces(all_margins, all_labels, camera_from_index, NAMES)
    for name in NAMES:
        assert np.array_equal(mine[name].faces, theirs[name].faces)
        off_mm = np.linalg.norm(mine[name].vertices_mm - theirs[name].vertices_mm, axis=1)
        assert np.median(off_mm) < 1e-4  # most voxels beside a surface are queried
        assert off_mm.max() < camera_from_index[0, 0] / 4  # linear over a kink


@given(st.tuples(*[st.floats(-3, 3)] * 3))
@settings(max_examples=8, deadline=None, derandomize=True)
def test_a_tumor_of_6_9_mm_is_found_wherever_it_lies(off):
    field = Field(5)
    field.balls[1] = (np.array([20.0, 30.0, 45.0]) + off, START_MM * 3**0.5 / 2 + 1e-6)
    box = np.array([[-66.0, -66, -66], [66, 66, 66]])
    camera_from_index, shape = grid_over(box, 138)  # voxels of 0.995 mm, the first lattice of 3.98
    _, labels = sparse_margins(field, camera_from_index, shape)
    found = (labels == 3).sum() * camera_from_index[0, 0] ** 3
    assert found == pytest.approx(4 / 3 * np.pi * (START_MM * 3**0.5 / 2) ** 3, rel=0.15)


def test_without_a_coarse_lattice_it_is_the_dense_volume():
    (margins, labels), (all_margins, all_labels), few, many, _ = both(Field(1), 40)
    assert few == many
    assert np.array_equal(labels, all_labels)
    assert np.array_equal(margins, all_margins)


def test_labels_of_points_are_those_of_querying_all():
    field, rng = Field(4), np.random.default_rng(0)
    lattice = lattice_over(field, np.array([[-66.0, -66, -66], [66, 66, 66]]), 24)
    points = rng.uniform(*lattice.box_mm, (40_000, 3)).astype(np.float32)
    field.queries = 0
    logits = sparse_logits(field, lattice, points)
    few, all_logits = field.queries, field(points).numpy()
    assert (logits.argmax(1) != all_logits.argmax(1)).sum() <= 20
    assert 100 < few < 4000
    plain = lattice.interpolate(points).argmax(1) != all_logits.argmax(1)
    assert plain.mean() > 0.001  # so many would be wrong without queries


def test_a_lattice_is_linear_between_its_points_and_constant_outside():
    slope = np.array([0.3, -0.2, 0.5])

    def plane(points):
        return torch.tensor(np.column_stack([points @ slope, 1 - points @ slope]))

    lattice = lattice_over(plane, np.array([[-5.0, 0, 10], [7, 8, 19]]), 4)
    points = np.random.default_rng(0).uniform([-5, 0, 10], [7, 8, 19], (50, 3)).astype(np.float32)
    assert lattice.interpolate(points)[:, 0] == pytest.approx(points @ slope, abs=1e-4)
    corner = np.array([[-5.0, 0, 10], [-50, -9, 0]], np.float32)
    assert lattice.interpolate(corner)[1] == pytest.approx(lattice.interpolate(corner)[0])


def test_a_halved_lattice_has_the_labels_of_querying_all():
    field = Field(6)
    box = np.array([[-66.0, -66, -66], [66, 66, 66]])
    lattice = lattice_over(field, box, 24)
    field.queries = 0
    finer = halved_lattice(field, lattice)
    assert field.queries < finer.logits[..., 0].size / 2
    assert finer.box_mm == pytest.approx(lattice.box_mm)
    margins, labels, camera_from_index = margins_on(finer)
    all_margins, all_labels = dense_margins(field, camera_from_index, labels.shape)
    assert np.array_equal(labels, all_labels)
    assert np.array_equal(margins > 0, all_margins > 0)


def test_what_is_known_already_is_neither_a_measure_nor_queried():
    """Fewer points are unknown than the first queries take: the known ones are not among them."""
    leads = np.full(1000, np.inf, np.float32)
    leads[:100] = np.linspace(0, 1, 100)
    expected = np.zeros((1000, 2), np.float32)
    limit = InterpolationLimit()
    queried = query_uncertain(
        expected, leads, lambda which: np.zeros((len(which), 2), np.float32), limit
    )
    assert np.array_equal(queried, np.isfinite(leads))
    assert limit.limit == 1


def test_no_point_of_the_coarse_lattice_is_queried_again():
    field, places = Field(1), []

    def noted(points_mm):
        places.append(np.array(points_mm))
        return field(points_mm)

    coarse = lattice_over(field, np.array([[-70.0] * 3, [70.0] * 3]), 20)
    halved_lattice(noted, coarse)
    steps = (np.concatenate(places) - coarse.origin_mm) / coarse.step_mm
    old = (np.abs(steps - np.rint(steps)) < 1e-3).all(1)
    assert len(old) > 500
    assert not old.any()
