"""How often a sink sends."""

from __future__ import annotations

import time


class Rate:
    """Lets things happen at most ``hz`` times a second on average; 0: each time."""

    def __init__(self, hz: float) -> None:
        self._period_s = 1 / hz if hz > 0 else 0.0
        self._next_s = 0.0

    def due(self) -> bool:
        now = time.monotonic()
        if now < self._next_s:
            return False
        in_step = now < self._next_s + self._period_s
        self._next_s = (self._next_s if in_step else now) + self._period_s
        return True
