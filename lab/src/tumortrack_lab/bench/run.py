"""A whole run of the bench: its groups of rows, and the processes that measure them.

The number of threads is fixed when libraries are loaded, so there is a process for each number; it
writes its rows as lines of JSON.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple

import msgspec

from tumortrack.cli.console import progress_bar, say
from tumortrack.core.config import from_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.machine import describe_machine
from tumortrack_lab.bench.rows import BenchResult, BenchRow

WORKER = [sys.executable, "-m", "tumortrack_lab.bench.run"]


class Group(NamedTuple):
    """Workloads measured together: module of this package and function that yields them; numbers
    of threads; how many there are, and for how long each is measured (about; with --quick)."""

    source: str
    threads: tuple[int, ...]
    rows: int
    seconds: float
    quick_s: float
    needs_model: bool = False


GROUPS: dict[str, Group] = {
    "frame": Group("registration:frames", (1, 2), 3, 4.0, 1.4, True),
    "tracking": Group("registration:tracking", (1, 2), 1, 3.0, 0.7, True),
    "volume": Group("registration:volumes", (1, 2), 1, 6.0, 2.0, True),
    "command": Group("command:workloads", (2,), 2, 4.2, 1.0, True),
    "patient": Group("command:patient", (2,), 1, 40.0, 20.0),
    "planning": Group("planning:workloads", (1,), 3, 3.0, 0.7),
}


class Task(NamedTuple):
    """What one process measures; ``folder``: of the model."""

    threads: int
    folder: Path
    quick: bool
    groups: tuple[str, ...]


def tasks_of(groups: Sequence[str], folder: Path, quick: bool, cores: int) -> list[Task]:
    """One core, then two threads where there are two cores."""
    tasks = []
    for threads in (1, 2) if cores > 1 else (1,):
        mine = tuple(name for name in groups if threads in GROUPS[name].threads)
        tasks += [Task(threads, folder, quick, mine)] if mine else []
    return tasks


def measure(tasks: Sequence[Task], command: str) -> BenchResult:
    """Make the model if it is needed and not there, then run all processes one after another; shows
    each row, and how long all others will take. Raises TumortrackError: one of them failed."""
    from tumortrack_lab.bench.report import line
    from tumortrack_lab.bench.subject import BenchSubject

    machine, rows = describe_machine(), list[BenchRow]()
    named = [GROUPS[name] for task in tasks for name in task.groups]
    if any(group.needs_model for group in named):
        subject = BenchSubject(tasks[0].folder)
        if not subject.has_model:
            say("making a model to measure")
            subject.make_model()
    with progress_bar("rows", sum(group.rows for group in named)) as advance:
        for task in tasks:
            for row in rows_of(task):
                rows.append(row)
                say(line(row))
                advance()
    return BenchResult(machine=machine, command=command, rows=tuple(rows))


def rows_of(task: Task) -> Iterator[BenchRow]:
    """Run a task in a process. Raises TumortrackError: it failed; the message quotes its last
    line."""
    threads = str(task.threads)
    limits = {f"{name}_NUM_THREADS": threads for name in ("OMP", "MKL", "TUMORTRACK")}
    command = [*WORKER, threads, str(task.folder), "quick" * task.quick, *task.groups]
    with tempfile.TemporaryFile("w+") as stderr:  # a pipe that nobody reads may fill
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stderr, text=True, env={**os.environ, **limits}
        )
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("{"):
                    row = msgspec.json.decode(line)
                    yield from_builtins(row, BenchRow, "a process of the bench")
        except BaseException:  # the caller has gone, or was interrupted
            process.kill()
            raise
        finally:
            code = process.wait()
        stderr.seek(0)
        last = stderr.read().strip().splitlines()[-1:] or ["nothing was said"]
    if code != 0:
        raise TumortrackError(f"measuring failed: {last[0]}")


def carry_out(task: Task) -> Iterator[BenchRow]:
    """Measure, within the process."""
    if hasattr(os, "sched_setaffinity"):  # Linux only; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task.threads])
    from tumortrack_lab.bench.subject import BenchSubject

    subject = BenchSubject(task.folder)
    for group in (GROUPS[name] for name in task.groups):
        seconds = group.quick_s if task.quick else group.seconds
        for workload in resolve_name(f"tumortrack_lab.bench.{group.source}")(subject, seconds):
            yield workload.row(task.threads, seconds)


if __name__ == "__main__":
    try:
        threads, folder, quick, *groups = sys.argv[1:]
        for row in carry_out(Task(int(threads), Path(folder), bool(quick), tuple(groups))):
            print(msgspec.json.encode(row).decode(), flush=True)
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
