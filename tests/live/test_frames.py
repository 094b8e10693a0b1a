"""Frames that are old, of another camera, or doubtful: what the loop says of them."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from clock import PATIENCE_S, Clock, until
from live_objects import CAMERA, STAMP_NS, small_estimate, small_frame, small_setting, small_update
from reports import poor
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.live.frames import FrameCheck
from tumortrack.live.loop import Loop, LoopConfig
from tumortrack.live.values import Observation, PublishedFrame, SourceEnded, SourceLost
from tumortrack.live.workers import OPENING_S, SinkWorker, SourceWorker
from tumortrack.sense.region import RegionConfig
from tumortrack.tracking.tracker import Tracker

SECOND_NS = 10**9
ALL = RegionConfig(plane=False, flying=False, pieces=False)


class Located(Tracker):
    """A tracker that finds the small organ; ``verdicts``: good, poor or none, frame after frame."""

    anatomy_ct = None

    def __init__(self, *verdicts):  # no model
        self._verdicts = list(verdicts)

    def follow(self, cloud, last=None, how=None, seen=None, evidence=()):
        verdict = self._verdicts.pop(0) if self._verdicts else "good"
        if verdict == "none":
            raise NoEstimate("it does not look like this organ")
        estimate = small_estimate(cloud.stamp_ns)
        return estimate.assessed(finding=None if verdict == "good" else poor("it is doubtful"))


class Frames(SourceWorker):
    """Hands over what it is given, without a thread."""

    ended = False

    def __init__(self, frames=(), latency_from="taking"):
        self._left = list(frames)
        self.latency_from, self.trouble, self.failure = latency_from, "", None
        self.ready_s, self.on_demand = 0.001, False
        self._passed, self._source = 0, None

    def take(self, timeout_s):
        self.ended = not self._left
        return self._left.pop(0) if self._left else None


class Tape:
    """A source that waits for its reader."""

    host_clock, lossless, on_demand, dropped = False, True, False, 0

    def __init__(self, frames):
        self._left = list(frames)

    def read(self, timeout_s):
        if not self._left:
            raise SourceEnded("that was all")
        return self._left.pop(0)

    def close(self):
        pass


def results(frames, tracker=None, config=None):
    """The loop's result of each frame."""
    loop, got = Loop(tracker or Located(), small_setting(), config or LoopConfig(region=ALL)), []
    loop.run(Frames(frames), [], got.append)
    return got


def frame_at(seconds, changed=True):
    frame = small_frame(STAMP_NS + int(seconds * SECOND_NS))
    if changed:
        depth_mm = frame.depth_mm + np.float32(seconds / 100)
        frame = replace(frame, depth_mm=depth_mm)
    return Observation(frame, frame.stamp_ns)


def test_an_image_that_repeats_under_new_stamps_is_an_old_one():
    frames = [frame_at(0.1 * n, changed=not 3 <= n < 9) for n in range(1, 12)]
    told = results(frames)
    frozen = [n for n, one in enumerate(told, start=1) if "frozen" in one.reason]
    assert frozen == [5, 6, 7, 8]  # it may have come right after 0.2 s, and 0.25 s pass
    assert "the same image for up to 0.30 s" in told[4].reason
    assert told[4].estimate is None
    assert told[-1].estimate is not None
    allowed = results(frames, config=LoopConfig(region=ALL, frozen_s=0.0))
    assert all(one.estimate is not None for one in allowed)


def test_an_image_may_have_been_there_since_the_last_one_that_was_not_dropped():
    check = FrameCheck(PublishedFrame(), ALL, 0.25)
    check.check_new(frame_at(0.0).content)
    for seconds in (0.3, 0.33):  # those between were dropped: the loop was busy
        frozen = replace(frame_at(0.2).content, stamp_ns=STAMP_NS + int(seconds * SECOND_NS))
        if seconds == 0.3:
            check.check_new(frozen)
    with pytest.raises(NoEstimate, match=r"for up to 0\.33 s"):
        check.check_new(frozen)


def test_a_frame_that_is_only_late_or_out_of_order_makes_nobody_forget():
    """Else every second frame would be searched for as a first one, which may go wrong."""
    starts = []

    class Watched(Located):
        def follow(self, cloud, last=None, how=None, seen=None, evidence=()):
            starts.append(last)
            return super().follow(cloud, last, how, seen)

    frames = [frame_at(seconds) for seconds in (0.1, 0.3, 0.2, 0.5, 0.4, 0.7, 0.6)]
    loop, told = Loop(Watched(), small_setting(), LoopConfig(region=ALL)), []
    loop.run(SourceWorker(lambda: Tape(frames)), [], told.append)
    back = ["went back" in one.reason for one in told]
    assert back == [False, False, True, False, True, False, True]
    assert [start is None for start in starts] == [True, False, False, False]


def test_two_images_without_return_where_they_differ_are_two():
    one, other = small_frame(), small_frame(STAMP_NS + SECOND_NS)
    depth_mm = other.depth_mm.copy()
    depth_mm[0, 0] = np.nan
    check = FrameCheck(PublishedFrame(), ALL, 0.25)
    check.check_new(one)
    check.check_new(replace(other, depth_mm=depth_mm))
    with pytest.raises(NoEstimate, match="frozen"):
        check.check_new(replace(other, depth_mm=depth_mm, stamp_ns=other.stamp_ns + SECOND_NS))


def test_a_camera_that_changes_is_refused_until_it_is_back():
    other = replace(CAMERA, fx=CAMERA.fx * 1.1)
    frames = [frame_at(0.1 * n) for n in range(6)]
    for n in (2, 3):
        frames[n] = replace(frames[n], content=replace(frames[n].content, intrinsics=other))
    told = results(frames)
    assert [one.estimate is None for one in told] == [False, False, True, True, False, False]
    assert "intrinsics changed from 64 x 48 (f 60, 61" in told[2].reason
    assert "(f 66, 61" in told[2].reason


def test_given_intrinsics_hold_for_a_camera_that_keeps_its_own():
    other = replace(CAMERA, fx=CAMERA.fx * 1.1)
    frames = [frame_at(0.1 * n) for n in range(3)]
    frames[1] = replace(frames[1], content=replace(frames[1].content, intrinsics=other))
    told = results(frames, config=LoopConfig(region=ALL, intrinsics=replace(CAMERA, fy=59.0)))
    assert [one.estimate is None for one in told] == [False, True, False]
    assert "the camera's own intrinsics changed" in told[1].reason


def test_after_doubt_good_is_what_stays_good():
    verdicts = ["good", "good", "none", "good", "poor", "good", "good", "good", "good"]
    told = results([frame_at(0.1 * n) for n in range(9)], Located(*verdicts))
    assert [one.quality for one in told] == [
        *("good", "good", "none", "poor", "poor", "poor", "poor", "good", "good"),
    ]
    assert told[5].warning == "good again for 1 of 3 frames; wait"


def test_silence_is_said_before_what_is_shown_is_stale(monkeypatch):
    """Of four fifths of 0.5 s, 0.1 s are left for a frame that took 0.3 s to answer."""
    clock, waits = Clock(), []
    monkeypatch.setattr(sys.modules["tumortrack.live.loop"], "time", clock)

    class Slow(Located):
        def follow(self, cloud, last=None, how=None, seen=None, evidence=()):
            clock.sleep(0.3)
            return super().follow(cloud, last, how, seen)

    class Waiting(Frames):
        def take(self, timeout_s):
            waits.append(timeout_s)
            if len(waits) == 1:
                return Observation(small_frame(clock.time_ns()), clock.time_ns())
            clock.sleep(timeout_s)
            self.ended = len(waits) > 3
            return None

    told = []
    Loop(Slow(), small_setting(), LoopConfig(region=ALL)).run(
        Waiting(latency_from="stamp"), [], told.append
    )
    assert waits == pytest.approx([0.4, 0.1, 0.4, 0.4])
    assert told[0].estimate is not None
    assert told[1].reason.startswith("no frame for 0.4 s")


@pytest.fixture
def clock(monkeypatch):
    """The loop's and its reader's, which ``Turned`` turns."""
    one = Clock()
    for module in ("loop", "workers", "cameras"):
        monkeypatch.setattr(f"tumortrack.live.{module}.time", one)
    return one


class Turned(SourceWorker):
    """A reader for which time passes only while the loop waits for it, and ``slow_s`` in all before
    ``gate`` opens; from then on as long in real time as it takes."""

    def __init__(self, open_source, clock, gate, slow_s):
        self._clock, self._gate, self._until_s = clock, gate, clock.monotonic() + slow_s
        super().__init__(open_source)

    def take(self, timeout_s):
        if self._gate.is_set():
            return super().take(PATIENCE_S)
        self._clock.sleep(timeout_s)
        if self._clock.monotonic() > self._until_s:
            self._gate.set()
            until(lambda: self.ready_s)
        return None


class Late(Tape):
    """A source whose first frame waits for ``gate``."""

    def __init__(self, frames, gate, on_demand=False):
        super().__init__(frames)
        self._gate, self.on_demand = gate, on_demand

    def read(self, timeout_s):
        assert self._gate.wait(PATIENCE_S)
        return super().read(timeout_s)


def followed(clock, open_source, gate, slow_s, config=None):
    """The loop's results of a source that takes its time."""
    reader, told = Turned(open_source, clock, gate, slow_s), []
    try:
        Loop(Located(), small_setting(), config or LoopConfig(region=ALL)).run(
            reader, [], told.append
        )
    finally:
        gate.set()
        reader.close()
    return told


def test_a_slow_opening_is_no_silence(clock):
    """On a busy machine libraries load for longer than a camera may be silent."""
    gate = threading.Event()

    def slow():
        assert gate.wait(PATIENCE_S)
        return Tape([frame_at(0.1)])

    told = followed(clock, slow, gate, 90.0, LoopConfig(region=ALL, give_up_s=1.0))
    assert {one.reason for one in told[:-1]} == {"the source is still opening; 300 s are allowed"}
    assert len(told) > 90 / 0.5
    assert told[-1].estimate is not None


def test_an_opening_that_never_ends_ends_the_loop(clock):
    gate, begin_s = threading.Event(), clock.monotonic()
    with pytest.raises(SourceLost, match="no frame for 300 s: the source is still opening"):
        followed(clock, gate.wait, gate, 1000.0)
    assert clock.monotonic() - begin_s == pytest.approx(OPENING_S, abs=0.5)


@pytest.mark.parametrize("opens_s", [0.0, 70.0])
def test_a_camera_that_is_ready_and_silent_is_told_in_time_and_given_up(clock, opens_s):
    gate, begin_s = threading.Event(), clock.monotonic()
    told, said_s = [], []

    def slow():
        until(lambda: clock.monotonic() - begin_s >= opens_s)
        return Late([], gate)

    def note(result):
        told.append(result.reason)
        said_s.append(clock.monotonic() - begin_s)
        if said_s[-1] >= opens_s:
            until(lambda: reader.ready_s)

    reader = Turned(slow, clock, gate, 1000.0)
    if not opens_s:
        until(lambda: reader.ready_s)
    with pytest.raises(SourceLost, match=r"no frame for 60 s\. Look at"):
        Loop(Located(), small_setting(), LoopConfig(region=ALL)).run(reader, [], note)
    ready_s = reader.ready_s - begin_s
    gate.set()
    reader.close()
    first = told.index("no frame for 0.4 s")
    assert said_s[first] - ready_s == pytest.approx(0.4)
    assert all("still opening" in one for one in told[:first])
    assert all("no frame for" in one for one in told[first:])
    assert said_s[-1] - ready_s == pytest.approx(60, abs=0.5)


def test_a_source_that_makes_frames_on_demand_is_never_silent(clock):
    gate, begin_s = threading.Event(), clock.monotonic()
    told = followed(clock, lambda: Late([frame_at(0.1)], gate, on_demand=True), gate, 90.0)
    assert clock.monotonic() - begin_s > 90  # more than is allowed to a camera
    assert [one.reason for one in told if "still opening" not in one.reason] == [""]


def test_a_source_on_demand_that_cannot_open_is_given_up(clock):
    def away():
        raise SourceLost("the disk is gone")

    with pytest.raises(SourceLost, match="no frame for 60 s: the disk is gone"):
        followed(clock, away, threading.Event(), 1000.0)


def test_a_source_on_demand_whose_frames_are_all_refused_is_given_up(clock):
    class Refused(Tape):
        on_demand = True

        def read(self, timeout_s):
            clock.sleep(0.1)
            raise InputError("no image")

    gate = threading.Event()
    gate.set()
    with pytest.raises(SourceLost, match="no frame for 60 s"):
        followed(clock, lambda: Refused([]), gate, 0.0)


@pytest.mark.parametrize("on_demand", [False, True])
def test_only_a_camera_is_opened_again_because_it_is_silent(clock, monkeypatch, on_demand):
    monkeypatch.setattr("tumortrack.live.workers._AGAIN_S", 0.0)
    silent = [None, None, frame_at(0.1)]

    class Slow(Tape):
        def read(self, timeout_s):
            clock.sleep(3.0)
            return silent.pop(0) if silent else super().read(timeout_s)

    Slow.on_demand = on_demand
    reader = SourceWorker(lambda: Slow([]))
    assert isinstance(reader.take(PATIENCE_S), Observation)
    assert reader.opened == (1 if on_demand else 2)
    reader.close()


def test_a_sink_that_hangs_at_a_result_is_in_trouble():
    inside, free = [], []

    class Hangs:
        def publish(self, result):
            inside.append(result)
            until(lambda: free)

        def close(self):
            pass

    worker = SinkWorker("it", Hangs(), 1)
    assert not worker.trouble
    worker.put(small_update())
    until(lambda: inside)
    until(lambda: "slow" in worker.trouble)
    free.append(True)
    until(lambda: not worker.trouble)
    worker.close()
