"""The organ's lattice from few queries: equal to querying everywhere, where it matters."""

from __future__ import annotations

import numpy as np
import pytest
from test_sparse_volume import Field

from tumortrack_occupancy.sparse import organ_lattice
from tumortrack_occupancy.volume import LogitLattice, keep_largest_pieces, lattice_over

BOX = np.array([[-90.0, -90, -90], [90, 90, 90]])


@pytest.mark.parametrize("seed", range(4))
def test_labels_are_those_of_querying_everywhere(seed):
    field = Field(seed)
    lattice, few = organ_lattice(field, BOX, 40), field.queries
    field.queries = 0
    every = lattice_over(field, BOX, 40)
    assert lattice.step_mm == pytest.approx(every.step_mm)
    labels, all_labels = (v.logits.argmax(-1).astype(np.uint8) for v in (lattice, every))
    assert np.array_equal(keep_largest_pieces(labels, 3), keep_largest_pieces(all_labels, 3))
    assert few < field.queries / 2
    inside = all_labels > 0
    assert lattice.logits[inside] == pytest.approx(every.logits[inside], abs=1e-4)


def test_a_small_tumor_is_found_wherever_it_lies_in_the_organ():
    field = Field(5)
    for off in np.random.default_rng(0).uniform(-6, 6, (10, 3)):
        field.balls[1] = (off, 4.5 * 3**0.5 / 2 + 1e-6)  # just contains a lattice point
        assert (organ_lattice(field, BOX, 40).logits.argmax(-1) == 3).any()


def test_an_organ_that_reaches_the_border_or_is_not_there_is_cut_off():
    field = Field(2)
    assert not organ_lattice(field, BOX, 40).cut_off()
    assert organ_lattice(field, BOX + [80, 0, 0], 40).cut_off()
    assert organ_lattice(field, BOX + 400, 40).cut_off()


def test_an_island_at_the_border_is_not_the_organ():
    logits = np.zeros((9, 9, 9, 2), np.float32)
    logits[..., 0] = 1
    logits[3:6, 3:6, 3:6, 1] = 2
    logits[0, 0, 0, 1] = logits[8, 4, 4, 1] = 2
    assert not LogitLattice(np.zeros(3), 4.0, logits).cut_off()
    logits[5:, 4, 4, 1] = 2  # now it is connected to the organ
    assert LogitLattice(np.zeros(3), 4.0, logits).cut_off()
