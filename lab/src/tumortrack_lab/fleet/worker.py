"""What happens where a task runs: fetch its inputs, call its work, store its result."""

from __future__ import annotations

import os
import resource
import socket
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import tumortrack
from tumortrack.core.errors import InputError, StorageError, TumortrackError
from tumortrack_lab.fleet.store import DamagedError, Store, scratch
from tumortrack_lab.fleet.task import File, Task, Work

_RENEWED_S = 15.0  # between renewals of a claim


@dataclass(frozen=True)
class Job:
    """A task as sent to a worker: names and keys, no data. ``reasons``: why attempts failed."""

    key: str
    name: str
    work: Work
    options: Mapping[str, Any]
    inputs: Mapping[str, str | File]  # keys of results in the store; users' files
    memory_mb: int
    store: str
    run: str  # its name, for claims
    reasons: tuple[str, ...] = ()
    tumortrack: str = tumortrack.__version__


@dataclass(frozen=True)
class Report:
    """How an attempt ended.

    elsewhere: another run is doing it now. there, done: the result is in the store, from before or
    from now. cannot: it can never be done, as the store says from now on. changed: a user's file
    was changed. Another attempt may succeed after: damaged (the result ``damaged`` must be made
    again first), memory (too little), failed (the machine, or a defect of ours).
    """

    state: Literal["elsewhere", "there", "done", "cannot", "changed", "damaged", "memory", "failed"]
    reason: str = ""
    damaged: str = ""


def job_of(task: Task, memory_mb: int, store: str, run: str, reasons: tuple[str, ...]) -> Job:
    inputs = {key: of if isinstance(of, File) else of.key for key, of in task.inputs.items()}
    who = f"{task.patient} {task.step}"
    return Job(task.key, who, task.work, task.options, inputs, memory_mb, store, run, reasons)


def perform(job: Job) -> Report:
    """Do a task, unless it has been done meanwhile. Errors that another attempt may avoid are
    reported, not raised."""
    if job.tumortrack != tumortrack.__version__:
        words = f"{socket.gethostname()} has tumortrack {tumortrack.__version__}"
        return Report("failed", f"{words}, the command {job.tumortrack}: install the same")
    try:
        store = _store(job.store)
        if not store.claim(job.key, job.run):
            return Report("elsewhere")
        aside = tempfile.TemporaryDirectory(dir=scratch(), ignore_cleanup_errors=True)
        with _claimed(job, store), aside as folder:
            there, failure = store.found(job.key)
            if there:
                return Report("there") if failure is None else Report("cannot", failure)
            inputs = {
                name: store.user_file(source) if isinstance(source, File) else store.get(source)
                for name, source in job.inputs.items()
            }
            return _measured(job, store, inputs, Path(folder))
    except DamagedError as error:
        return Report("damaged", str(error), error.key)
    except InputError as error:
        return Report("changed", str(error))
    except (Exception, SystemExit) as error:
        return _attempt_failed(error)


@contextmanager
def _claimed(job: Job, store: Store) -> Iterator[None]:
    """Renews the claim regularly, and gives it up in the end."""
    over = threading.Event()

    def renew() -> None:
        while not over.wait(_RENEWED_S):
            with suppress(OSError):
                store.claim(job.key, job.run)

    thread = threading.Thread(target=renew, name="claim", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        with suppress(OSError):
            store.release(job.key)


def _measured(job: Job, store: Store, inputs: Mapping[str, Path], out: Path) -> Report:
    """Do the work and store its result and cost."""
    meter = _Meter()
    _use_one_core()
    try:
        job.work(inputs, job.options, out)
    except StorageError as error:  # the disk's, not the patient's
        return _attempt_failed(error)
    except TumortrackError as error:
        reason = f"{type(error).__name__}: {error}"
        for name, path in (*inputs.items(), ("OUT", out)):
            reason = reason.replace(str(path), name)  # the same on every machine
        store.put_failure(job.key, reason)
        report = Report("cannot", reason)
    else:
        store.put(job.key, out)
        report = Report("done")
    store.put_cost(job.key, meter.cost(job, out))
    return report


def _attempt_failed(error: BaseException) -> Report:
    words = f"{type(error).__name__}: {error}"
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return Report("memory", words)
    if not isinstance(error, OSError | TumortrackError):  # perhaps a defect: say where
        last = traceback.extract_tb(error.__traceback__)[-1]
        words += f" ({Path(last.filename).name}, line {last.lineno})"
    return Report("failed", words)


@cache
def _store(url: str) -> Store:
    return Store(url)


def _use_one_core() -> None:
    """Limit libraries that the work loads or starts."""
    os.environ["OMP_NUM_THREADS"] = "1"


class _Meter:
    """Measures from its creation to ``cost``."""

    def __init__(self) -> None:
        with suppress(OSError):  # Linux: the peak is this task's, not of those before it
            Path("/proc/self/clear_refs").write_text("5")
        self._start_s, self._start_cpu_s = time.monotonic(), _cpu_s()

    def cost(self, job: Job, out: Path) -> dict[str, Any]:
        """Seconds, CPU seconds, peak memory in megabytes, bytes of the result."""
        return {
            "task": job.name,
            "seconds": round(time.monotonic() - self._start_s, 3),
            "cpu_s": round(_cpu_s() - self._start_cpu_s, 3),
            "peak_mb": round(_peak_mb(), 1),
            "bytes": sum(path.stat().st_size for path in out.rglob("*") if path.is_file()),
            "host": socket.gethostname(),
            "attempts": [*job.reasons, ""],
        }


def _cpu_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _peak_mb() -> float:
    """The larger of this process's peak and its largest child's."""
    child = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return max(child, int(line.split()[1]) / 1024)
    return max(child, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
