"""The live loop's parts by themselves: text to configuration, times, stamps, threads."""

from __future__ import annotations

import threading
import time
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import pytest

from camera_objects import Notes, Tape
from clock import PATIENCE_S, until
from live_objects import small_frame, small_update
from refused import refused
from tumortrack.core.errors import InputError, NoEstimate, StorageError
from tumortrack.core.report import Point
from tumortrack.live.meter import Histogram
from tumortrack.live.spec import Registry
from tumortrack.live.values import Observation, SinkConfig, SourceEnded, SourceLost
from tumortrack.live.workers import SinkWorker, SourceWorker, StampOrder

SECOND = 1_000_000_000


class Camera(SinkConfig, frozen=True, kw_only=True, tag="camera"):
    target: ClassVar[str] = "topic"
    topic: str
    fps: float = 30.0
    noise: bool = True
    type: Literal["auto", "cloud"] = "auto"
    every: Annotated[int, msgspec.Meta(ge=1, le=9)] | None = None


class Needle(SinkConfig, frozen=True, kw_only=True, tag="needle"):
    tip: Point = (0.0, 0.0, 80.5)
    point: Point | None = None


class Window(SinkConfig, frozen=True, kw_only=True, tag="window"):
    target: ClassVar[str] = "port"
    port: int = 8080


KINDS = Registry(
    "sink",
    "tumortrack.nothing",
    SinkConfig,
    built_in={name.lower(): f"{__name__}:{name}" for name in ("Camera", "Window", "Needle")},
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("camera:/a/b", Camera(topic="/a/b")),
        (
            "camera:/a?fps=12.5&noise=false&type=cloud",
            Camera(topic="/a", fps=12.5, noise=False, type="cloud"),
        ),
        ("camera:C:/folder:with colons", Camera(topic="C:/folder:with colons")),
        ("camera:/a+b%20c", Camera(topic="/a+b%20c")),
        ("window", Window()),
        ("window:9000", Window(port=9000)),
        ("window?port=9000", Window(port=9000)),
        ("needle?tip=1,-2.5,3", Needle(tip=(1.0, -2.5, 3.0))),
        ("needle?point=1,2,3", Needle(point=(1.0, 2.0, 3.0))),
    ],
)
def test_text_becomes_configuration(text, expected):
    assert KINDS.parse(text) == expected


USAGE = "camera:TOPIC[?fps=30.0&noise=true&type=auto&every=]"


@pytest.mark.parametrize(
    ("text", "usage"),
    [
        ("screen", "camera, needle, window"),
        ("needle?tip=1,2", "needle[?tip=0,0,80.5&point=]"),
        ("camera", USAGE),
        ("camera:/a?rate=3", USAGE),
        ("camera:/a?fps=fast", USAGE),
        ("camera:/a?type=mesh", "auto, cloud"),
        ("camera:/a?every=0", ">= 1"),
        ("camera:/a?fps=1&fps=2", USAGE),
        ("window:http", "window[:port]"),
        ("needle:x", "needle["),
    ],
)
def test_wrong_text_is_answered_with_what_there_is(text, usage):
    with refused(InputError, text, usage):
        KINDS.parse(text)


def test_percentiles_are_right_to_one_per_cent():
    times = np.random.default_rng(0).lognormal(3, 1, 20_000)
    histogram = Histogram()
    for one in times:
        histogram.add(float(one))
    for share in (50.0, 95.0, 99.0, 99.9):
        assert histogram.percentile(share) == pytest.approx(np.percentile(times, share), rel=0.012)
    assert histogram.summary()["max"] == pytest.approx(times.max(), abs=1e-3)
    assert histogram.summary()["count"] == 20_000
    assert Histogram().summary() == {"count": 0}


def test_a_clock_that_was_set_back_is_believed_when_it_goes_on():
    order, refused = StampOrder(), []
    # One stray; then a clock set back, which goes on; the same frame again; a negative stamp.
    for stamp in (100, 101, 102, 10, 103, 20, 21, 22, 23, 23, -5):
        try:
            order.check(stamp * SECOND)
        except NoEstimate:
            refused.append(stamp)
    assert refused == [10, 20, 21, 23, -5]


# Sources --------------------------------------------------------------------------------------


def seen(stamp_ns, arrived_ns=0):
    return Observation(small_frame(stamp_ns), arrived_ns)


@pytest.fixture
def read():
    """A reader of sources, one after the other."""
    readers = []

    def start(*sources):
        left = list(sources)

        def opened():
            if not left:
                raise SourceEnded("that was all")
            source = left.pop(0)
            if isinstance(source, Exception):
                raise source
            return source

        readers.append(SourceWorker(opened))
        return readers[-1]

    yield start
    for reader in readers:
        reader.close()


@pytest.mark.parametrize(
    ("lossless", "host_clock", "counts_from"),
    [(False, True, "stamp"), (False, False, "arrival"), (True, False, "taking")],
)
def test_ages_count_from_where_the_source_allows(read, lossless, host_clock, counts_from):
    reader = read(Tape(seen(7, 9), lossless=lossless, host_clock=host_clock))
    begin_ns = time.time_ns()
    capture_ns = reader.capture_ns(reader.take(PATIENCE_S))
    assert reader.latency_from == counts_from
    if lossless:
        assert begin_ns <= capture_ns <= time.time_ns()
    else:
        assert capture_ns == (7 if host_clock else 9)


def test_the_newest_frame_wins_and_the_others_are_counted(read):
    reader = read(Tape(*map(seen, range(1, 6)), lossless=False))
    until(lambda: reader.dropped == 4)
    assert reader.take(PATIENCE_S).stamp_ns == 5
    assert reader.take(0.05) is None


def test_exchanged_frames_are_noticed_by_a_loop_that_is_too_busy_to_see_both(read):
    tape = Tape(*map(seen, (2, 1, 4, 3)), lossless=False)
    reader = read(tape)
    until(lambda: tape.closed)  # all are read: 2 was dropped, for 4
    assert reader.dropped == 1
    assert isinstance(reader.take(PATIENCE_S), NoEstimate)
    assert reader.take(PATIENCE_S).stamp_ns == 4  # not 3, which came last
    assert reader.take(0.05) is None


def test_a_source_that_waits_loses_nothing_and_ends_when_its_last_frame_is_taken(read):
    reader = read(Tape(*map(seen, range(1, 6))))
    for n in range(1, 6):
        assert not reader.ended
        assert reader.take(PATIENCE_S).stamp_ns == n
    assert reader.take(PATIENCE_S) is None
    assert reader.ended
    assert reader.dropped == 0


def test_garbage_is_handed_on_and_a_lost_source_is_opened_again(read):
    first = Tape(InputError("no image"), seen(1), SourceLost("unplugged"))
    reader = read(first, SourceLost("still unplugged"), Tape(seen(2)))
    assert isinstance(reader.take(PATIENCE_S), InputError)
    assert reader.take(PATIENCE_S).stamp_ns == 1
    until(lambda: "unplugged" in reader.trouble)
    assert first.closed == 1
    assert reader.take(PATIENCE_S).stamp_ns == 2
    assert (reader.trouble, reader.opened) == ("", 2)


def test_a_source_that_can_never_work_ends_the_loop(read):
    reader = read(InputError("no such folder"))
    with pytest.raises(InputError):
        reader.take(PATIENCE_S)


def test_what_breaks_at_reopening_is_no_end(read):
    """A camera that is plugged in again fails in ways of its own while it comes up."""
    faults = RuntimeError("failed to set power state"), InputError("no 848x480@30 at USB 2")
    reader = read(Tape(seen(1), SourceLost("unplugged")), *faults, Tape(seen(4)))
    assert [reader.take(PATIENCE_S).stamp_ns for _ in range(2)] == [1, 4]
    assert reader.failure is None
    (defect,) = reader.defects
    assert "power state" in defect


# Sinks ----------------------------------------------------------------------------------------


class Gated(Notes):
    """Waits for its gate, and fails while it is ``broken``."""

    def __init__(self, broken=False):
        super().__init__()
        self.gate, self.broken, self.inside = threading.Event(), broken, False

    def publish(self, update):
        self.inside = True
        assert self.gate.wait(PATIENCE_S)
        if self.broken:
            raise StorageError("the disk is full")
        super().publish(update)


def sequences(sink):
    return [update.sequence for update in sink.updates]


@pytest.mark.parametrize(("waiting", "dropped"), [(1, (48, 49)), (64, (0,))])
def test_a_slow_sink_gets_the_newest_or_all_that_may_wait(waiting, dropped):
    sink = Gated()
    outlet = SinkWorker("slow", sink, waiting, PATIENCE_S)  # however slow we are
    for n in range(50):
        outlet.put(small_update(n))
    until(lambda: sink.inside)
    until(lambda: "slow" in outlet.trouble)
    assert not sink.updates  # and nothing was held up
    sink.gate.set()
    outlet.close()
    assert sequences(sink)[-1] == 49
    assert outlet.dropped == 50 - len(sink.updates)
    assert outlet.dropped in dropped
    assert outlet.summary()["latency_ms"]["count"] == len(sink.updates)


def test_a_sink_that_shows_is_told_when_the_loop_hangs():
    shown, kept = Notes(), Notes()
    outlets = [SinkWorker("viewer", shown, 1, 0.2), SinkWorker("recording", kept, 30, 0.2)]
    for outlet in outlets:
        outlet.put(small_update(7))
    until(lambda: len(shown.updates) == 2)
    time.sleep(0.5)
    for outlet in outlets:
        outlet.close()
    assert [u.estimate is not None for u in shown.updates] == [True, False]  # and once only
    assert sequences(kept) == [7]  # what was said, and no more


def test_a_broken_sink_is_said_and_recovers():
    sink = Gated(broken=True)
    sink.gate.set()
    outlet = SinkWorker("disk", sink, waiting=8)
    outlet.put(small_update())
    until(lambda: outlet.failing)
    assert outlet.trouble == "the disk is full"
    sink.broken = False
    outlet.put(small_update(5))
    until(lambda: not outlet.failing)
    outlet.close()
    assert (outlet.errors, outlet.delivered) == (1, 1)
    assert outlet.summary()["last_error"] == "the disk is full"


def test_a_sink_that_fails_at_its_end_is_known():
    class Cut(Notes):
        def close(self):
            raise StorageError("no index")

    outlet = SinkWorker("recording", Cut(), 5)
    outlet.close()
    assert outlet.unclosed
    assert outlet.error == "no index"
