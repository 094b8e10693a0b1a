"""The threads around the loop: one reads the source, and each sink has its own, so that none holds
up the loop or another."""

from __future__ import annotations

import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from typing import Any

from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.report import Finding
from tumortrack.live.meter import Histogram
from tumortrack.live.values import (
    Observation,
    Sink,
    Source,
    SourceEnded,
    SourceLost,
    TrackingResult,
)

_READ_S = 0.2  # timeout of one read: how soon the thread notices that it must stop
OPENING_S = 300.0  # allowed for the first opening: libraries load, on a busy machine
_AGAIN_S = 1.0  # between two attempts to open
_FROZEN_S = 5.0  # without a frame: reopened
_DEFECTS = 5  # tracebacks that are kept
_STOP_S = 2.0  # how long close waits for a source that hangs
_CLOSE_S = 10.0  # for a sink to write what waits, and flush
_SILENT_S = 2.0  # without a result from the loop: what a sink shows is no longer valid
_SLOW_S = 0.25  # at one result: what a sink shows lags by as much
_ACCEPTED_AFTER = 3  # frames whose stamps increase: then the clock was set back


class StampOrder:
    """Refuses stamps that go back, unless the clock was set back. It must see every frame."""

    def __init__(self) -> None:
        self._last_ns = -1
        self._behind: list[int] = []

    def check(self, stamp_ns: int) -> None:
        if stamp_ns < 0:
            raise NoEstimate(Finding("stamp_negative", {"stamp_ns": stamp_ns}))
        back_ns = self._last_ns - stamp_ns
        if back_ns >= 0:
            grows = not self._behind or stamp_ns > self._behind[-1]
            self._behind = [*self._behind, stamp_ns] if grows else [stamp_ns]
            if len(self._behind) < _ACCEPTED_AFTER:
                raise NoEstimate(Finding("stamp_back", {"seconds": back_ns * 1e-9}))
        self._last_ns, self._behind = stamp_ns, []


class SourceWorker:
    """Opens a source, reads it, and reopens it when it is lost. If frames come faster than they are
    taken, the newest stays and the others count as dropped; a ``lossless`` source waits. An error
    about a frame, its order too, is handed over before later frames."""

    def __init__(self, open_source: Callable[[], Source], again_s: float = _AGAIN_S) -> None:
        self._open, self._again_s = open_source, again_s
        self._lock = threading.Condition()
        self._newest: tuple[Observation, str] | None = None
        self._refused: TumortrackError | None = None  # since the last frame that was taken
        self._order = StampOrder()
        self._stop = threading.Event()
        self._passed = 0  # replaced before they were taken, or dropped by sources now closed
        self._source: Source | None = None
        self.latency_from = "arrival"  # where the age of the frame taken last counts from
        self.trouble = f"the source is still opening; {OPENING_S:g} s are allowed"
        self._ended = False
        self.failure: Exception | None = None
        self.defects: list[str] = []
        self.opened = 0
        # Silence counts from here: when the first opening ended, by time.monotonic; 0: it goes on.
        self.ready_s = 0.0
        self.on_demand = False  # open and without trouble, a source that is never silent
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that newer ones replaced, here or in the source."""
        return self._passed + (source.dropped if (source := self._source) else 0)

    @property
    def ended(self) -> bool:
        """No frame will come, and none waits."""
        return self._ended and not self._waits

    def capture_ns(self, seen: Observation) -> int:
        """The time of the frame taken last, by ``time.time_ns``: its stamp, or, if the source has
        another clock, its arrival; for a lossless source, now."""
        if self.latency_from == "stamp":
            return seen.stamp_ns
        return seen.arrived_ns if self.latency_from == "arrival" else time.time_ns()

    def take(self, timeout_s: float) -> Observation | TumortrackError | None:
        """The newest frame, or what was wrong with it; None if none came in time or the source has
        ended. Raises whatever stopped the reading for good."""
        with self._lock:
            self._lock.wait_for(lambda: self._waits or self._over, timeout_s)
            self._lock.notify_all()  # lossless sources go on
            if self._refused is not None:
                refused, self._refused = self._refused, None
                return refused
            if self._newest is not None:
                (newest, self.latency_from), self._newest = self._newest, None
                return newest
        if self.failure is not None:
            raise self.failure
        return None

    def close(self) -> None:
        """Stop reading and close the source; one that hangs is abandoned after 2 s."""
        self._stop.set()
        with self._lock:
            self._lock.notify_all()
        self._thread.join(_STOP_S)
        if self._thread.is_alive() and (source := self._source) is not None:
            source.close()

    @property
    def _waits(self) -> bool:
        return self._newest is not None or self._refused is not None

    @property
    def _over(self) -> bool:
        return self._ended or self.failure is not None

    def _run(self) -> None:
        while not self._stop.is_set() and not self._over:
            try:
                self._read_all()
            except SourceEnded:
                self._ended = True
            except Exception as error:
                self._note(error)
            self.ready_s = self.ready_s or time.monotonic()
            if not self._over:
                self._stop.wait(self._again_s)
        with self._lock:
            self._lock.notify_all()

    def _note(self, error: Exception) -> None:
        """Once the source has worked, any error may be temporary."""
        if not self.opened and not isinstance(error, SourceLost):
            self.failure = error  # handed to the loop, which raises it
        self.trouble = _text_of(error)
        if not isinstance(error, TumortrackError) and len(self.defects) < _DEFECTS:
            self.defects.append("".join(traceback.format_exception(error)))
        self.on_demand = False

    def _read_all(self) -> None:
        source = self._open()
        self._source = source
        self.opened += 1
        self.on_demand = source.on_demand
        self.ready_s = self.ready_s or time.monotonic()
        self.trouble = ""  # last: without trouble, the other two are known
        try:
            last_s = time.monotonic()
            while not self._stop.is_set():
                try:
                    got: Observation | TumortrackError | None = source.read(_READ_S)
                    if isinstance(got, Observation):
                        self._order.check(got.stamp_ns)
                except (InputError, NoEstimate) as error:
                    got = error
                if got is not None:
                    last_s = time.monotonic()
                    # Read each time: some sources know their clock only from the first frame on.
                    clock = "stamp" if source.host_clock else "arrival"
                    self._put(got, "taking" if source.lossless else clock)
                elif not self.on_demand and time.monotonic() - last_s > _FROZEN_S:
                    raise SourceLost(f"no frame for {_FROZEN_S:g} s; the source is opened again")
        finally:
            self._passed, self._source = self.dropped, None
            source.close()

    def _put(self, got: Observation | TumortrackError, counts_from: str) -> None:
        with self._lock:
            if counts_from == "taking":
                self._lock.wait_for(lambda: not self._waits or self._stop.is_set())
            if isinstance(got, TumortrackError):
                self._refused = got
            else:
                self._passed += self._newest is not None
                self._newest = (got, counts_from)
            self._lock.notify_all()


class SinkWorker:
    """Hands results to one sink. More than ``waiting`` are dropped, oldest first, and counted;
    errors are counted and the last one kept."""

    def __init__(self, name: str, sink: Sink, waiting: int, silent_s: float = _SILENT_S) -> None:
        self.name, self._silent_s = name, silent_s
        self._sink = sink
        self.notes: tuple[str, ...] = getattr(sink, "notes", ())
        self._waiting: deque[tuple[TrackingResult, float]] = deque(maxlen=waiting)
        self._lock = threading.Condition()
        self._stop = False
        self.unclosed = False  # closing failed
        self.delivered = self.dropped = self.errors = 0
        self.failing, self.error = False, ""  # now; the last one so far
        self._busy_s = math.inf  # when it started with the present result
        self.latency = Histogram()  # from the stamp (or arrival) to the end of publish
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """What is wrong with it now; empty if nothing is."""
        if time.monotonic() - self._busy_s > _SLOW_S:
            return f"slow: at one result for over {_SLOW_S:g} s, so what it shows is old"
        return self.error if self.failing else ""

    def put(self, result: TrackingResult) -> None:
        with self._lock:
            if len(self._waiting) == self._waiting.maxlen:
                self.dropped += 1
            self._waiting.append((result, time.monotonic()))
            self._lock.notify()

    def close(self) -> None:
        """Hand over what waits, then close the sink; one that hangs is abandoned after 10 s."""
        with self._lock:
            self._stop = True
            self._lock.notify()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._failed(f"it did not finish within {_CLOSE_S:g} s")
            self.unclosed = True

    def summary(self) -> dict[str, Any]:
        counts = getattr(self._sink, "counts", None)
        return {
            "delivered": self.delivered,
            "dropped": self.dropped,
            "errors": self.errors,
            "last_error": self.error,
            "latency_ms": self.latency.summary(),
            **({} if counts is None else {"counts": counts}),
        }

    def _run(self) -> None:
        shown: TrackingResult | None = None  # the last result, until silence replaced it
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._waiting or self._stop, self._silent_s)
                waiting = self._waiting.popleft() if self._waiting else None
                if waiting is None and self._stop:
                    break
            if waiting is not None:
                shown = waiting[0]
                self._publish(*waiting)
            elif shown is not None and self._waiting.maxlen == 1:  # it shows the present
                silence = TrackingResult(
                    shown.sequence,
                    shown.stamp_ns + int(self._silent_s * 1e9),
                    reason=f"the loop has said nothing for {self._silent_s:g} s",
                    published_frame=shown.published_frame,
                )
                self._publish(silence, 0.0)
                shown = None
        try:
            self._sink.close()
        except Exception as error:
            self._failed(_text_of(error))
            self.unclosed = True

    def _publish(self, result: TrackingResult, handed_s: float) -> None:
        self._busy_s = time.monotonic()
        try:
            self._sink.publish(result)
        except Exception as error:  # whatever a sink raises must not end the loop
            self._failed(_text_of(error))
            return
        finally:
            self._busy_s = math.inf
        self.delivered += 1
        self.failing = False
        if result.latency_ms is not None:
            self.latency.add(result.latency_ms + 1000 * (time.monotonic() - handed_s))

    def _failed(self, text: str) -> None:
        self.errors += 1
        self.failing, self.error = True, text


def _text_of(error: Exception) -> str:
    return str(error) if isinstance(error, TumortrackError) else f"{type(error).__name__}: {error}"
