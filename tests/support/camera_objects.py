"""Cameras whose frames a test lists, where they stand, and the loop over them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from clock import PATIENCE_S
from live_objects import PARTS, STAMP_NS, small_estimate, small_frame
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import rigid
from tumortrack.live.cameras import Cameras
from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.poses import CameraPoses
from tumortrack.live.values import (
    Observation,
    PublishedFrame,
    SinkContext,
    SourceEnded,
)
from tumortrack.live.workers import SourceWorker
from tumortrack.sense.region import RegionConfig
from tumortrack.tracking.tracker import Tracker

MS = 1_000_000
ALL = RegionConfig(plane=False, flying=False, pieces=False)
ASIDE = rigid(Rotation.from_euler("y", 3, degrees=True).as_matrix(), np.array([5.0, -2, 3]))
BASE = rigid(Rotation.from_euler("x", 170, degrees=True).as_matrix(), np.array([400.0, 30, 500]))


class Tape:
    """A source that waits for its reader: frames at these milliseconds, errors, things to do."""

    host_clock, lossless, on_demand, dropped = False, True, True, 0

    def __init__(self, *items, of=0.0):
        self._left, self._of = list(items), of

    def read(self, timeout_s):
        while self._left and callable(self._left[0]):
            self._left.pop(0)()
        if not self._left:
            raise SourceEnded("that was all")
        item = self._left.pop(0)
        if isinstance(item, Exception):
            raise item
        return seen_at(item, self._of)

    def close(self):
        self._left = []


def seen_at(ms, more_mm=0.0):
    frame = small_frame(STAMP_NS + round(ms * MS))
    frame = replace(frame, depth_mm=frame.depth_mm + np.float32(more_mm + ms / 1000))
    return Observation(frame, frame.stamp_ns)


class Located(Tracker):
    """Finds the small organ before whichever camera, and keeps what it was asked."""

    anatomy_ct = None

    def __init__(self):  # no model
        self.asked = []

    def follow(self, cloud, last=None, how=None, seen=None, evidence=()):
        self.asked.append((last, evidence))
        estimate = small_estimate(cloud.stamp_ns)
        return estimate.assessed(finding=None)


def played(sources, places, published=None, tracker=None):
    """The loop's results over sources (one try each), and its report."""
    workers = []
    for source in sources:
        tries = iter([source])

        def once(tries=tries):
            one = next(tries, None)
            if one is None:
                raise SourceEnded("not again")
            return one

        workers.append(SourceWorker(once))
    published = published or PublishedFrame("base", places[0], calibrated=True)
    still = () if hasattr(places, "at") else tuple(places)
    context = SinkContext(PARTS, published, cameras=still)
    loop = Loop(tracker or Located(), context, LoopConfig(region=ALL, stale_s=PATIENCE_S / 2))
    cameras, told = Cameras(workers, places), []
    try:
        loop.run(cameras, [], told.append)
        return told, summary(loop, cameras, [])
    finally:
        cameras.close()


class Led(CameraPoses):
    """A camera that is led sideways at a constant rate; unknown from ``until_ns`` on."""

    frame_id = "base"

    def __init__(self, until_ns=10**30):
        self._until_ns = until_ns

    def pose(self, seen):
        if seen.stamp_ns >= self._until_ns:
            raise NoEstimate("where the camera was is unknown: no pose has come")
        way = BASE.copy()
        way[0, 3] += (seen.stamp_ns - STAMP_NS) / (10 * MS)  # mm
        return way
