"""Jobs -> cells: each measured once, in an order that loads every method once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.types import Anatomy
from tumortrack.report.protocol import evaluate_scene
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack_lab.study.cells import MeasurementSpec, MeasurementStore, provenance
from tumortrack_lab.study.methods import Answer, Method
from tumortrack_lab.study.points import point_errors, visible_points

CLEAN_VIEW = "clean"


@dataclass(frozen=True, eq=False)
class StudyCase:
    """A patient or phantom with its scenes; ``is_paper`` where the paper's figures apply."""

    name: str
    folder: Path
    scenes: Path
    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    is_paper: bool = False

    def scene(self, variant: str, view: str) -> Path:
        return self.scenes / f"{variant}-{view}"


@dataclass(frozen=True, eq=False)
class Job:
    """One cell to be: which method on which scene, at which grid, under which fault."""

    case: StudyCase
    method: Method
    variant: str
    view: str
    grid: int
    fault: str = "none"
    fault_seed: int = 0


@dataclass(frozen=True)
class StudyStatus:
    """Where the measuring stands, told after each cell measured."""

    done: int
    total: int
    measured: int
    name: str
    seconds_per_cell: float
    seconds_left: float


def measure(
    jobs: Iterable[Job],
    cells: MeasurementStore,
    report: Callable[[StudyStatus], None] | None = None,
    one: Callable[[Job, str], dict] | None = None,
) -> list[dict]:
    """The cells of these jobs in their order; only those that are not kept yet are measured,
    each by ``one`` (``measure_one``) from its job and its scene's name.

    Raises:
        InputError: a scene is missing or cannot be read.
        ArtifactError: a kept cell or a model is damaged.
        StorageError: the disk refused.
    """
    jobs = list(jobs)
    hashes = Hashes()
    specs = [spec_of(job, hashes) for job in jobs]
    kept = {spec.digest: cells.read(spec) for spec in specs}
    todo = {d: (s, j) for s, j in zip(specs, jobs, strict=True) if kept[d := s.digest] is None}
    pace = _Pace([_kind_of(spec) for spec, _ in todo.values()])
    for number, (digest, (spec, job)) in enumerate(todo.items(), start=1):
        start = time.perf_counter()
        kept[digest] = cells.write(spec, (one or measure_one)(job, spec.scene))
        pace.add(_kind_of(spec), time.perf_counter() - start)
        if report:
            done = len(kept) - len(todo) + number
            name = f"{spec.case} {spec.method['name']} {spec.scene} {spec.fault}"
            name = name.removesuffix(" none")
            report(StudyStatus(done, len(kept), number, name, pace.mean(), pace.left()))
    found = [kept[spec.digest] for spec in specs]
    return [cell for cell in found if cell is not None]


def spec_of(job: Job, hashes: Hashes) -> MeasurementSpec:
    """The job's full specification, inputs hashed."""
    folder = job.case.scene(job.variant, job.view)
    if not folder.is_dir():
        raise InputError(
            f"{folder} does not exist; make the scenes with: tumortrack twin "
            f"{job.case.folder} {job.case.scenes}"
        )
    return MeasurementSpec(
        case=job.case.name,
        case_sha256=hashes.of(job.case.folder / store.MANIFEST),
        scene=folder.name,
        scene_sha256=hashes.of(folder),
        variant=job.variant,
        view=job.view,
        method=job.method.identity,
        grid=job.grid,
        fault=job.fault,
        fault_seed=job.fault_seed,
    )


def measure_one(job: Job, name: str) -> dict:
    """One cell's numbers: the protocol's metrics, errors at points, target errors, times."""
    scene = read_scene(job.case.scene(job.variant, job.view))
    if job.fault != "none":
        from tumortrack_lab.twin.faults import disturbed

        scene = disturbed(scene, job.fault, job.fault_seed)
    answers: list[Answer] = []

    def locate(_: object) -> Estimate:
        answers.append(job.method.locate(scene, job.grid))
        return answers[0].estimate

    entry, estimate = evaluate_scene(locate, scene, name)
    answer = answers[0] if answers else None
    return {
        "parts": entry["parts"],
        "miou": entry["miou"],
        "failed": entry["failed"],
        "frame_s": answer.frame_s if answer else None,
        "locate_s": entry.get("seconds"),
        "prepare_s": job.method.prepare_s,
        "points": _points(job, scene, estimate) if estimate else {},
        "targets_mm": entry.get("tre_mm"),
        "method": job.method.about,
        "provenance": provenance(job.method.device),
    }


def _points(job: Job, scene: Scene, estimate: Estimate) -> dict:
    from tumortrack_lab.twin.faults import MOVED

    clean = job.case.scene(job.variant, CLEAN_VIEW)
    seen = scene if MOVED in scene.meta or not clean.is_dir() else read_scene(clean)
    return point_errors(scene.reference, job.case.anatomy_ct, visible_points(seen), estimate.meshes)


class Hashes:
    """sha256 of files and folders, each computed once."""

    def __init__(self) -> None:
        self._known: dict[Path, str] = {}

    def of(self, path: Path) -> str:
        if path not in self._known:
            self._known[path] = store.sha256_of(path)
        return self._known[path]


def _kind_of(spec: MeasurementSpec) -> str:
    return f"{spec.case} {spec.method['name']} {spec.grid}"


class _Pace:
    """Mean seconds per kind of cell, and what is left by them."""

    def __init__(self, kinds: list[str]) -> None:
        self._left = kinds
        self._seconds: dict[str, list[float]] = {}

    def add(self, kind: str, seconds: float) -> None:
        self._left.remove(kind)
        self._seconds.setdefault(kind, []).append(seconds)

    def mean(self) -> float:
        return float(np.mean([s for kind in self._seconds.values() for s in kind]))

    def left(self) -> float:
        """Seconds; a kind that was not measured yet counts with the mean of all."""
        means = {kind: float(np.mean(s)) for kind, s in self._seconds.items()}
        return float(sum(means.get(kind, self.mean()) for kind in self._left))


def by_method(jobs: Iterable[Job]) -> list[Job]:
    """Jobs sorted so that each method's follow one another (a model is loaded once)."""
    groups: dict[int, list[Job]] = {}
    for job in jobs:
        groups.setdefault(id(job.method), []).append(job)
    return [job for group in groups.values() for job in group]
