"""Resources of this process: cores, a second thread, freed memory; its Ctrl-C."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

_CGROUPS = Path("/sys/fs/cgroup")
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_MMAP_MAX = -1, -3, -4  # glibc's malloc.h
_MMAP_MAX = 65536  # glibc's default
_RETRY_S = 0.02  # after which an import may have ended
_CATCHING_ALL = {"trimesh"}  # when they import others
_SMALL = 32 * 2**20  # bytes: the largest threshold that glibc accepts
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def available_cores(cgroups: Path = _CGROUPS) -> int:
    """The number of cores by the affinity mask and the container's quota, at least 1."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux only
    cores, quota = len(affinity(0)) if affinity else os.cpu_count() or 1, _quota(cgroups)
    return cores if quota is None else max(1, min(cores, round(quota)))


def _quota(cgroups: Path) -> float | None:
    """Cores that the control group allows (version 2, then 1); None: no limit."""
    try:
        if (cgroups / "cpu.max").is_file():
            quota, period = (cgroups / "cpu.max").read_text().split()
        else:
            quota = (cgroups / "cpu" / "cpu.cfs_quota_us").read_text()
            period = (cgroups / "cpu" / "cpu.cfs_period_us").read_text()
        return float(quota) / float(period) if float(quota) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):  # no such files, or "max"
        return None


def parallel_for(body: Callable[[slice], object], count: int, chunk: int) -> None:
    """Call ``body`` on every chunk of ``range(count)``, on two threads if there are two cores.
    Chunks, and so sums over them, do not depend on the number of cores. The second thread helps
    only if ``body`` releases the GIL; if it starts too late, it is not waited for.
    ``TUMORTRACK_NUM_THREADS=1`` keeps all work on the calling thread."""
    chunks = deque(slice(first, first + chunk) for first in range(0, count, chunk))

    def drain() -> None:
        while chunks:
            try:
                part = chunks.popleft()
            except IndexError:  # the other thread was faster
                return
            body(part)

    helper = _helper(os.getpid()) if len(chunks) > 1 else None
    other = None if helper is None else helper.submit(drain)
    drain()
    if other is not None and not other.cancel():
        other.result()


def parallel_map(call: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """``list(map(call, items))`` by ``parallel_for``."""
    results: dict[int, _Result] = {}

    def run(part: slice) -> None:
        results[part.start] = call(items[part.start])

    parallel_for(run, len(items), 1)
    return [results[n] for n in range(len(items))]


@cache
def _helper(process: int) -> ThreadPoolExecutor | None:
    """A second thread of this process (threads do not survive a fork), if there is a core."""
    from concurrent.futures import ThreadPoolExecutor

    cores = min(available_cores(), int(os.environ.get("TUMORTRACK_NUM_THREADS", "2")))
    return ThreadPoolExecutor(1, "parallel") if cores > 1 else None


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ctrl-C waits until the end. Processes that begin in here never get it."""
    if threading.current_thread() is not threading.main_thread():  # which alone gets it
        yield
        return
    came: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # is inherited
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)


def interrupt_between_imports(retries: int = 100) -> None:
    """Let Ctrl-C wait while modules are imported: some libraries catch all that is raised in there,
    and go on as if nothing had been, or with half of themselves. After ``retries``, 2 s, it waits
    for those alone that are known to do so."""
    if sys.platform == "win32" or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return  # no timer; or a shell in the background wants it to be ignored

    def came(number: int, frame: FrameType | None) -> None:
        nonlocal retries
        packages = _importing(frame)
        if packages & _CATCHING_ALL or (packages and retries > 0):
            retries -= 1
            signal.setitimer(signal.ITIMER_REAL, _RETRY_S)
            return
        raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    signal.signal(signal.SIGINT, came)


def _importing(frame: FrameType | None) -> set[str]:
    """The packages of which a module is being imported in a frame or its callers."""
    packages, module = set[str](), ""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib."):
            packages.add(module.partition(".")[0])
        elif frame.f_code.co_name == "<module>":
            module = str(frame.f_globals.get("__name__"))
        frame = frame.f_back
    return packages


def keep_freed_memory() -> None:
    """Make glibc keep freed blocks, as page faults cost more than the memory: CPU training becomes
    about a tenth faster. No effect with other C libraries."""
    _mallopt({_M_MMAP_MAX: 0, _M_TRIM_THRESHOLD: 2**31 - 1})


def tune_malloc() -> None:
    """The same for blocks of up to 32 MB, as frames need: ``elastic`` takes a third less time.
    Larger blocks, such as volumes, are still returned to the system."""
    _mallopt({_M_MMAP_MAX: _MMAP_MAX, _M_MMAP_THRESHOLD: _SMALL, _M_TRIM_THRESHOLD: 8 * _SMALL})


def _mallopt(options: dict[int, int]) -> None:
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        for option, value in options.items():
            mallopt(option, value)
