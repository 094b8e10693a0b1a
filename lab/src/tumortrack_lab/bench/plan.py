"""The whole bench: which processes, in which order, and what they found."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from tumortrack.core.process import available_cores
from tumortrack_lab.bench.row import BenchResult, BenchRow, Peaks, Point
from tumortrack_lab.bench.subject import PRESETS
from tumortrack_lab.bench.suite import ALL, GROUPS
from tumortrack_lab.bench.tasks import Task, TaskMessage, listen

# Curves, and of which presets: each in a process of its own, whose memory so is its own.
CURVES = {
    "queries": PRESETS,
    "points": PRESETS,
    "tumors": ("clinic",),
    "grid": PRESETS,
    "batch": PRESETS,
}


_TRAINING_S, _PEAKS_S, _CURVE_S = 60.0, 5.0, 20.0  # see ``_expected_s``


@dataclass(frozen=True)
class Wish:
    """What to measure: groups of rows and curves by name; ``folder``: of trained models; ``model``
    and ``cloud``: a user's own, which are then measured instead."""

    groups: tuple[str, ...]
    curves: tuple[str, ...]
    quick: bool
    folder: Path
    model: Path | None = None
    cloud: Path | None = None


def tasks_of(wish: Wish, cores: int) -> list[Task]:
    """First the trainings with all cores, then one core, two threads, the curves."""

    def task(threads: int, **what: object) -> Task:
        model, cloud = (None if p is None else str(p) for p in (wish.model, wish.cloud))
        given = {"folder": str(wish.folder), "model": model, "cloud": cloud, "quick": wish.quick}
        return Task(threads=threads, **given, **what)  # type: ignore[arg-type]

    groups = {name: GROUPS[name] for name in wish.groups}
    needed = {preset for group in groups.values() for preset in group.needs}
    if wish.curves:
        needed |= set(ALL)
    train = () if wish.model is not None else tuple(sorted(needed))
    tasks = [task(min(cores, 2), train=train)] if train else []
    for threads in (1, 2):
        mine = tuple(name for name, group in groups.items() if threads in group.threads)
        if mine and threads <= cores:
            tasks.append(task(threads, peaks=True, groups=mine))
    tasks += [task(1, curve=(curve, of)) for curve in wish.curves for of in CURVES[curve]]
    return [msgspec.structs.replace(tasks[0], describe=True), *tasks[1:]]


def measure(
    wish: Wish,
    worker: Sequence[str],
    command: str,
    tell: Callable[[str], None],
    show: Callable[[BenchRow], None],
) -> BenchResult:
    """Run all processes one after another; ``tell`` hears what is under way and about how long all
    will still take, ``show`` gets each row once it is measured.

    Raises:
        TumortrackError: one of them failed.
    """
    machine: dict[str, str] = {}
    peaks: list[Peaks] = []
    rows: list[BenchRow] = []
    points: list[Point] = []
    tasks = tasks_of(wish, available_cores())
    left_s, past_s, begun_s = sum(sum(_expected_s(task)) for task in tasks), 0.0, time.monotonic()
    for task in tasks:
        expected = _expected_s(task)
        ahead_s = left_s - sum(expected)  # what later tasks take
        for said in listen(worker, task):
            _sort(said, peaks, rows, points)
            machine = said.machine or machine
            if said.row is not None:
                show(said.row)
            if said.under_way is not None:
                tell(said.under_way)
            if said.begins is not None:
                pace = (time.monotonic() - begun_s) / past_s if past_s else 1.0
                tell(f"{said.begins}; about {_minutes(pace * left_s)} left")
                part_s = expected.pop(0) if expected else 0.0
                left_s, past_s = left_s - part_s, past_s + part_s
        past_s, left_s = past_s + sum(expected), ahead_s  # models that were there already
    return BenchResult(
        machine=machine, command=command, peaks=tuple(peaks), rows=tuple(rows), points=tuple(points)
    )


def _expected_s(task: Task) -> list[float]:
    """Of each thing that a task begins with, roughly, on a machine of two cores."""
    groups = [GROUPS[name] for name in task.groups]
    return [
        *(_TRAINING_S for _ in task.train),
        *([_PEAKS_S] if task.peaks else []),
        *(2 * group.budget_s(task.quick) * max(1, len(group.needs)) for group in groups),
        *([_CURVE_S] if task.curve is not None else []),
    ]


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"


def _sort(said: TaskMessage, peaks: list[Peaks], rows: list[BenchRow], points: list[Point]) -> None:
    if said.peaks is not None:
        peaks.append(said.peaks)
    if said.row is not None:
        rows.append(said.row)
    if said.point is not None:
        points.append(said.point)
