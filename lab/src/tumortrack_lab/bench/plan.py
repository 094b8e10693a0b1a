"""The whole bench: which processes, in which order, and what they found."""

from __future__ import annotations

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
    wish: Wish, worker: Sequence[str], command: str, tell: Callable[[str], None]
) -> BenchResult:
    """Run all processes one after another; ``tell`` hears what is under way.

    Raises:
        TumortrackError: one of them failed.
    """
    machine: dict[str, str] = {}
    peaks: list[Peaks] = []
    rows: list[BenchRow] = []
    points: list[Point] = []
    for task in tasks_of(wish, available_cores()):
        for said in listen(worker, task):
            _sort(said, peaks, rows, points)
            machine = said.machine or machine
            if said.begins is not None:
                tell(said.begins)
    return BenchResult(
        machine=machine, command=command, peaks=tuple(peaks), rows=tuple(rows), points=tuple(points)
    )


def _sort(said: TaskMessage, peaks: list[Peaks], rows: list[BenchRow], points: list[Point]) -> None:
    if said.peaks is not None:
        peaks.append(said.peaks)
    if said.row is not None:
        rows.append(said.row)
    if said.point is not None:
        points.append(said.point)
