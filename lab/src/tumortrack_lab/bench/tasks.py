"""A process's share of the bench: so many threads, some groups of rows; its results as JSON lines.

Processes of their own, because the number of threads is settled when the libraries are loaded, and
because memory that one measurement leaves behind would be the next one's.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack_lab.bench.row import BenchRow, Peaks, Point
from tumortrack_lab.bench.subject import ConfigOf, Given, Subject

if TYPE_CHECKING:
    from tumortrack.training.train import TrainingStatus


class Task(Config, frozen=True):
    """What one process does: describe the machine, train these presets, measure the machine's
    peaks, these groups of rows, this curve, in that order. ``folder``: of trained models;
    ``model`` and ``cloud``: a user's own."""

    threads: int
    folder: str
    model: str | None = None
    cloud: str | None = None
    describe: bool = False
    train: tuple[str, ...] = ()
    peaks: bool = False
    groups: tuple[str, ...] = ()
    curve: tuple[str, str] | None = None  # which, and of which preset
    quick: bool = False


class TaskMessage(Config, frozen=True):
    """One line of a process: a result, what it begins with now, or how far that is."""

    begins: str | None = None
    under_way: str | None = None
    machine: dict[str, str] | None = None
    peaks: Peaks | None = None
    row: BenchRow | None = None
    point: Point | None = None


def subject_of(task: Task, presets: Mapping[str, ConfigOf]) -> Subject:
    """What a task measures."""
    given = None
    if task.model is not None and task.cloud is not None:
        given = Given(Path(task.model), Path(task.cloud))
    return Subject(presets, Path(task.folder), given)


def carry_out(
    task: Task, subject: Subject, tell: Callable[[TaskMessage], None] = lambda _: None
) -> Iterator[TaskMessage]:
    """Everything that a task asks for, as it becomes known; ``tell``: how far trainings are."""

    def under_way(status: TrainingStatus) -> None:
        tell(TaskMessage(under_way=f"  step {status.step} of {status.end}"))

    if task.describe:
        from tumortrack_lab.bench.machine import describe_machine

        yield TaskMessage(machine=describe_machine())
    for preset in task.train:
        if not subject.trained(preset):
            yield TaskMessage(begins=f"training a `{preset}` network to measure")
            subject.train(preset, under_way)
    if task.peaks:
        from tumortrack_lab.bench.peaks import measure_peaks

        yield TaskMessage(begins=f"the machine's own rates, {_threads(task)}")
        yield TaskMessage(peaks=measure_peaks(task.threads, 1.0 if task.quick else 3.0))
    if task.groups:
        from tumortrack_lab.bench.suite import GROUPS

        for name in task.groups:
            group = GROUPS[name]
            yield TaskMessage(begins=f"{name}, {_threads(task)}")
            for row in group.rows(subject, task.threads, group.budget_s(task.quick)):
                yield TaskMessage(row=row)
    if task.curve is not None:
        from tumortrack_lab.bench.curves import points

        yield TaskMessage(begins=f"growth with {task.curve[0]}, {task.curve[1]}")
        for point in points(subject, *task.curve):
            yield TaskMessage(point=point)


def listen(command: Sequence[str], task: Task) -> Iterator[TaskMessage]:
    """Run a task in a process: ``command`` with the task's JSON behind it.

    Raises:
        TumortrackError: it failed; its last words are told.
    """
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
                    yield from_builtins(
                        msgspec.json.decode(line), TaskMessage, "a process of the bench"
                    )
        except BaseException:  # whoever listens has gone, or was interrupted
            process.kill()
            raise
        finally:
            code = process.wait()
        words.seek(0)
        last = words.read().strip().splitlines()[-1:] or ["nothing was said"]
    if code != 0:
        raise TumortrackError(f"measuring failed: {last[0]}")


def keep_to_cores(count: int) -> None:
    """Confine this process to so many of the cores that it may use; before its libraries start
    threads."""
    if hasattr(os, "sched_setaffinity"):  # Linux alone has it
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def _threads(task: Task) -> str:
    return "one core" if task.threads == 1 else f"{task.threads} threads"
