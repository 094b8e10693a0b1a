"""Work on many points, shared by two threads where there are two cores."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from tumortrack.core.cores import available_cores

Work = Callable[[slice], object]


def share(work: Work, count: int, at_once: int) -> None:
    """Call ``work`` with every part of ``count`` points, ``at_once`` of them each.

    Parts are the same however many cores there are, so that sums over them are. Where there is a
    second core and more than one part, a second thread takes parts as well: worth while for work
    that gives up Python's lock. One that wakes too late is not waited for. ``NUMBA_NUM_THREADS``
    of 1 forbids it.
    """
    parts = deque(slice(first, first + at_once) for first in range(0, count, at_once))

    def drain() -> None:
        while parts:
            try:
                part = parts.popleft()
            except IndexError:  # the other thread was faster
                return
            work(part)

    helper = _helper(os.getpid()) if len(parts) > 1 else None
    other = None if helper is None else helper.submit(drain)
    drain()
    if other is not None and not other.cancel():
        other.result()


@cache
def _helper(process: int) -> ThreadPoolExecutor | None:
    """A second thread of this process (a fork has none of its parent's), if it has a core."""
    cores = min(available_cores(), int(os.environ.get("NUMBA_NUM_THREADS", "2")))
    return ThreadPoolExecutor(1, "sharing") if cores > 1 else None
