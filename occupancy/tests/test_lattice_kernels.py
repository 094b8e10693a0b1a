"""Kernels on lattices of logits against what NumPy, SciPy and slow loops say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from refused import refused
from tumortrack_occupancy import kernels

COARSE, FINE = (5, 4, 6), (9, 7, 11)  # the second of half the step


def lattice(seed: int, classes: int, shape=COARSE) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(*shape, classes)).astype(np.float32)


def interpolated(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """By SciPy, in double precision."""
    columns = [
        ndimage.map_coordinates(values[..., n].astype(float), places.T, order=1, mode="nearest")
        for n in range(values.shape[-1])
    ]
    return np.stack(columns, axis=-1)


def at_half(coarse: np.ndarray) -> np.ndarray:
    places = np.indices(FINE).reshape(3, -1).T / 2
    return interpolated(coarse, places).reshape(*FINE, -1)


@pytest.mark.parametrize("classes", [1, 2, 3, 4, 7])
def test_labels_and_leads_are_those_of_sorting(classes):
    logits = lattice(0, classes).reshape(-1, classes)
    labels, leads = kernels.leading(np.asfortranarray(logits))
    ranked = np.sort(np.column_stack([np.full(len(logits), -np.inf), logits]), axis=1)
    np.testing.assert_array_equal(labels, logits.argmax(1))
    np.testing.assert_array_equal(leads, (ranked[:, -1] - ranked[:, -2]).astype(np.float32))


def test_interpolation_is_trilinear_and_at_the_border_beyond():
    values = lattice(1, 3)
    places = np.random.default_rng(2).uniform(-2, 8, (500, 3)).astype(np.float32)
    found = kernels.trilinear(values, places)
    np.testing.assert_allclose(found, interpolated(values, places), atol=1e-6)  # of numbers near 1
    flat = kernels.trilinear(values[:, :1], places)  # a single layer
    np.testing.assert_allclose(flat, interpolated(values[:, :1], places), atol=1e-6)
    nowhere = np.full((1, 3), np.nan, np.float32)
    np.testing.assert_array_equal(kernels.trilinear(values, nowhere), values[:1, 0, 0])
    with refused(ValueError):
        kernels.trilinear(values[:0], places)


def test_a_lattice_is_halved_in_slabs():
    coarse, fine = lattice(3, 2), np.full((*FINE, 2), np.nan, np.float32)
    kernels.halved(coarse, fine, 0, 4)
    assert np.isnan(fine[4:]).all()
    kernels.halved(coarse, fine, 4, 9)
    np.testing.assert_allclose(fine, at_half(coarse), atol=1e-6)
    for more, planes in (((10, 7, 11), (0, 9)), (FINE, (0, 10)), (FINE, (-1, 3))):
        with refused(ValueError):
            kernels.halved(coarse, np.empty((*more, 2), np.float32), *planes)


def test_mispredicted_points_have_another_label_by_more_than_the_limit():
    coarse, rng = lattice(4, 3), np.random.default_rng(5)
    flat = rng.permutation(np.prod(FINE))[:200]
    logits = rng.normal(size=(200, 3)).astype(np.float32)
    expected, row = at_half(coarse).reshape(-1, 3)[flat], np.arange(200)
    predicted, label = expected.argmax(1), logits.argmax(1)
    before = expected[row, predicted] - expected[row, label]
    off = before + logits[row, label] - logits[row, predicted]
    wrong = kernels.mispredicted(coarse, FINE, flat, logits, 0.5)
    assert 20 < len(wrong) < 180
    np.testing.assert_array_equal(wrong, flat[(predicted != label) & (off > 0.5)])
    for outside in (-1, np.prod(FINE)):
        with refused(ValueError):
            kernels.mispredicted(coarse, FINE, np.array([outside]), logits[:1], 0.5)


@pytest.mark.parametrize("shape", [FINE, (8, 6, 10)])
def test_cells_are_filled_where_corners_agree_and_noted_elsewhere(shape):
    coarse, labels = lattice(6, 2), np.zeros(COARSE, np.uint8)
    labels[3:] = 1
    certain = labels.copy()
    certain[0, 0, 0] = 255
    fine = np.full(shape, 9, np.uint8)
    parts = [kernels.fill_cells(coarse, labels, certain, fine, *part) for part in ((0, 2), (2, 5))]
    flat, expected, between = (np.concatenate(part) for part in zip(*parts, strict=True))
    a, b, c = np.unravel_index(flat, shape)
    i, j, k = np.indices(shape) // 2
    np.testing.assert_array_equal(fine, labels[i, j, k])
    open_cell = (i == 2) | ((i == 0) & (j == 0) & (k == 0))  # labels change; the uncertain corner
    np.testing.assert_array_equal(np.sort(flat), np.flatnonzero(open_cell))
    np.testing.assert_allclose(expected, at_half(coarse)[a, b, c], atol=1e-6)
    np.testing.assert_array_equal(between, (a % 2 + b % 2 + c % 2) > 0)


def test_neighbours_are_what_dilation_adds():
    shape, rng = (6, 5, 7), np.random.default_rng(7)
    known = rng.uniform(size=shape) < 0.3
    frontier = np.flatnonzero(rng.uniform(size=shape) < 0.05)
    touched = np.zeros(shape, bool)
    touched.ravel()[frontier] = True
    touched = ndimage.binary_dilation(touched, np.ones((3, 3, 3)))
    marked = known.ravel().copy()
    found = kernels.neighbours(shape, frontier, marked)
    np.testing.assert_array_equal(np.sort(found), np.flatnonzero(touched & ~known))
    np.testing.assert_array_equal(marked.reshape(shape), touched | known)
    assert not len(kernels.neighbours(shape, frontier, marked))
    with refused(ValueError):
        kernels.neighbours((6, 5, 8), frontier, marked)
