"""A whole run of the bench: its groups of rows, its processes, and what they report.

Each task is a process of its own: the number of threads is fixed when the libraries are loaded, and
memory that one measurement leaves behind would be the next one's. A process writes its results as
lines of JSON.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.rows import BenchResult, BenchRow

if TYPE_CHECKING:  # with libraries whose threads are fixed when they are imported
    from tumortrack_lab.bench.subject import BenchSubject

WORKER = [sys.executable, "-m", "tumortrack_lab.bench.run"]
MACHINE, MODEL = "machine", "model"  # parts of a task besides groups


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
    "command": Group("command:workloads", (2,), 6, 4.2, 1.0, True),
    "patient": Group("command:patient", (2,), 1, 40.0, 20.0),
    "planning": Group("planning:workloads", (1,), 3, 3.0, 0.7),
}


class Task(Config, frozen=True):
    """What one process does, part by part: describe the ``machine``, make the ``model``, measure a
    group of rows. ``folder``: of the model."""

    threads: int
    folder: str
    quick: bool = False
    parts: tuple[str, ...] = ()

    def budget_s(self, group: str) -> float:
        return GROUPS[group].quick_s if self.quick else GROUPS[group].seconds

    def expected_s(self, part: str) -> float:
        """On a machine of two cores, roughly."""
        if part in GROUPS:
            return 2 * GROUPS[part].rows * self.budget_s(part)
        return {MACHINE: 0.0, MODEL: 40.0}[part]


class TaskMessage(Config, frozen=True):
    """One line of a process: a result, or which part begins now, and how long that and all later
    ones are expected to take."""

    begins: str | None = None
    expected_s: tuple[float, float] = (0.0, 0.0)
    machine: dict[str, str] | None = None
    row: BenchRow | None = None


def tasks_of(common: Task, groups: Sequence[str], cores: int) -> list[Task]:
    """What all have in common, as tasks: first the model, then one core, two threads."""
    work: list[tuple[int, list[str]]] = []
    if any(GROUPS[name].needs_model for name in groups):
        work.append((min(cores, 2), [MODEL]))
    for threads in (1, 2):
        parts = [name for name in groups if threads in GROUPS[name].threads]
        if parts and threads <= cores:
            work.append((threads, parts))
    work[0][1].insert(0, MACHINE)
    return [
        msgspec.structs.replace(common, threads=threads, parts=tuple(parts))
        for threads, parts in work
    ]


class _Pace:
    """How long all will still take, judged by how long finished parts took against what was
    expected of them."""

    def __init__(self, expected_s: float) -> None:
        self._whole_s, self._begun_s = expected_s, time.monotonic()
        self.begin_part(0.0, expected_s)

    def begin_part(self, part_s: float, later_s: float) -> None:
        self._part_s, self._later_s, self._part_begun_s = part_s, later_s, time.monotonic()

    @property
    def left(self) -> str:
        done_s = self._whole_s - self._later_s - self._part_s
        pace = (self._part_begun_s - self._begun_s) / done_s if done_s else 1.0
        part_s = pace * self._part_s - (time.monotonic() - self._part_begun_s)
        seconds = pace * self._later_s + max(part_s, 0.0)
        about = f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
        return f"about {about} left"


def measure(
    tasks: Sequence[Task],
    command: str,
    report: Callable[[str], None],
    show: Callable[[BenchRow, str], None],
) -> BenchResult:
    """Run all processes one after another. ``report`` is called with each part that begins and the
    expected remaining time, ``show`` with each row and that time. Raises TumortrackError: one of
    them failed."""
    machine: dict[str, str] = {}
    rows: list[BenchRow] = []
    expected_s = [sum(map(task.expected_s, task.parts)) for task in tasks]
    pace = _Pace(sum(expected_s))
    for number, task in enumerate(tasks, start=1):
        for message in listen(task):
            machine = message.machine or machine
            if message.row is not None:
                rows.append(message.row)
                show(message.row, pace.left)
            if message.begins is not None:
                part_s, later_s = message.expected_s
                pace.begin_part(part_s, later_s + sum(expected_s[number:]))
                report(f"{message.begins}; {pace.left}")
    return BenchResult(machine=machine, command=command, rows=tuple(rows))


def listen(task: Task) -> Iterator[TaskMessage]:
    """Run a task in a process, which gets the task as JSON. Raises TumortrackError: it failed; the
    message quotes its last line."""
    threads = str(task.threads)
    limits = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
    command = [*WORKER, msgspec.json.encode(task).decode()]
    with tempfile.TemporaryFile("w+") as stderr:  # a pipe that nobody reads may fill
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stderr, text=True, env={**os.environ, **limits}
        )
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if line.startswith("{"):
                    message = msgspec.json.decode(line)
                    yield from_builtins(message, TaskMessage, "a process of the bench")
        except BaseException:  # the caller has gone, or was interrupted
            process.kill()
            raise
        finally:
            code = process.wait()
        stderr.seek(0)
        last = stderr.read().strip().splitlines()[-1:] or ["nothing was said"]
    if code != 0:
        raise TumortrackError(f"measuring failed: {last[0]}")


def carry_out(task: Task, subject: BenchSubject, send: Callable[[TaskMessage], None]) -> None:
    """Send everything that a task asks for, as it becomes known."""
    from tumortrack_lab.bench.machine import describe_machine

    threads = {1: "one core"}.get(task.threads, f"{task.threads} threads")
    for number, part in enumerate(task.parts):
        if part == MACHINE:
            send(TaskMessage(machine=describe_machine()))
            continue
        if part == MODEL and subject.has_model:
            continue
        part_s, *later_s = map(task.expected_s, task.parts[number:])
        words = "making a model to measure" if part == MODEL else f"{part}, {threads}"
        send(TaskMessage(begins=words, expected_s=(part_s, sum(later_s))))
        if part == MODEL:
            subject.make_model()
            continue
        workloads = resolve_name(f"tumortrack_lab.bench.{GROUPS[part].source}")
        for workload in workloads(subject, task.budget_s(part)):
            send(TaskMessage(row=workload.row(task.threads, task.budget_s(part))))


def _work(task_json: str) -> None:
    """A process of the bench: carry out one task and write each result as a line of JSON."""
    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    if hasattr(os, "sched_setaffinity"):  # Linux only; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task.threads])
    from tumortrack_lab.bench.subject import BenchSubject

    def send(message: TaskMessage) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    carry_out(task, BenchSubject(Path(task.folder)), send)


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
