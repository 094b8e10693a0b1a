"""For servers: who can reach a host, and a rate limit."""

from __future__ import annotations

import ipaddress
import time
from contextlib import suppress


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach servers on this host."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host.lower() == "localhost"


class Pace:
    """A rate limit: ``per_s`` on average, in bursts of up to ``burst_s``."""

    def __init__(self, per_s: float, burst_s: float = 1.0) -> None:
        self._step_s, self._burst_s, self._next_s = 1 / per_s, burst_s, 0.0

    def wait_s(self, amount: float = 1.0) -> float:
        """How long the client must wait for ``amount`` more; 0: not at all."""
        now = time.monotonic()
        self._next_s = max(self._next_s, now - self._burst_s) + amount * self._step_s
        return max(0.0, self._next_s - now)
