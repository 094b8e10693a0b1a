"""A whole run of the bench: its groups of rows, its processes, and what they report.

Each task is a process of its own, because the number of threads is settled when the libraries are
loaded, and because memory that one measurement leaves behind would be the next one's. A process
writes what it finds as lines of JSON.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pkgutil import resolve_name
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.rows import PRESETS, BenchResult, BenchRow, Peaks, Point

if TYPE_CHECKING:  # with PyTorch, whose threads are settled when it is imported
    from tumortrack_lab.bench.subject import BenchSubject

_TRAINING_S, _PEAKS_S, _CURVE_S = 60.0, 5.0, 20.0  # on a machine of two cores, roughly


class Group(NamedTuple):
    """Workloads measured together: module of this package and function that yields them; numbers
    of threads; how many rows there are, and for how long each is measured (about; in a hurry);
    presets whose trained models they need."""

    source: str
    threads: tuple[int, ...]
    rows: int
    seconds: float
    quick_s: float
    needs: tuple[str, ...] = ()


# Training comes last: it tells the C library to keep freed memory, which stays so.
GROUPS: dict[str, Group] = {
    "generator": Group("training:drags", (1,), 1, 3.0, 0.7),
    "elastic-generator": Group("training:elastic", (1,), 1, 3.0, 0.7, ("clinic",)),
    "encoder": Group("networks:encoders", (1,), 3, 1.4, 0.5, PRESETS),
    "decoder": Group("networks:decoders", (1,), 8, 1.5, 0.5, PRESETS),
    "frame": Group("networks:frames", (1, 2), 3, 4.0, 1.4, PRESETS),
    "tracking": Group("networks:tracking", (1, 2), 3, 3.0, 0.7, PRESETS),
    "volume": Group("networks:volumes", (1, 2), 3, 6.0, 2.0, PRESETS),
    "command": Group("command:workloads", (2,), 6, 4.2, 1.0, PRESETS),
    "planning": Group("planning:workloads", (1,), 3, 3.0, 0.7),
    "training": Group("training:steps", (1,), 3, 5.0, 1.0, ("clinic",)),
    "whole-training": Group("training:whole", (2,), 1, 20.0, 12.0),
    "gpu": Group("training:on_gpu", (2,), 6, 10.0, 3.4, PRESETS),
}
# Curves, and of which presets: each in a process of its own, whose memory so is its own.
CURVES = {
    **dict.fromkeys(("queries", "points"), PRESETS),
    "tumors": ("clinic",),
    **dict.fromkeys(("grid", "batch"), PRESETS),
}


class Task(Config, frozen=True):
    """What one process does: describe the machine, train these presets, measure the machine's
    peaks, these groups of rows, this curve, in that order. ``folder``: of trained models;
    ``given``: a user's own model and cloud, which are then measured instead."""

    threads: int
    folder: str
    given: tuple[str, str] | None = None
    describe: bool = False
    train: tuple[str, ...] = ()
    peaks: bool = False
    groups: tuple[str, ...] = ()
    curve: tuple[str, str] | None = None  # which, and of which preset
    quick: bool = False

    def budget_s(self, group: str) -> float:
        return GROUPS[group].quick_s if self.quick else GROUPS[group].seconds

    def expected_s(self) -> list[float]:
        """Of each thing that it begins with, roughly."""
        groups = [(GROUPS[name], self.budget_s(name)) for name in self.groups]
        return [
            *(_TRAINING_S for _ in self.train),
            *([_PEAKS_S] if self.peaks else []),
            *(2 * group.rows * budget_s * max(1, len(group.needs)) for group, budget_s in groups),
            *([_CURVE_S] if self.curve is not None else []),
        ]


class TaskMessage(Config, frozen=True):
    """One line of a process: a result, what it begins with now, or how far that is."""

    begins: str | None = None
    under_way: str | None = None
    machine: dict[str, str] | None = None
    peaks: Peaks | None = None
    row: BenchRow | None = None
    point: Point | None = None


def tasks_of(common: Task, groups: Sequence[str], curves: Sequence[str], cores: int) -> list[Task]:
    """What all have in common, as tasks: first the trainings with all cores, then one core, two
    threads, the curves."""

    def task(threads: int, **what: object) -> Task:
        return msgspec.structs.replace(common, threads=threads, **what)

    needed = {preset for name in groups for preset in GROUPS[name].needs}
    needed |= set(PRESETS if curves else ())
    train = () if common.given is not None else tuple(sorted(needed))
    tasks = [task(min(cores, 2), train=train)] if train else []
    for threads in (1, 2):
        mine = tuple(name for name in groups if threads in GROUPS[name].threads)
        if mine and threads <= cores:
            tasks.append(task(threads, peaks=True, groups=mine))
    tasks += [task(1, curve=(curve, of)) for curve in curves for of in CURVES[curve]]
    return [msgspec.structs.replace(tasks[0], describe=True), *tasks[1:]]


class _Pace:
    """How long all will still take, by what the parts that are done took beside what was expected
    of them."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._ahead = [task.expected_s() for task in tasks]
        self._past_s = self._part_s = 0.0
        self._begun_s = self._part_begun_s = time.monotonic()

    def begin_part(self) -> None:
        self._past_s += self._part_s
        self._part_s = self._ahead[0].pop(0) if self._ahead[0] else 0.0
        self._part_begun_s = time.monotonic()

    def end_task(self) -> None:
        """What is left of it was not needed: models that were there already."""
        self._past_s += self._part_s + sum(self._ahead.pop(0))
        self._part_s = 0.0

    @property
    def left(self) -> str:
        pace = (self._part_begun_s - self._begun_s) / self._past_s if self._past_s else 1.0
        part_s = pace * self._part_s - (time.monotonic() - self._part_begun_s)
        seconds = pace * sum(map(sum, self._ahead)) + max(part_s, 0.0)
        return (
            f"about {seconds:.0f} s left"
            if seconds < 100
            else f"about {seconds / 60:.0f} minutes left"
        )


def measure(
    tasks: Sequence[Task],
    worker: Sequence[str],
    command: str,
    report: Callable[[str], None],
    show: Callable[[BenchRow, str], None],
) -> BenchResult:
    """Run all processes one after another. ``report`` is called with what is under way and about
    how long all will still take, ``show`` with each row once it is measured, and that time. Raises
    TumortrackError: one of them failed."""
    machine: dict[str, str] = {}
    found: dict[str, list] = {"peaks": [], "row": [], "point": []}
    pace = _Pace(tasks)
    for task in tasks:
        for message in listen(worker, task):
            machine = message.machine or machine
            for kind, results in found.items():
                if (result := getattr(message, kind)) is not None:
                    results.append(result)
            if message.row is not None:
                show(message.row, pace.left)
            if message.under_way is not None:
                report(message.under_way)
            if message.begins is not None:
                pace.begin_part()
                report(f"{message.begins}; {pace.left}")
        pace.end_task()
    peaks, rows, points = map(tuple, found.values())
    return BenchResult(machine=machine, command=command, peaks=peaks, rows=rows, points=points)


def carry_out(
    task: Task, subject: BenchSubject, tell: Callable[[TaskMessage], None]
) -> Iterator[TaskMessage]:
    """Everything that a task asks for, as it becomes known; ``tell``: how far trainings are."""
    from tumortrack_lab.bench.curves import points_of
    from tumortrack_lab.bench.machine import describe_machine, measure_peaks

    threads = "one core" if task.threads == 1 else f"{task.threads} threads"
    if task.describe:
        yield TaskMessage(machine=describe_machine())
    for preset in task.train:
        if not subject.trained(preset):
            yield TaskMessage(begins=f"training a `{preset}` network to measure")
            subject.train(
                preset, lambda now: tell(TaskMessage(under_way=f"  step {now.step} of {now.end}"))
            )
    if task.peaks:
        yield TaskMessage(begins=f"the machine's own rates, {threads}")
        yield TaskMessage(peaks=measure_peaks(task.threads, 1.0 if task.quick else 3.0))
    for name in task.groups:
        yield TaskMessage(begins=f"{name}, {threads}")
        workloads = resolve_name(f"{__package__}.{GROUPS[name].source}")
        for workload in workloads(subject, task.budget_s(name)):
            for row in workload.rows(task.threads, task.budget_s(name)):
                yield TaskMessage(row=row)
    if task.curve is not None:
        yield TaskMessage(begins=f"growth with {task.curve[0]}, {task.curve[1]}")
        for point in points_of(subject, *task.curve):
            yield TaskMessage(point=point)


def listen(command: Sequence[str], task: Task) -> Iterator[TaskMessage]:
    """Run a task in a process: ``command`` with the task's JSON behind it. Raises TumortrackError:
    it failed, the message says its last words."""
    threads = str(task.threads)
    limits = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), threads)
    command = [*command, msgspec.json.encode(task).decode()]
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
