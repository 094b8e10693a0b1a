"""The reading thread: opens a source, keeps its newest frame, opens it again when it is lost."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable

from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.live.values import Observation, Source, SourceEnded, SourceLost

_READ_S = 0.2  # one wait for a frame: how soon the thread sees that it is to stop
_AGAIN_S = 1.0  # between two tries to open
_FROZEN_S = 5.0  # without a frame: closed and opened again
_DEFECTS = 5  # tracebacks that are kept
_STOP_S = 2.0  # how long close waits for a source that hangs


class SourceWorker:
    """Reads from a thread of its own. Of frames that come faster than they are taken the newest
    stays, and the others count as dropped; a source that ``waits`` is read only as they are taken.
    """

    def __init__(self, open_source: Callable[[], Source]) -> None:
        self._open = open_source
        self._lock = threading.Condition()
        self._newest: tuple[Observation | TumortrackError, str] | None = None
        self._stop = threading.Event()
        self._passed = 0  # replaced before they were taken
        self._lost_inside = 0  # dropped by sources that are closed
        self._source: Source | None = None
        self.latency_from = "arrival"  # what the age of what was taken counts from
        self.trouble = "the source is not open yet"
        self.ended = False
        self.failure: Exception | None = None
        self.defects: list[str] = []
        self.opened = 0
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that nobody got: overtaken by newer ones, here or in the source."""
        source = self._source
        return self._passed + self._lost_inside + (source.dropped if source else 0)

    def born_ns(self, seen: Observation) -> int:
        """When the frame just taken came to be, by ``time.time_ns``: its stamp, or where the source
        has another clock, its arrival; of a source that waits for us, now."""
        if self.latency_from == "stamp":
            return seen.stamp_ns
        return seen.arrived_ns if self.latency_from == "arrival" else time.time_ns()

    def take(self, timeout_s: float) -> Observation | TumortrackError | None:
        """The newest frame, or what was wrong with it; None if none came in time or all is over.

        Raises whatever stopped the reading for good.
        """
        with self._lock:
            self._lock.wait_for(lambda: self._newest is not None or self._over, timeout_s)
            newest, self._newest = self._newest, None
            self._lock.notify_all()
        if newest is not None:
            taken, self.latency_from = newest
            return taken
        if self.failure is not None:
            raise self.failure
        return None

    def close(self) -> None:
        """Stop reading and close the source; one that hangs is left behind after 2 s."""
        self._stop.set()
        with self._lock:
            self._lock.notify_all()
        self._thread.join(_STOP_S)
        if self._thread.is_alive() and self._source is not None:
            self._source.close()

    @property
    def _over(self) -> bool:
        return self.ended or self.failure is not None

    def _run(self) -> None:
        while not self._stop.is_set() and not self._over:
            try:
                self._read_all()
            except SourceEnded:
                self.ended = True
            except SourceLost as error:
                self.trouble = str(error)
            except Exception as error:  # after it worked once, whatever it is may pass
                if not self.opened:
                    self.failure = error  # handed to the loop, which raises it
                elif isinstance(error, TumortrackError):
                    self.trouble = str(error)
                else:
                    self.trouble = f"internal error, {type(error).__name__}: {error}"
                    self.defects.append("".join(traceback.format_exception(error)))
                    del self.defects[_DEFECTS:]
            if not self._over:
                self._stop.wait(_AGAIN_S)
        with self._lock:
            self._lock.notify_all()

    def _read_all(self) -> None:
        source = self._open()
        self._source = source
        self.opened += 1
        self.trouble = ""
        try:
            came = time.monotonic()
            while not self._stop.is_set():
                try:
                    got: Observation | TumortrackError | None = source.read(_READ_S)
                except InputError as error:
                    got = error
                if got is not None:
                    came = time.monotonic()
                    # Asked for again: some know whose clock it is from the first frame on only.
                    clock = "stamp" if source.host_clock else "arrival"
                    self._put(got, "taking" if source.lossless else clock)
                elif time.monotonic() - came > _FROZEN_S:
                    raise SourceLost(f"no frame for {_FROZEN_S:g} s; the source is opened again")
        finally:
            self._lost_inside += source.dropped
            self._source = None
            source.close()

    def _put(self, got: Observation | TumortrackError, counts_from: str) -> None:
        with self._lock:
            if counts_from == "taking":
                self._lock.wait_for(lambda: self._newest is None or self._stop.is_set())
            elif self._newest is not None:
                self._passed += 1
            self._newest = (got, counts_from)
            self._lock.notify_all()
