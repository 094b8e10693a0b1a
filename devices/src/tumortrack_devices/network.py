"""For what sends and serves: how often, how much, and who can reach it."""

from __future__ import annotations

import ipaddress
import time
from contextlib import suppress


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach servers on this host."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host.lower() == "localhost"


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


class Pace:
    """A limit of requests: ``per_s`` on average, in bursts of up to a second."""

    def __init__(self, per_s: float) -> None:
        self._step_s, self._next_s = 1 / per_s, 0.0

    def wait_s(self) -> float:
        """How long a client must wait for its next one; 0: not at all."""
        now = time.monotonic()
        self._next_s = max(self._next_s, now - 1) + self._step_s
        return max(0.0, self._next_s - now)
