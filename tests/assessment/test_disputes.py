"""A touch that contradicts an answer speaks against the next ones, until it is acknowledged."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from live_objects import small_estimate, small_frame
from tumortrack.core.report import EvidenceReport
from tumortrack.core.types import SensorCloud
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker

SURFACE_MM = small_estimate().organ_mesh.vertices_mm
FOOT_MM = SURFACE_MM[SURFACE_MM[:, 2].argmin()]  # nearest to the camera
FAR_MM = SURFACE_MM[SURFACE_MM[:, 2].argmax()]


def told(place_mm, name="touch", **more):
    return EvidenceReport(name=name, off_mm=22.0, news=0.0, places_mm=(tuple(place_mm),), **more)


FALSE = told(FOOT_MM + [0, 0, 22.0], left_out=True)
THERE = told(FOOT_MM + [3.0, 0, 0], left_out=False)
ELSEWHERE = told(FAR_MM, left_out=False)


class Scripted(Tracker):
    """A tracker whose answers are good but for what their evidence says."""

    anatomy_ct, model = None, SimpleNamespace(bound_factor=1.0)

    def __init__(self, frames):
        self.frames = iter(frames)

    def follow(self, cloud, *_):
        estimate = small_estimate(cloud.stamp_ns).assessed(finding=None)
        return estimate.reporting(evidence=tuple(next(self.frames)))


def kinds(frames, settled_at=-1):
    """The finding of each frame."""
    follower, found = Follower(Scripted(frames), FollowerConfig()), []
    for n in range(len(frames)):
        if n == settled_at:
            follower.disputes.acknowledge()
        cloud = SensorCloud(SURFACE_MM.astype(np.float32), stamp_ns=1 + 33_000_000 * n)
        estimate = follower.locate(cloud, small_frame())
        found.append(estimate.finding and estimate.finding.kind)
    return found


@pytest.mark.parametrize(
    ("later", "holds"),
    [
        ([], True),
        ([THERE, THERE], True),
        ([ELSEWHERE] * 40, True),
        ([FALSE] * 3, True),  # they say the same: the answer is wrong
        ([THERE] * 3, False),
    ],
)
def test_it_holds_until_three_later_ones_there_agree(later, holds):
    frames = [[], [ELSEWHERE, THERE, THERE, THERE, FALSE], *([[]] * 20), later, [], []]
    said = kinds(frames)
    assert said[0] is None
    assert said[1:22] == ["disputed"] * 21
    assert said[-1] == ("disputed" if holds else None)


def test_it_is_settled_by_the_user():
    assert kinds([[FALSE], [], []], settled_at=2) == ["disputed", "disputed", None]


def test_what_agrees_and_what_is_of_a_moment_disputes_nothing():
    momentary = [told(FAR_MM, name, left_out=True) for name in ("held", "free")]
    assert kinds([[ELSEWHERE, THERE], momentary, []]) == [None] * 3


def test_earlier_touches_that_no_longer_agree_dispute_it_where_they_are_most():
    old = [told(FAR_MM, left_out=out, before=True) for out in (True, True, False)]
    assert kinds([old, []]) == ["disputed"] * 2
    assert kinds([old[1:], []]) == [None] * 2
