"""Sources that a test scripts, a tracker that always finds the small organ, and the loop over
them."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from clock import PATIENCE_S
from live_objects import PARTS, STAMP_NS, small_estimate, small_frame
from reports import poor
from tumortrack.core.errors import NoEstimate
from tumortrack.core.geometry import IDENTITY, rigid
from tumortrack.core.report import Finding
from tumortrack.live.cameras import Cameras
from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.poses import CameraPoses
from tumortrack.live.values import Observation, PublishedFrame, SinkContext, SourceEnded
from tumortrack.live.workers import SinkWorker, SourceWorker
from tumortrack.segmentation import RegionConfig
from tumortrack.tracking.tracker import Tracker

MS = 1_000_000
ALL = RegionConfig(plane=False, flying=False, pieces=False)
ASIDE = rigid(Rotation.from_euler("y", 3, degrees=True).as_matrix(), np.array([5.0, -2, 3]))
BASE = rigid(Rotation.from_euler("x", 170, degrees=True).as_matrix(), np.array([400.0, 30, 500]))


class Tape:
    """A source of frames at these milliseconds, observations, errors, things to do. ``lossless``:
    it waits for its reader."""

    dropped = 0

    def __init__(self, *items, of=0.0, lossless=True, host_clock=False, on_demand=True):
        self._left, self._of, self.closed = list(items), of, 0
        self.lossless, self.host_clock, self.on_demand = lossless, host_clock, on_demand

    def read(self, timeout_s):
        while self._left and callable(self._left[0]):
            self._left.pop(0)()
        if not self._left:
            raise SourceEnded("that was all")
        item = self._left.pop(0)
        if isinstance(item, Exception):
            raise item
        if isinstance(item, int | float):
            return seen_at(item, self._of)
        return item if isinstance(item, Observation) else Observation(item, time.time_ns())

    def close(self):
        self.closed += 1


def seen_at(ms, more_mm=0.0, **more):
    """No two images are alike."""
    frame = small_frame(STAMP_NS + round(ms * MS))
    frame = replace(frame, depth_mm=frame.depth_mm + np.float32(more_mm + ms / 1000))
    return Observation(frame, frame.stamp_ns, **more)


class Located(Tracker):
    """Finds the small organ before whichever camera, and keeps what it was asked. ``verdicts``:
    good, poor or none, frame after frame."""

    anatomy_ct = model = None

    def __init__(self, *verdicts):  # no model
        self._verdicts, self.asked = list(verdicts), []

    def follow(self, cloud, last=None, how=None, full_view=None, *, views=(), evidence=()):
        self.asked.append((last, (*views, *evidence)))
        verdict = self._verdicts.pop(0) if self._verdicts else "good"
        if verdict == "none":
            raise NoEstimate("it does not look like this organ")
        estimate = small_estimate(cloud.stamp_ns)
        return estimate.assessed(finding=None if verdict == "good" else poor("it is doubtful"))


class Notes:
    """A sink that keeps every result."""

    def __init__(self):
        self.updates = []

    def publish(self, update):
        self.updates.append(update)

    def close(self):
        pass


def once(source):
    """Opens a source; a second time it has ended."""
    tries = iter([source])

    def opened():
        if (one := next(tries, None)) is None:
            raise SourceEnded("not again")
        return one() if callable(one) else one

    return opened


def played(
    sources,
    places=(IDENTITY,),
    published=None,
    tracker=None,
    config=None,
    controller=None,
    sink=None,
):
    """The loop's results over sources (one try each), and its report."""
    tracker = tracker or Located()
    published = published or PublishedFrame("base", places[0], calibrated=True)
    context = SinkContext(
        PARTS,
        published,
        tracker.anatomy_ct,
        cameras=() if hasattr(places, "at") else tuple(places),
        controller=controller,
    )
    config = config or LoopConfig(region=ALL, stale_s=PATIENCE_S / 2)
    loop, told = Loop(tracker, context, config), []
    cameras = Cameras([SourceWorker(once(source)) for source in sources], places)
    outlets = [] if sink is None else [SinkWorker("notes", sink, 1000)]
    try:
        loop.run(cameras, outlets, told.append)
    finally:
        cameras.close()
        for outlet in outlets:
            outlet.close()
    return told, summary(loop, cameras, outlets)


class Led(CameraPoses):
    """A camera that is led sideways at a constant rate; unknown from ``until_ns`` on."""

    frame_id = "base"

    def __init__(self, until_ns=10**30):
        self._until_ns = until_ns

    def pose(self, seen):
        if seen.stamp_ns >= self._until_ns:
            raise NoEstimate(Finding("no_pose"))
        way = BASE.copy()
        way[0, 3] += (seen.stamp_ns - STAMP_NS) / (10 * MS)  # mm
        return way
