"""The newest message of a topic, handed from the thread that receives to the one that reads."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Raw:
    """A message as it came: ``kind`` is its type, ``arrived_ns`` by ``time.time_ns``."""

    topic: str
    kind: str
    content: bytes
    arrived_ns: int


class Newest:
    """Keeps one message: the next takes its place. ``replaced`` counts those nobody took."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._last: Raw | None = None
        self._fresh = self.closed = False
        self.replaced = 0

    def put(self, topic: str, kind: str, content: bytes) -> None:
        raw = Raw(topic, kind, content, time.time_ns())
        with self._changed:
            self.replaced += self._fresh
            self._last, self._fresh = raw, True
            self._changed.notify_all()

    def take(self, timeout_s: float) -> Raw | None:
        """The newest message not yet taken; None if none came in time or all is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._fresh or self.closed, max(timeout_s, 0.0))
            fresh, self._fresh = self._fresh, False
            return self._last if fresh else None

    def latest(self, timeout_s: float) -> Raw | None:
        """The newest message, taken or not; None if there was none in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._last or self.closed, max(timeout_s, 0.0))
            self._fresh = False
            return self._last

    def close(self) -> None:
        """Nobody waits any longer."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()
