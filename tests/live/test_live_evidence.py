"""What arms know of the organ's place goes into each frame's estimate."""

from __future__ import annotations

import time

import numpy as np

from camera_objects import ALL, Located
from clock import PATIENCE_S
from live_objects import PARTS, small_frame
from tumortrack.core.evidence import Held
from tumortrack.core.geometry import rigid
from tumortrack.live.cameras import Cameras
from tumortrack.live.loop import Loop, LoopConfig
from tumortrack.live.values import Observation, PublishedFrame, SinkContext, SourceEnded
from tumortrack.live.workers import SourceWorker

BASE_FROM_CAMERA = rigid(np.diag([1.0, -1.0, -1.0]), np.array([40.0, -30.0, 300.0]))


class Asked(Located):
    """Keeps the evidence of each frame."""

    def follow(self, cloud, last=None, how=None, seen=None, evidence=()):
        self.asked.append(tuple(evidence))
        return super().follow(cloud, last, how, seen, evidence)


class Holding:
    """Arms that hold something in every frame, at the frame's time."""

    ended = False

    def evidence(self, camera_from_published, stamp_ns):
        place_mm = tuple(camera_from_published[:3, 3].tolist())
        return (Held(point_ct=(1.0, 2.0, 3.0), place_mm=place_mm, stamp_ns=stamp_ns),)

    def act(self, result):
        return result

    def abort(self, halt):
        self.ended = True

    def summary(self):
        return {}


class Tape:
    """Frames that wait for their reader."""

    host_clock, lossless, on_demand, dropped = True, True, False, 0

    def __init__(self, count):
        self._left = count

    def read(self, timeout_s):
        if not self._left:
            raise SourceEnded("that was all")
        self._left -= 1
        now_ns = time.time_ns()
        return Observation(small_frame(now_ns), now_ns)

    def close(self):
        pass


def test_what_arms_hold_goes_into_each_frames_estimate_in_its_cameras_frame():
    tracker, told = Asked(), []
    published = PublishedFrame("base", BASE_FROM_CAMERA, calibrated=True)
    context = SinkContext(PARTS, published, arms=True)
    loop = Loop(
        tracker, context, LoopConfig(region=ALL, frozen_s=0.0, stale_s=PATIENCE_S / 2), Holding()
    )
    worker = SourceWorker(lambda: Tape(3))
    cameras = Cameras([worker], [BASE_FROM_CAMERA])
    try:
        loop.run(cameras, [], told.append)
    finally:
        cameras.close()
    asked = [evidence for evidence in tracker.asked if evidence and isinstance(evidence[0], Held)]
    stamps = [result.stamp_ns for result in told if result.estimate is not None]
    assert stamps
    assert [held.stamp_ns for (held,) in asked] == stamps
    for (held,) in asked:  # the origin of the arms' frame
        np.testing.assert_allclose(held.place_mm, np.linalg.inv(BASE_FROM_CAMERA)[:3, 3])
