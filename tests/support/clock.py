"""Time for tests: a clock that they turn by hand, and patience with a loaded machine."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE_S = 60.0  # of a loaded machine; what is waited for comes at once on an idle one

S, T = TypeVar("S"), TypeVar("T")


class Clock:
    """Stands in for a module's ``time``, and for an event that is never set: time passes only
    where somebody sleeps or waits."""

    def __init__(self) -> None:
        self._ns = 10**15

    def time_ns(self) -> int:
        return self._ns

    monotonic_ns = time_ns

    def monotonic(self) -> float:
        return self._ns * 1e-9

    perf_counter = monotonic

    def sleep(self, seconds: float) -> None:
        self._ns += math.ceil(seconds * 1e9)  # never none: who waits again gets on

    def wait(self, seconds: float) -> bool:
        self.sleep(seconds)
        return False

    def of(self, source: S) -> S:
        """A source that waits for frames by this clock."""
        source._closed = self  # type: ignore[attr-defined]
        return source

    def is_set(self) -> bool:
        return False


def until(met: Callable[[], T], what: str = "it", seconds: float = PATIENCE_S) -> T:
    """Wait for something to be true, and give it back."""
    end = time.monotonic() + seconds
    while not (found := met()):
        assert time.monotonic() < end, f"{what} did not happen within {seconds:g} s"
        time.sleep(0.01)
    return found
