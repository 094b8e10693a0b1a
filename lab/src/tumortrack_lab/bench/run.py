"""A whole run of the bench: its groups of rows, and the processes that measure them.

Each number of threads is a process of its own, because it is settled when the libraries are loaded.
A process writes what it finds as lines of JSON.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple

import msgspec

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.rows import PRESETS, BenchRow

WORKER = [sys.executable, "-m", "tumortrack_lab.bench.run"]


class Group(NamedTuple):
    """Workloads measured together: module of this package and function that yields them; numbers
    of threads; for how long each is measured (about; in a hurry); presets whose trained models they
    need."""

    source: str
    threads: tuple[int, ...]
    seconds: float
    quick_s: float
    needs: tuple[str, ...] = ()


# Training comes last: it tells the C library to keep freed memory, which stays so.
GROUPS: dict[str, Group] = {
    "generator": Group("training:drags", (1,), 3.0, 0.7),
    "elastic-generator": Group("training:elastic", (1,), 3.0, 0.7, ("clinic",)),
    "frame": Group("subject:frames", (1, 2), 4.0, 1.4, PRESETS),
    "tracking": Group("subject:tracking", (1, 2), 3.0, 0.7, PRESETS),
    "volume": Group("subject:volumes", (1, 2), 6.0, 2.0, PRESETS),
    "command": Group("command:workloads", (2,), 4.2, 1.0, PRESETS),
    "planning": Group("planning:workloads", (1,), 3.0, 0.7),
    "training": Group("training:steps", (1,), 5.0, 1.0, ("clinic",)),
    "whole-training": Group("training:whole", (2,), 20.0, 12.0),
    "gpu": Group("training:on_gpu", (2,), 10.0, 3.4, PRESETS),
}


class Task(Config, frozen=True):
    """What one process does: train presets into ``folder`` where they are not there yet, then
    measure groups."""

    threads: int
    folder: str
    quick: bool = False
    presets: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()


class TaskMessage(Config, frozen=True):
    """One line of a process: a row, or what it does now."""

    row: BenchRow | None = None
    under_way: str = ""


def tasks_of(names: Sequence[str], folder: Path, quick: bool, cores: int) -> list[Task]:
    """First the trainings with all cores, then one core, then two threads."""
    needed = tuple(sorted({preset for name in names for preset in GROUPS[name].needs}))
    tasks = [Task(threads=min(cores, 2), folder=str(folder), presets=needed)] if needed else []
    for threads in range(1, min(cores, 2) + 1):
        mine = tuple(name for name in names if threads in GROUPS[name].threads)
        if mine:
            tasks.append(Task(threads=threads, folder=str(folder), quick=quick, groups=mine))
    return tasks


def measure(
    tasks: Sequence[Task], report: Callable[[str], None], show: Callable[[BenchRow], None]
) -> tuple[BenchRow, ...]:
    """Run all processes one after another. ``report`` is called with what is under way, ``show``
    with each row once it is measured. Raises TumortrackError: one of them failed."""
    rows = []
    for message in (message for task in tasks for message in listen(task)):
        if message.row is not None:
            rows.append(message.row)
            show(message.row)
        else:
            report(message.under_way)
    return tuple(rows)


def listen(task: Task) -> Iterator[TaskMessage]:
    """Run a task in a process: the worker with the task's JSON behind it. Raises TumortrackError:
    it failed, the message says its last words."""
    threads = str(task.threads)
    limits = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
    command = [*WORKER, msgspec.json.encode(task).decode()]
    with tempfile.TemporaryFile("w+") as words:  # no pipe: one that nobody reads may fill
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=words, text=True, env={**os.environ, **limits}
        )
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("{"):
                    found = msgspec.json.decode(line)
                    yield from_builtins(found, TaskMessage, "a process of the bench")
        except BaseException:  # whoever listens has gone, or was interrupted
            process.kill()
            raise
        finally:
            code = process.wait()
        words.seek(0)
        last = words.read().strip().splitlines()[-1:] or ["nothing was said"]
    if code != 0:
        raise TumortrackError(f"measuring failed: {last[0]}")


def carry_out(task: Task, tell: Callable[[TaskMessage], None]) -> None:
    """Tell everything that a task asks for, as it becomes known."""
    from tumortrack.training.presets import PRESETS as CONFIGURATIONS
    from tumortrack_lab.bench.subject import BenchSubject

    subject = BenchSubject(CONFIGURATIONS, Path(task.folder))
    for preset in task.presets:
        if not subject.trained(preset):
            tell(TaskMessage(under_way=f"training a `{preset}` network to measure"))
            subject.train(preset)
    for name in task.groups:
        group = GROUPS[name]
        tell(TaskMessage(under_way=f"{name}, threads: {task.threads}"))
        seconds = group.quick_s if task.quick else group.seconds
        for workload in resolve_name(f"tumortrack_lab.bench.{group.source}")(subject, seconds):
            tell(TaskMessage(row=workload.row(task.threads, seconds)))


def _work(task_json: str) -> None:
    """A process of the bench: carries one task out and writes each result as a line of JSON."""
    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    if hasattr(os, "sched_setaffinity"):  # Linux alone has it; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task.threads])
    carry_out(task, lambda message: print(msgspec.json.encode(message).decode(), flush=True))


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
