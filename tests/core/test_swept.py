"""What a line sweeps whose ends move."""

from __future__ import annotations

import numpy as np
import pytest

from tumortrack.core.geometry import swept_places


@pytest.mark.parametrize("step_mm", [0.7, 1.5])
def test_places_lie_on_what_is_swept_and_leave_no_gap(step_mm):
    rng = np.random.default_rng(0)
    ends = np.cumsum(rng.normal(0, 4, (6, 2, 3)), axis=0) + [[[0, 0, 0]], [[0, 0, 9]]] * 3
    places = swept_places(ends, step_mm)
    between, along = rng.random((1000, 1, 1)), rng.random((1000, 1))
    pose = rng.integers(0, 5, 1000)
    lines = ends[pose] + between * (ends[pose + 1] - ends[pose])
    swept = lines[:, 0] + along * (lines[:, 1] - lines[:, 0])
    near_mm = np.linalg.norm(swept[:, None] - places, axis=2).min(1)
    assert near_mm.max() <= step_mm / 2**0.5 + 1e-9
    # On it: as far from the swept samples as these lie from each other.
    off_mm = np.linalg.norm(places[:, None] - swept, axis=2).min(1)
    assert off_mm.max() < 2.0


def test_of_a_sideways_line_it_is_a_grid():
    places = swept_places(np.array([[[0.0, 0, 0], [0, 0, 3]], [[2, 0, 0], [2, 0, 3]]]), 1.0)
    grid = [(x, 0, z) for x in range(3) for z in range(4)]
    assert sorted(map(tuple, places.tolist())) == grid
    still = swept_places(np.zeros((3, 2, 3)) + [[0, 0, 0], [0, 0, 3]], 1.0)
    assert still.tolist() == [[0, 0, z] for z in range(4)]
