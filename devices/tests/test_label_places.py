"""Labels of places near each other are hung so that none covers another."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from tumortrack_devices.viewer.arrange import ANCHORS, arranged, boxes

SIZES = np.array([[3.0, 0.5], [2.0, 0.5], [2.5, 0.8]])
WIDE = np.array([100.0, 100.0])


def hung(places: np.ndarray, sizes: np.ndarray, anchors: list) -> np.ndarray:
    """Low and high corner of each label."""
    chosen = [ANCHORS.index(anchor) for anchor in anchors]
    return boxes(places, sizes)[np.arange(len(places)), chosen]


def overlap(corners: np.ndarray) -> bool:
    return any(
        (np.minimum(one[1], other[1]) - np.maximum(one[0], other[0]) > 1e-9).all()
        for one, other in combinations(corners, 2)
    )


@pytest.mark.parametrize("share", [1.0, 0.4, 0.0625])
def test_no_label_covers_another_nor_would_a_smaller_one(share):
    rng = np.random.default_rng(7)
    for _ in range(300):
        places = rng.uniform(-1.5, 1.5, (3, 2))
        anchors = arranged(places, SIZES, WIDE)
        assert not overlap(hung(places, share * SIZES, anchors))
        low, high = hung(places, SIZES, anchors).swapaxes(0, 1)
        assert ((low <= places + 1e-12) & (places <= high + 1e-12)).all()  # at their places


def test_even_labels_of_one_place_are_apart():
    places = np.zeros((3, 2))
    assert not overlap(hung(places, SIZES, arranged(places, SIZES, WIDE)))


def test_they_stay_in_the_view_where_that_is_possible():
    view = np.array([4.0, 3.0])
    for place in ([3.9, 0.0], [-3.9, 2.9], [0.0, -2.9], [3.9, 2.9]):
        places = np.array([place])
        (corners,) = hung(places, SIZES[:1], arranged(places, SIZES[:1], view))
        assert (np.abs(corners) <= view + 1e-12).all()


def test_they_stay_as_they_hang_until_they_must_not():
    places = np.array([[0.0, 0.0], [10.0, 0.0]])
    for anchor in ANCHORS:
        assert arranged(places, SIZES[:2], WIDE, [anchor, anchor]) == [anchor, anchor]
    near = np.array([[0.0, 0.0], [0.1, 0.0]])
    assert arranged(near, SIZES[:2], WIDE, ["top-left", "top-left"]).count("top-left") <= 1


def test_no_place_needs_no_label():
    assert arranged(np.zeros((0, 2)), np.zeros((0, 2)), WIDE) == []
