"""Timing several versions in turns, so that what else the machine does meets all of them."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

ROUNDS = 5


def medians(*versions: Callable[[], object]) -> list[float]:
    """Median seconds of each, the versions taking turns."""
    seconds: list[list[float]] = [[] for _ in versions]
    for version in versions:
        version()  # compiled, cached, warm
    for _ in range(ROUNDS):
        for times, version in zip(seconds, versions, strict=True):
            start = time.perf_counter()
            version()
            times.append(time.perf_counter() - start)
    return [float(np.median(times)) for times in seconds]
