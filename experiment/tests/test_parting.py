"""The membrane between a mold's halves is the one of least slope between its bounds."""

from __future__ import annotations

import numpy as np

from tumortrack_experiment.kit.parting import _relax


def test_the_membrane_is_level_in_the_mean_where_no_bound_holds_it():
    rng, shape = np.random.default_rng(0), (31, 24)
    low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
    low[8:14, 5:9], high[20:26, 12:18] = 3 + rng.random((6, 4)), -2 + rng.random((6, 6))
    heights = np.clip(np.zeros(shape), low, high)
    _relax(heights, low, high, 2 / (1 + np.pi / 31), 3000)
    around = np.pad(heights, 1, mode="reflect")
    mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
    held_up, held_down = heights == low, heights == high
    off = mean - heights
    assert (heights >= low).all()
    assert (heights <= high).all()
    # Steps fall below 1e-3, and are nearly twice what is left of the slope.
    assert np.abs(off[~held_up & ~held_down]).max() < 1e-3
    assert off[held_up].max() < 0
    assert off[held_down].min() > 0
    assert held_up.sum() > 4
    assert held_down.sum() > 4
