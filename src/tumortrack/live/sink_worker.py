"""A sink at work in a thread of its own, so that none holds up the loop or another."""

from __future__ import annotations

import threading
import time
from collections import deque

from tumortrack.core.errors import TumortrackError
from tumortrack.live.meter import Histogram
from tumortrack.live.values import CountingSink, Sink, TrackingResult

_CLOSE_S = 10.0  # to write what waits, and flush
_SILENT_S = 2.0  # without a word from the loop: what a sink shows holds no longer


class SinkWorker:
    """Hands results to one sink: the newest ``waiting`` of them. What does not fit is dropped,
    oldest first, and counted; errors are counted and the last one kept."""

    def __init__(self, name: str, sink: Sink, waiting: int) -> None:
        self.name = name
        self._sink = sink
        self._waiting: deque[tuple[TrackingResult, float]] = deque(maxlen=waiting)
        self._lock = threading.Condition()
        self._stop = False
        self.unclosed = False  # it failed at its end
        self.delivered = self.dropped = self.errors = 0
        self.failing, self.error = False, ""  # now; the last one there was
        self.latency = Histogram()  # from the stamp (or arrival) to the end of publish
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, result: TrackingResult) -> None:
        """Returns at once."""
        with self._lock:
            if len(self._waiting) == self._waiting.maxlen:
                self.dropped += 1
            self._waiting.append((result, time.monotonic()))
            self._lock.notify()

    def close(self) -> None:
        """Hand over what waits, then close the sink; a sink that hangs is left after 10 s."""
        with self._lock:
            self._stop = True
            self._lock.notify()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._failed(f"it did not finish within {_CLOSE_S:g} s")
            self.unclosed = True

    def summary(self) -> dict:
        """What became of the results (JSON types)."""
        return {
            "delivered": self.delivered,
            "dropped": self.dropped,
            "errors": self.errors,
            "last_error": self.error,
            "latency_ms": self.latency.summary(),
            **({"counts": self._sink.counts} if isinstance(self._sink, CountingSink) else {}),
        }

    def _run(self) -> None:
        shown: TrackingResult | None = None  # the last result, until it was replaced for silence
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._waiting or self._stop, _SILENT_S)
                came = self._waiting.popleft() if self._waiting else None
                if came is None and self._stop:
                    break
            if came is not None:
                shown = came[0]
                self._guarded(*came)
            elif shown is not None and self._waiting.maxlen == 1:  # a recording has no present
                self._guarded(_after_silence(shown), 0.0)
                shown = None
        try:
            self._sink.close()
        except Exception as error:
            self._failed(_text_of(error))
            self.unclosed = True

    def _guarded(self, result: TrackingResult, handed_s: float) -> None:
        try:
            self._sink.publish(result)
        except Exception as error:  # whatever a sink raises must not end the loop
            self._failed(_text_of(error))
            return
        self.delivered += 1
        self.failing = False
        if result.latency_ms is not None:
            self.latency.add(result.latency_ms + 1000 * (time.monotonic() - handed_s))

    def _failed(self, text: str) -> None:
        self.errors += 1
        self.failing, self.error = True, text


def _after_silence(last: TrackingResult) -> TrackingResult:
    """What follows a result if the loop then hangs."""
    return TrackingResult(
        last.sequence,
        last.stamp_ns + int(_SILENT_S * 1e9),
        reason=f"the loop has said nothing for {_SILENT_S:g} s",
        published_frame=last.published_frame,
    )


def _text_of(error: Exception) -> str:
    return str(error) if isinstance(error, TumortrackError) else f"{type(error).__name__}: {error}"
