"""Fits that are told parts of the truth: each against an answer that is known, and as a ladder."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from elastic_objects import SMALL
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy, LabelVolume, Mesh
from tumortrack.imaging.case import Case
from tumortrack.registration.motion import ElasticMotion
from tumortrack_lab.world import causes
from tumortrack_lab.world.causes import AS_USED, CERTAIN, Told
from warp_objects import ANATOMY, PLACE_MM, TURNED, placed, shape
from world_objects import ANATOMY as ORGAN
from world_objects import organ

UP_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])  # looks down on the bench
CAMERA_FROM_BENCH = rigid(UP_CAMERA[:3, :3], np.array([0.0, 0.0, 160.0]))


def told(motion: ElasticMotion, rim_mm: float = 0.0) -> Told:
    """A motion of the slim organ as a state, which a camera sees from above."""
    true = Anatomy(tuple(part.moved(motion.carry(part.vertices_mm)) for part in ANATOMY.parts))
    return Told(ANATOMY, true, np.eye(4), motion.camera_from_ct, rim_mm)


def bent(rest: Anatomy, how) -> Told:
    true = Anatomy(tuple(part.moved(how(part.vertices_mm)) for part in rest.parts))
    seen = [
        part.moved(transform_points(CAMERA_FROM_BENCH, part.vertices_mm)) for part in true.parts
    ]
    return Told(rest, Anatomy(tuple(seen)), CAMERA_FROM_BENCH, np.eye(4), 12.0)


def stretched(points):
    """Volume is kept; the tumor's middle goes 2.2 mm along x and 1.1 mm down."""
    return points * [1.1, 1 / 1.1 / 0.95, 0.95]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_state_of_the_library_is_found_again(share):
    truth = placed(share=share)
    state, start = told(truth), replace(truth, coefficients=0 * truth.coefficients)
    here = causes.recognised(
        start, causes.evidence(state, np.random.default_rng(0))["whole surface"], CERTAIN
    )
    if share:
        assert min(state.off_mm(start.carry)) > 1.0  # what there was to find
    assert max(state.off_mm(here.carry)) < 0.1
    assert max(state.off_mm(causes.best_of_modes(shape(), state).carry)) < 0.05


def test_a_centre_that_is_off_by_a_known_way_is_measured():
    state = told(placed())
    way = np.array([0.3, -0.4, 1.2])
    assert state.off_mm(lambda points: placed().carry(points) + way) == pytest.approx([1.3])


def test_less_told_leaves_more_open():
    """Over states of the library: of one view, of three, of all; and what is not told to be sure
    is drawn to the library's mean."""
    rng, sums = np.random.default_rng(0), {}
    for number in range(5, 75, 7):
        truth = placed(number)
        state = told(truth)
        for name, pairs in causes.evidence(state, rng).items():
            for what, motion in causes.fits(truth, pairs, {}).items():
                off = sums.setdefault((name, what), [])
                off += state.off_mm(motion.carry)
    median = {key: float(np.median(off)) for key, off in sums.items()}
    print(median)
