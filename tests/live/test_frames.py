"""Frames that are old, frozen, of another camera, late or missing: what the loop makes of them."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

from camera_objects import ALL, MS, Located, Notes, Tape, played, seen_at
from clock import PATIENCE_S, Clock, until
from live_objects import CAMERA, STAMP_NS, small_frame, small_setting
from refused import refused
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.types import DepthError, DepthFrame, Intrinsics
from tumortrack.io.depth_files import DepthCorrection
from tumortrack.live.loop import Loop, LoopConfig
from tumortrack.live.values import Observation, PublishedFrame, SourceLost
from tumortrack.live.views import FrameCheck
from tumortrack.live.workers import OPENING_S, SourceWorker

IDENTITY = PublishedFrame()


def results(*items, tracker=None, published=IDENTITY, **config):
    """The loop's result of each frame."""
    given = {"region": ALL, "stale_s": PATIENCE_S / 2, **config}
    return played([Tape(*items)], published=published, tracker=tracker, config=LoopConfig(**given))[
        0
    ]


def found(told):
    return [one.estimate is not None for one in told]


def kinds(told):
    return [one.finding.kind if one.finding else "" for one in told]


@pytest.fixture
def clock(monkeypatch):
    """The loop's, its reader's and the source's, which the test turns."""
    one = Clock()
    monkeypatch.setattr(sys.modules["camera_objects"], "time", one)
    for module in ("loop", "workers", "cameras", "views"):
        monkeypatch.setattr(f"tumortrack.live.{module}.time", one)
    return one


def test_an_image_that_repeats_under_new_stamps_is_an_old_one():
    frames = [seen_at(100 * n) for n in range(1, 12)]
    for n in range(2, 8):
        content = small_frame(STAMP_NS + 100 * (n + 1) * MS)
        frames[n] = replace(frames[n], content=content)
    told = results(*frames)
    # It may have come right after 0.2 s, and 0.25 s pass.
    assert [n for n, kind in enumerate(kinds(told), start=1) if kind == "frozen"] == [5, 6, 7, 8]
    assert told[4].finding.values["seconds"] == pytest.approx(0.3)
    assert found(told) == [kind != "frozen" for kind in kinds(told)]
    assert all(found(results(*frames, frozen_s=0.0)))


def test_two_images_without_return_where_they_differ_are_two():
    one, other = small_frame(), small_frame(STAMP_NS + 1000 * MS)
    depth_mm = other.depth_mm.copy()
    depth_mm[0, 0] = np.nan
    check = FrameCheck(IDENTITY, ALL, 0.25)
    check.check_new(one)
    check.check_new(replace(other, depth_mm=depth_mm))
    with pytest.raises(NoEstimate) as refused:
        check.check_new(replace(other, depth_mm=depth_mm, stamp_ns=other.stamp_ns + 1000 * MS))
    assert refused.value.finding.kind == "frozen"


def test_a_frame_that_is_only_late_or_out_of_order_makes_nobody_forget():
    """Else every second frame would be searched for as a first one, which may go wrong."""
    tracker = Located()
    told = results(100, 300, 200, 500, 400, 700, 600, tracker=tracker)
    back = [kind == "stamp_back" for kind in kinds(told)]
    assert back == [False, False, True, False, True, False, True]
    assert [last is None for last, _ in tracker.asked] == [True, False, False, False]


def test_a_clock_that_jumps_back_costs_frames_and_no_more():
    told, report = played([Tape(*range(0, 160, 40), *range(-9000, -8800, 40))], published=IDENTITY)
    assert found(told) == [True] * 4 + [False] * 2 + [True] * 3
    assert report["clock_jumps"] == 1


def test_a_camera_that_changes_is_refused_until_it_is_back():
    other = replace(CAMERA, fx=CAMERA.fx * 1.1)
    frames = [seen_at(100 * n) for n in range(6)]
    for n in (2, 3):
        frames[n] = replace(frames[n], content=replace(frames[n].content, intrinsics=other))
    told = results(*frames)
    assert kinds(told) == ["", "", *["intrinsics_changed"] * 2, "good_again", "good_again"]
    # With intrinsics of the user's the camera must keep its own.
    told = results(*frames, intrinsics=replace(CAMERA, fy=59.0))
    assert found(told) == [True, True, False, False, True, True]


def test_intrinsics_corrections_and_depth_errors_of_the_user_replace_the_sources():
    given = Intrinsics(64, 48, 30.0, 30.5, 31.5, 23.5)
    correction = DepthCorrection(scale=0.99, offset_mm=2.0)
    options = {"correction": correction, "depth_error": DepthError(0.5)}
    (told,) = results(0, intrinsics=given, **options)
    content = told.observation.content
    assert content.intrinsics == given
    assert content.intrinsics.depth_error == DepthError(0.5)
    np.testing.assert_allclose(content.depth_mm, small_frame().depth_mm * 0.99 + 2, rtol=1e-5)
    (told,) = results(0, intrinsics=Intrinsics(32, 48, 30, 30, 15, 23), **options)
    assert told.estimate is None
    assert "32 x 48" in told.reason


def test_another_cameras_frame_is_published_nowhere():
    here = PublishedFrame("base", calibrated=True, camera_frame_id="left")
    names = ["left", "right", "left", "left"]
    told = results(*(seen_at(40 * n, frame_id=x) for n, x in enumerate(names)), published=here)
    assert found(told) == [name == "left" for name in names]
    assert told[1].finding.values == {"name": "right", "wanted": "left"}
    assert told[1].transformed is None


@pytest.mark.parametrize(
    ("published", "name"),
    [
        (PublishedFrame(), "camera_optical"),
        (PublishedFrame("base_link", calibrated=True), "base_link"),
        (PublishedFrame("table"), "table"),  # of a plan
    ],
)
def test_results_are_in_the_sources_frame_where_no_other_is_given(published, name):
    seen = [seen_at(40 * n, frame_id="camera_optical") for n in range(2)]
    told = results(seen[0], NoEstimate("none"), seen[1], published=published)
    assert [one.published_frame.frame_id for one in told] == [name] * 3


def test_after_doubt_good_is_what_stays_good():
    verdicts = ["good", "good", "none", "good", "poor", "good", "good", "good", "good"]
    told = results(*range(0, 900, 100), tracker=Located(*verdicts))
    assert [one.quality for one in told] == [
        *("good", "good", "none", "poor", "poor", "poor", "poor", "good", "good"),
    ]
    assert told[5].finding.values == {"frames": 1, "of": 3}


def test_garbage_and_defects_are_said_and_survived():
    class Broken(Located):
        def follow(self, cloud, *more, **named):
            if cloud.stamp_ns == STAMP_NS + 120 * MS:
                raise ZeroDivisionError("a defect")
            return super().follow(cloud, *more, **named)

    nothing = np.full((48, 64), np.nan, np.float32)
    empty = DepthFrame(nothing, CAMERA, STAMP_NS + 80 * MS)
    items = [0, 40, InputError("no points"), empty, 120, 160]
    told, report = played([Tape(*items)], published=IDENTITY, tracker=Broken())
    assert found(told) == [True, True, False, False, False, True]
    assert told[2].reason == "no points"
    assert kinds(told)[4] == "defect"
    assert [one.stamp_ns for one in told if one is not told[2]] == [
        STAMP_NS + ms * MS for ms in (0, 40, 80, 120, 160)
    ]
    assert [one.sequence for one in told] == list(range(6))
    (defect,) = report["defects"]
    assert "Traceback" in defect
    assert report["no_estimate"] == sum(report["reasons"].values()) == 3


# Time ----------------------------------------------------------------------------------------


def test_stale_frames_are_refused_and_so_are_those_from_the_future(clock):
    def frame(off_ms):
        return Observation(small_frame(clock.time_ns() + off_ms * MS), clock.time_ns())

    sink = Notes()
    items = [frame(-600), lambda: until(lambda: sink.updates), frame(1000)]
    items += [lambda: until(lambda: len(sink.updates) > 1), frame(1001)]
    tape = Tape(*items, lossless=False, host_clock=True, on_demand=False)
    told, report = played([tape], published=IDENTITY, config=LoopConfig(region=ALL), sink=sink)
    assert kinds(told)[:2] == ["stale", "future"]
    assert told[0].latency_ms == pytest.approx(600)
    assert report["latency_from"] == "stamp"


@pytest.mark.parametrize("on_demand", [False, True])
def test_an_answer_that_comes_too_late_is_none_and_yet_a_start(clock, on_demand):
    """Of a camera: what a simulation waits for is no camera's age."""

    class Slow(Located):
        def follow(self, *cloud, **named):
            clock.sleep(0 if self.asked else 0.6)
            return super().follow(*cloud, **named)

    tracker, sink = Slow(), Notes()
    frames = [replace(seen_at(ms).content, stamp_ns=clock.time_ns() + ms * MS) for ms in (0, 650)]
    items = [frames[0], lambda: until(lambda: sink.updates), frames[1]]
    tape = Tape(*items, lossless=False, host_clock=True, on_demand=on_demand)
    told, _ = played(
        [tape], published=IDENTITY, config=LoopConfig(region=ALL), tracker=tracker, sink=sink
    )
    assert kinds(told)[0] == ("" if on_demand else "too_late")
    assert found(told)[0] == on_demand
    assert [last is not None for last, _ in tracker.asked] == [False, True]


class Waiting(SourceWorker):
    """Hands over a frame, and then nothing, without a thread."""

    ended, dropped = False, 0

    def __init__(self, clock):
        self.clock, self.waits = clock, []
        self.latency_from, self.trouble, self.failure = "stamp", "", None
        self.ready_s, self.on_demand = 0.001, False

    def take(self, timeout_s):
        self.waits.append(timeout_s)
        if len(self.waits) == 1:
            return Observation(small_frame(self.clock.time_ns()), self.clock.time_ns())
        self.clock.sleep(timeout_s)
        self.ended = len(self.waits) > 3
        return None


def test_silence_is_said_before_what_is_shown_is_stale(clock):
    """Of four fifths of 0.5 s, 0.1 s are left for a frame that took 0.3 s to answer."""

    class Slow(Located):
        def follow(self, *cloud, **named):
            clock.sleep(0.3)
            return super().follow(*cloud, **named)

    reader, told = Waiting(clock), []
    Loop(Slow(), small_setting(), LoopConfig(region=ALL)).run(reader, [], told.append)
    assert reader.waits == pytest.approx([0.4, 0.1, 0.4, 0.4])
    assert kinds(told)[:2] == ["", "no_frame"]
    assert told[1].finding.values["seconds"] == pytest.approx(0.4)


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


def followed(clock, open_source, gate, slow_s, on_result=lambda told: None, **config):
    """The loop's results of a source that takes its time."""
    reader, told = Turned(open_source, clock, gate, slow_s), []

    def note(result):
        told.append(result)
        on_result(reader)

    try:
        Loop(Located(), small_setting(), LoopConfig(region=ALL, **config)).run(reader, [], note)
    finally:
        gate.set()
        reader.close()
    return told


def waits_for(gate):
    return lambda: gate.wait(PATIENCE_S)


def test_a_slow_opening_is_no_silence(clock):
    """On a busy machine libraries load for longer than a camera may be silent."""
    gate = threading.Event()

    def slow():
        assert gate.wait(PATIENCE_S)
        return Tape(100, on_demand=False)

    told = followed(clock, slow, gate, 90.0, give_up_s=1.0)
    assert all("300 s" in one.reason for one in told[:-1])
    assert len(told) > 90 / 0.5
    assert told[-1].estimate is not None


def test_an_opening_that_never_ends_ends_the_loop(clock):
    gate, begin_s = threading.Event(), clock.monotonic()
    with pytest.raises(SourceLost):
        followed(clock, gate.wait, gate, 1000.0)
    assert clock.monotonic() - begin_s == pytest.approx(OPENING_S, abs=0.5)


def test_a_camera_that_is_ready_and_silent_is_told_in_time_and_given_up(clock):
    gate, said_s, ready_s = threading.Event(), [], []

    def note(reader):
        said_s.append(clock.monotonic())
        if said_s[-1] - begin_s >= 70:
            ready_s[:] = [until(lambda: reader.ready_s)]

    def slow():
        until(lambda: clock.monotonic() - begin_s >= 70)
        return Tape(waits_for(gate), on_demand=False)

    begin_s = clock.monotonic()
    with pytest.raises(SourceLost):
        followed(clock, slow, gate, 1000.0, note)
    (opened_s,) = ready_s
    assert min(s for s in said_s if s > opened_s) - opened_s == pytest.approx(0.4)
    assert said_s[-1] - opened_s == pytest.approx(60, abs=0.5)


def test_a_source_that_makes_frames_on_demand_is_never_silent(clock):
    gate, begin_s = threading.Event(), clock.monotonic()
    told = followed(clock, lambda: Tape(waits_for(gate), 100), gate, 90.0)
    assert clock.monotonic() - begin_s > 90  # more than is allowed to a camera
    assert [one.reason for one in told if "300 s" not in one.reason] == [""]


def test_a_source_that_gives_nothing_but_errors_is_given_up(clock):
    def away():
        raise SourceLost("disk 7")

    with refused(SourceLost, "disk 7"):
        followed(clock, away, threading.Event(), 1000.0)

    class Refused(Tape):
        def read(self, timeout_s):
            clock.sleep(0.1)
            raise InputError("no image")

    gate = threading.Event()
    gate.set()
    with pytest.raises(SourceLost):
        followed(clock, Refused, gate, 0.0)


@pytest.mark.parametrize("on_demand", [False, True])
def test_only_a_camera_is_opened_again_because_it_is_silent(clock, on_demand):
    silent = [None, None, seen_at(100)]

    class Slow(Tape):
        def read(self, timeout_s):
            clock.sleep(3.0)
            return silent.pop(0) if silent else super().read(timeout_s)

    reader = SourceWorker(lambda: Slow(on_demand=on_demand), again_s=0.0)
    assert isinstance(reader.take(PATIENCE_S), Observation)
    assert reader.opened == (1 if on_demand else 2)
    reader.close()


def test_a_source_that_stays_away_ends_the_loop_and_stop_ends_it_from_elsewhere():
    config = LoopConfig(region=ALL, stale_s=0.1, give_up_s=0.4)
    with pytest.raises(SourceLost):
        played([Tape(threading.Event().wait, on_demand=False)], published=IDENTITY, config=config)
    loop = Loop(Located(), small_setting(), LoopConfig(region=ALL, stale_s=0.1))
    reader = SourceWorker(lambda: Tape(threading.Event().wait))
    threading.Timer(0.3, loop.stop).start()
    loop.run(reader, [], lambda _: None)
    assert not reader.ended
    reader.close()


@pytest.mark.parametrize(
    "wrong", [{"stale_s": 5, "give_up_s": 1}, {"seconds": -1}, {"frozen_s": -1}]
)
def test_limits_of_the_loop_are_checked(wrong):
    with pytest.raises(InputError):
        LoopConfig(**wrong)


def test_a_lost_source_comes_back(clock):
    tapes = [Tape(0, 40, SourceLost("unplugged"), on_demand=False), Tape(80, 120, on_demand=False)]
    said, told = threading.Event(), []

    def plug_in():
        if len(tapes) == 1:  # however slow the machine: not before the loop has said why
            assert said.wait(PATIENCE_S)
        return tapes.pop(0)

    def listen(result):
        told.append(result)
        if result.reason == "unplugged":
            said.set()

    loop = Loop(Located(), small_setting(), LoopConfig(region=ALL, stale_s=0.1))
    reader = SourceWorker(plug_in, again_s=0.0)
    loop.run(reader, [], listen)
    reader.close()
    assert sum(found(told)) == 4
    assert reader.opened == 2
    assert found(told)[:2] == found(told)[-2:] == [True, True]
