"""A sink at work in a thread of its own, so that none holds up the loop or another."""

from __future__ import annotations

import threading
import time
from collections import deque

from tumortrack.core.errors import TumortrackError
from tumortrack.track.live import Sink, Update
from tumortrack.track.meter import Histogram

_CLOSE_S = 10.0  # to write what waits, and flush


class Outlet:
    """Hands updates to one sink: the newest ``waiting`` of them. What does not fit is dropped,
    oldest first, and counted; errors are counted and the last one kept."""

    def __init__(self, name: str, sink: Sink, waiting: int) -> None:
        self.name = name
        self._sink = sink
        self._waiting: deque[tuple[Update, float]] = deque(maxlen=waiting)
        self._lock = threading.Condition()
        self._stop = False
        self.delivered = self.dropped = self.errors = 0
        self.failing, self.error = False, ""  # now; the last one there was
        self.latency = Histogram()  # from the stamp (or arrival) to the end of publish
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, update: Update) -> None:
        """Returns at once."""
        with self._lock:
            if len(self._waiting) == self._waiting.maxlen:
                self.dropped += 1
            self._waiting.append((update, time.monotonic()))
            self._lock.notify()

    def close(self) -> None:
        """Hand over what waits, then close the sink; a sink that hangs is left after 10 s."""
        with self._lock:
            self._stop = True
            self._lock.notify()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._failed(f"it did not finish within {_CLOSE_S:g} s")

    def summary(self) -> dict:
        """What became of the updates (JSON types)."""
        return {
            "delivered": self.delivered,
            "dropped": self.dropped,
            "errors": self.errors,
            "last_error": self.error,
            "latency_ms": self.latency.summary(),
        }

    def _run(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._waiting or self._stop)
                if not self._waiting:
                    break
                update, handed_s = self._waiting.popleft()
            self._guarded(update, handed_s)
        try:
            self._sink.close()
        except Exception as error:
            self._failed(_said(error))

    def _guarded(self, update: Update, handed_s: float) -> None:
        try:
            self._sink.publish(update)
        except Exception as error:  # whatever a sink raises must not end the loop
            self._failed(_said(error))
            return
        self.delivered += 1
        self.failing = False
        if update.latency_ms is not None:
            self.latency.add(update.latency_ms + 1000 * (time.monotonic() - handed_s))

    def _failed(self, text: str) -> None:
        self.errors += 1
        self.failing, self.error = True, text


def _said(error: Exception) -> str:
    return str(error) if isinstance(error, TumortrackError) else f"{type(error).__name__}: {error}"
