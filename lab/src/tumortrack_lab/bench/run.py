"""A whole run of the bench: its groups of rows, its processes, and what they report.

Each task is a process of its own, because the number of threads is settled when the libraries are
loaded, and because memory that one measurement leaves behind would be the next one's. A process
writes what it finds as lines of JSON.
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
from tumortrack_lab.bench.rows import PRESETS, BenchResult, BenchRow

if TYPE_CHECKING:  # with PyTorch, whose threads are settled when it is imported
    from tumortrack_lab.bench.subject import BenchSubject

WORKER = [sys.executable, "-m", "tumortrack_lab.bench.run"]


class Group(NamedTuple):
    """Workloads measured together: module of this package and function that yields them; numbers
    of threads; how many there are, and for how long each is measured (about; in a hurry); presets
    whose models they need."""

    source: str
    threads: tuple[int, ...]
    rows: int
    seconds: float
    quick_s: float
    needs: tuple[str, ...] = ()


# Training comes last: it tells the C library to keep freed memory, which stays so.
GROUPS: dict[str, Group] = {
    "frame": Group("subject:frames", (1, 2), 8, 4.0, 1.4, PRESETS),
    "tracking": Group("subject:tracking", (1, 2), 6, 3.0, 0.7, PRESETS),
    "volume": Group("subject:volumes", (1, 2), 6, 6.0, 2.0, PRESETS),
    "command": Group("command:workloads", (2,), 12, 4.2, 1.0, PRESETS),
    "patient": Group("command:patient", (2,), 1, 40.0, 20.0),
    "planning": Group("planning:workloads", (1,), 3, 3.0, 0.7),
    "training": Group("training:whole", (2,), 1, 20.0, 12.0),
    "gpu": Group("training:on_gpu", (2,), 9, 10.0, 3.4, ("paper",)),
}


class Task(Config, frozen=True):
    """What one process does, part by part: describe the ``machine``, ``make`` a preset's model,
    measure a ``group`` of rows. ``folder``: of models."""

    threads: int
    folder: str
    quick: bool = False
    parts: tuple[tuple[str, ...], ...] = ()

    def budget_s(self, group: str) -> float:
        return GROUPS[group].quick_s if self.quick else GROUPS[group].seconds

    def expected_s(self, part: tuple[str, ...]) -> float:
        """On a machine of two cores, roughly."""
        if part[0] == "group":
            return 2 * GROUPS[part[1]].rows * self.budget_s(part[1])
        return {"machine": 0.0, "make": 40.0}[part[0]]


class TaskMessage(Config, frozen=True):
    """One line of a process: a result, what it begins with now (and how long that and all behind
    it are expected to take), or how far that is."""

    begins: str | None = None
    expected_s: tuple[float, float] = (0.0, 0.0)
    under_way: str | None = None
    machine: dict[str, str] | None = None
    row: BenchRow | None = None


def tasks_of(common: Task, groups: Sequence[str], cores: int) -> list[Task]:
    """What all have in common, as tasks: first the models, then one core, two threads."""
    needed = {preset for name in groups for preset in GROUPS[name].needs}
    work: list[tuple[int, list[tuple[str, ...]]]] = []
    if needed:
        work.append((min(cores, 2), [("make", preset) for preset in sorted(needed)]))
    for threads in (1, 2):
        mine: list[tuple[str, ...]] = [
            ("group", name) for name in groups if threads in GROUPS[name].threads
        ]
        if mine and threads <= cores:
            work.append((threads, mine))
    work[0][1].insert(0, ("machine",))
    return [
        msgspec.structs.replace(common, threads=threads, parts=tuple(parts))
        for threads, parts in work
    ]


class _Pace:
    """How long all will still take, by what the parts that are done took beside what was expected
    of them."""

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
    """Run all processes one after another. ``report`` is called with what is under way and about
    how long all will still take, ``show`` with each row once it is measured, and that time. Raises
    TumortrackError: one of them failed."""
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
            if message.under_way is not None:
                report(message.under_way)
            if message.begins is not None:
                part_s, later_s = message.expected_s
                pace.begin_part(part_s, later_s + sum(expected_s[number:]))
                report(f"{message.begins}; {pace.left}")
    return BenchResult(machine=machine, command=command, rows=tuple(rows))


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


def carry_out(task: Task, subject: BenchSubject, tell: Callable[[TaskMessage], None]) -> None:
    """Tell everything that a task asks for, as it becomes known."""
    from tumortrack_lab.bench.machine import describe_machine

    threads = {1: "one core"}.get(task.threads, f"{task.threads} threads")
    words = {
        "make": "making a model of `{}` to measure",
        "group": f"{{}}, {threads}",
    }

    def under_way(done: int, of: int) -> None:
        tell(TaskMessage(under_way=f"  step {done} of {of}"))

    for number, (kind, *of) in enumerate(task.parts):
        if kind == "machine":
            tell(TaskMessage(machine=describe_machine()))
            continue
        if kind == "make" and subject.has(*of):
            continue
        part_s, *later_s = map(task.expected_s, task.parts[number:])
        tell(TaskMessage(begins=words[kind].format(*of), expected_s=(part_s, sum(later_s))))
        if kind == "make":
            subject.make(of[0], under_way)
            continue
        workloads = resolve_name(f"tumortrack_lab.bench.{GROUPS[of[0]].source}")
        for workload in workloads(subject, task.budget_s(*of)):
            for row in workload.rows(task.threads, task.budget_s(*of)):
                tell(TaskMessage(row=row))


def _work(task_json: str) -> None:
    """A process of the bench: carries one task out and writes each result as a line of JSON."""
    task = from_builtins(msgspec.json.decode(task_json), Task, "the bench's task")
    if hasattr(os, "sched_setaffinity"):  # Linux alone has it; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: task.threads])
    from tumortrack_lab.bench.subject import BenchSubject

    def tell(message: TaskMessage) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    carry_out(task, BenchSubject(Path(task.folder)), tell)


if __name__ == "__main__":
    try:
        _work(sys.argv[1])
    except TumortrackError as error:
        sys.exit(str(error))  # one line on the standard error, for the process that asked
