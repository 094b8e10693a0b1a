"""How fast the default method, the commands and the planner are on this machine.

The number of threads is fixed when libraries are loaded, so there is a process for each number; it
prints its rows as lines of JSON. The subject is the built-in phantom and a scene of it; its model
is kept in a folder.
"""

from __future__ import annotations

import json
import math
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from importlib.metadata import version
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from tumortrack.case.surface import surfaces
from tumortrack.cli.console import progress_bar, say
from tumortrack.core.cloud import thin_cloud
from tumortrack.core.errors import ArtifactError, TumortrackError
from tumortrack.core.estimate import FollowOptions
from tumortrack.core.geometry import rigid
from tumortrack.core.process import available_cores
from tumortrack.core.raster import label_grid
from tumortrack.core.types import Anatomy, SensorCloud
from tumortrack.io.model_folder import save_model
from tumortrack.io.nifti import write_nifti
from tumortrack.io.ply import write_cloud_ply
from tumortrack.registration.config import elastic
from tumortrack.registration.frame import grid_over
from tumortrack.registration.model import RegistrationModel, build_model
from tumortrack.registration.multi_view import MultiViewCloud
from tumortrack.simulation.deform import DragConfig
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.simulation.scene import SceneConfig, SceneRecipe, Simulator
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks.document import cpu_name
from tumortrack_benchmarks.physics.organ import transformed

WORKER = [sys.executable, "-m", "tumortrack_benchmarks.bench"]
METHOD = "elastic"
_FEWEST, _MOST = 3, 25  # turns
_LEAST_S = 0.01  # of a turn: shorter calls are repeated within it
_LONG_S = 0.5  # a first call that takes longer is warm enough, and a turn
_UP, _SEED = (0.0, -1.0, 0.0), 0
_NO_VOLUME, _GRID = 8, 400  # voxels along the volume's longest side
_GOALS_S = {  # on two threads, if the part has these; frame: the paper has 14 ms on an RTX 4090
    "frame": 0.014, "tracking frame": 0.005, "400^3 labels": 0.3, "locate command": 3.0,
    "labels to first estimate": 15.0,
}  # fmt: skip
_PROBE = """
import json, resource, subprocess, sys, time
start = time.monotonic()
code = subprocess.run([sys.executable, "-m", "tumortrack", *sys.argv[2:]]).returncode
seconds, peak = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
open(sys.argv[1], "w").write(json.dumps([seconds, 1024 * peak]))
sys.exit(code)
"""


class Group(NamedTuple):
    """Workloads measured together: what yields them; numbers of threads; for how long each is
    measured (about; with --quick)."""

    source: Callable[[BenchSubject], Iterator[Workload]]
    threads: tuple[int, ...]
    seconds: float
    quick_s: float


@dataclass(frozen=True, eq=False)
class Workload:
    """What becomes a row: ``item`` is what a call makes, such as a frame. A call may return seconds
    that do not count; ``note`` is asked for once it is timed."""

    name: str
    what: str
    item: str
    call: Callable[[], object]
    note: Callable[[], str] = str

    def row(self, threads: int, budget_s: float) -> Row:
        """Time it."""
        low, middle, high = np.quantile(timed(self.call, budget_s), (0.25, 0.5, 0.75)).tolist()
        spread = (high - low) / 2 / middle
        return Row(self.name, self.what, threads, self.item, middle, spread, self.note())


@dataclass(frozen=True)
class Row:
    """Median seconds of a call, and half of the quartiles' distance over it."""

    part: str
    of: str
    threads: int
    item: str
    seconds: float
    spread: float
    note: str = ""

    @property
    def time(self) -> str:
        """In the largest unit that they reach, with three digits: 12.3 ms a frame."""
        unit, size = next(
            ((u, s) for u, s in (("s", 1.0), ("ms", 1e-3)) if self.seconds >= s), ("µs", 1e-6)
        )
        return f"{self.seconds / size:.3g} {unit} a {self.item}"


def timed(call: Callable[[], object], budget_s: float) -> list[float]:
    """Seconds of a call in several turns. It is called before (compiled, cached, warm), then until
    the budget is spent, between 3 and 25 times. A long first call counts as a turn: a median of
    three bears a cold one."""
    begun = time.perf_counter()
    took_s, counted_s = _turn(call, 1)
    if long := took_s > _LONG_S:
        seconds = [counted_s]
    else:
        took_s, seconds = _turn(call, 1)[0], []
    repeat = 1 if long else max(1, math.ceil(_LEAST_S / max(took_s, 1e-7)))
    for done in range(_MOST):
        past_s = time.perf_counter() - begun
        if len(seconds) >= _FEWEST and past_s * (done + 1) / max(done, 1) > budget_s:
            break
        seconds.append(_turn(call, repeat)[1] / repeat)
    return seconds


def _turn(call: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Seconds of so many calls: in all, and those that count."""
    start, uncounted = time.perf_counter(), 0.0
    for _ in range(repeat):
        result = call()
        uncounted += result if isinstance(result, float) else 0.0
    took_s = time.perf_counter() - start
    return took_s, took_s - uncounted


@dataclass(eq=False)
class BenchSubject:
    """``folder``: where the model is kept."""

    folder: Path

    @cached_property
    def anatomy(self) -> Anatomy:
        """CT frame."""
        return surfaces(phantom_labels(PhantomParameters(), voxel_mm=1.5))[0]

    @cached_property
    def cloud(self) -> SensorCloud:
        """1,000 points of a view of the phantom, dragged, without sensor noise."""
        config = SceneConfig(deform=(DragConfig(),))
        scene = Simulator(self.anatomy, _UP, config).render(SceneRecipe(_SEED, "test", 0))
        return thin_cloud(scene.cloud, 1000, np.random.default_rng(_SEED))

    @cached_property
    def model(self) -> RegistrationModel:
        """It is made if there is no whole one of this version."""
        try:
            model = load_model(self.folder / METHOD, device="cpu")
        except ArtifactError:
            say("making a model to measure")
            model = build_model(self.anatomy, _UP, elastic(self.anatomy), _SEED)
            shutil.rmtree(self.folder / METHOD, ignore_errors=True)
            (self.folder / METHOD).mkdir(parents=True)
            save_model(model, self.folder / METHOD)
        assert isinstance(model, RegistrationModel)
        return model


def _frames(subject: BenchSubject) -> Iterator[Workload]:
    """A first view: the search alone, with its refinement, and all that `locate` does."""
    registration, views = (
        subject.model.registration,
        MultiViewCloud.from_points([subject.cloud.points_mm]),
    )
    search = partial(registration.search.starts, views)
    yield Workload("search", METHOD, "look", search)
    yield Workload("search and refinement", METHOD, "look", partial(registration.register, views))
    tracker = Tracker(subject.model)

    def locate() -> float:
        return tracker.locate(subject.cloud, grid=_NO_VOLUME).report.timings["volume"]

    note = "locate without its volume: labels, probabilities, surfaces, report"
    yield Workload("frame", METHOD, "frame", locate, lambda: note)


def _tracking(subject: BenchSubject) -> Iterator[Workload]:
    """From frame to frame: a cloud that moves to and fro by half a millimetre."""
    tracker, points_mm = Tracker(subject.model), subject.cloud.points_mm
    swing = np.array([0.25, 0.0, 0.0], np.float32)
    clouds = cycle([SensorCloud(points_mm + swing), SensorCloud(points_mm - swing)])
    last = tracker.follow(next(clouds), None, FollowOptions())

    def follow() -> None:
        nonlocal last
        last = tracker.follow(next(clouds), last, FollowOptions())

    def note() -> str:
        motion = last.report.motion
        return f"steady state: {motion.steps if motion else 0} refinement steps, surfaces, report"

    yield Workload("tracking frame", METHOD, "frame", follow, note)


def _volumes(subject: BenchSubject) -> Iterator[Workload]:
    """From an estimate's surfaces to a label in every voxel."""
    estimate = Tracker(subject.model).locate(subject.cloud, grid=_NO_VOLUME)
    anatomy = Anatomy(tuple(estimate.meshes.values()))
    grid = grid_over(anatomy.organ.vertices_mm, _GRID)
    fill = partial(label_grid, anatomy, *grid)
    voxels = f"{int(np.prod(grid[1])):,} voxels"
    yield Workload("400^3 labels", METHOD, "volume", fill, lambda: voxels)


def _command(subject: BenchSubject) -> Iterator[Workload]:
    """`locate` in a process of its own, from its start to its end, all files written."""
    assert subject.model
    with tempfile.TemporaryDirectory() as folder:
        cloud, out = Path(folder) / "cloud.ply", Path(folder) / "out"
        write_cloud_ply(cloud, subject.cloud.points_mm)
        words = (
            "locate",
            subject.folder / METHOD,
            cloud,
            "--out",
            out,
            "--overwrite",
            "--device",
            "cpu",
        )
        for name, grid in {"locate command": 160, "locate --grid 400 command": _GRID}.items():
            peaks: list[int] = []
            call = partial(_kept_peak, peaks, *words, "--grid", grid)
            note = partial(lambda peaks: f"{max(peaks) / 2**30:.2f} GiB at most", peaks)
            yield Workload(name, METHOD, "run", call, note)


def _kept_peak(peaks: list[int], *words: object) -> None:
    peaks.append(run_command(*words)[1])


def _patient(subject: BenchSubject) -> Iterator[Workload]:
    """A new patient's labels to the first estimate: `prepare` and `locate`, a process each."""
    with tempfile.TemporaryDirectory() as folder:
        labels, cloud = Path(folder) / "labels.nii.gz", Path(folder) / "cloud.ply"
        phantom = phantom_labels(PhantomParameters(), voxel_mm=1.0)
        write_nifti(labels, phantom.labels, phantom.lps_from_index, lps=True)
        write_cloud_ply(cloud, subject.cloud.points_mm)
        runs: list[list[float]] = []

        def call() -> None:
            case, out = (Path(folder) / f"{name}-{len(runs)}" for name in ("case", "out"))
            steps = ("prepare", labels, "--out", case), ("locate", case, cloud, "--out", out)
            runs.append([run_command(*step)[0] for step in steps])

        def note() -> str:
            prepare_s, locate_s = np.median(runs, axis=0)
            return f"prepare {prepare_s:.1f} s, locate {locate_s:.1f} s"

        yield Workload("labels to first estimate", METHOD, "patient", call, note)


def run_command(*words: object) -> tuple[float, int]:
    """Run `tumortrack` with these arguments in a process of its own: seconds, and peak memory in
    bytes. Raises TumortrackError: the command failed; the message quotes its last line."""
    with tempfile.NamedTemporaryFile("r") as report:
        command = [sys.executable, "-c", _PROBE, report.name, *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode not in (0, 4):  # 4: the estimate is poor
            said = done.stderr.strip().splitlines()[-1:] or ["nothing was said"]
            raise TumortrackError(f"`tumortrack {' '.join(map(str, words))}` failed: {said[0]}")
        seconds, peak = json.load(report)
    return seconds, peak


def _planning(subject: BenchSubject) -> Iterator[Workload]:
    """Both planners, on 40,000 points; motions where the arms' libraries are installed."""
    from tumortrack_resection.drafts import plan_resection
    from tumortrack_resection.located import STAND_MM
    from tumortrack_resection.values import Located, ResectionConfig

    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # of LPS: the front up
    organ = subject.anatomy.organ.vertices_mm @ turn.T
    x, y, _ = -(organ.min(0) + organ.max(0)) / 2
    placed = transformed(
        subject.anatomy, rigid(turn, np.array([x, y, STAND_MM - organ[:, 2].min()]))
    )
    low, rng = placed.organ.box_mm[0] - 2, np.random.default_rng(0)
    i, j, k = (int(n) for n in np.ceil(np.ptp(placed.organ.box_mm, axis=0) + 4))
    grid = label_grid(placed, rigid(np.eye(3), low), (i, j, k))
    cells = np.argwhere(grid > 0)
    chosen = cells[rng.integers(len(cells), size=40_000)]
    points = chosen + rng.uniform(-0.5, 0.5, chosen.shape) + low
    parts = dict(zip(placed.names, placed.parts, strict=True))
    located, ours = Located(points, grid[tuple(chosen.T)], parts), ResectionConfig()
    for name, config in (("published", ResectionConfig(method="published")), ("margin", ours)):
        yield Workload("plan", name, "plan", partial(plan_resection, located, config))
    if find_spec("pinocchio") is None:  # the extra `arms`
        return
    from tumortrack_resection.arms.body import cell_urdf
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.arms.procedure import plan_motions
    from tumortrack_resection.check import checked
    from tumortrack_resection.planning import below

    cell = below(located.organ, CellConfig())
    plan_both = partial(plan_motions, located, ours, cell)
    made, motions = plan_both()
    yield Workload("motions", "margin, the plan included", "plan", plan_both)
    check = partial(checked, made, motions, cell_urdf(cell), located)
    yield Workload("motions", "their check", "plan", check)


GROUPS = {
    "frame": Group(_frames, (1, 2), 4.0, 1.4),
    "tracking": Group(_tracking, (1, 2), 3.0, 0.7),
    "volume": Group(_volumes, (1, 2), 6.0, 2.0),
    "command": Group(_command, (2,), 4.2, 1.0),
    "patient": Group(_patient, (2,), 40.0, 20.0),
    "planning": Group(_planning, (1,), 3.0, 0.7),
}


def measure(groups: Sequence[str], folder: Path, quick: bool) -> list[Row]:
    """All rows, on one core, then on two threads where there are two cores, a process a group;
    shows each, and how long all others will take. Raises TumortrackError: a process failed."""
    cores, rows = (1, 2) if available_cores() > 1 else (1,), list[Row]()
    tasks = [(n, name) for n in cores for name in groups if n in GROUPS[name].threads]
    with progress_bar("groups", len(tasks)) as advance:
        for threads, name in tasks:
            for row in rows_of(threads, folder, quick, [name]):
                rows.append(row)
                say(f"  {row.part} {row.of}, threads {threads}: {row.time}")
            advance()
    return rows


def rows_of(threads: int, folder: Path, quick: bool, groups: Sequence[str]) -> list[Row]:
    """Measure in a process. Raises TumortrackError: it failed; the message quotes its last line."""
    limits = {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "MKL", "TUMORTRACK")}
    command = [*WORKER, str(threads), str(folder), "quick" * quick, *groups]
    environment = {**os.environ, **limits}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or ["nothing was said"]
        raise TumortrackError(f"measuring failed: {last[0]}")
    lines = done.stdout.splitlines()
    return [Row(**json.loads(line)) for line in lines if line.startswith("{")]


def carry_out(threads: int, folder: Path, quick: bool, groups: Sequence[str]) -> Iterator[Row]:
    """Measure, within the process."""
    if hasattr(os, "sched_setaffinity"):  # Linux only; before libraries start threads
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    subject = BenchSubject(folder)
    for group in (GROUPS[name] for name in groups):
        budget_s = group.quick_s if quick else group.seconds
        for workload in group.source(subject):
            yield workload.row(threads, budget_s)


def describe_machine() -> dict[str, str]:
    """In the order in which it is shown."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "processor": cpu_name(),
        "cores": f"{available_cores()}",
        "memory": f"{memory:.0f} GiB",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "libraries": ", ".join(
            f"{name} {version(name)}" for name in ("tumortrack", "numpy", "scipy")
        ),
        "load before": f"{os.getloadavg()[0]:.1f}",
    }


def tables_of(rows: Sequence[Row], machine: dict[str, str]) -> dict[str, pd.DataFrame]:
    """What goes beside a document: parts with their goals, every row, the machine."""
    most = max(row.threads for row in rows)
    parts = [
        {"part": row.part, "of": row.of, "time": row.time, "goal": _goal(row)}
        for row in rows
        if row.threads == most
    ]
    named = [{"this machine": key, "value": value} for key, value in machine.items()]
    every: list[dict[str, Any]] = [asdict(row) for row in rows]
    return {
        "speed": pd.DataFrame(parts),
        "speed-rows": pd.DataFrame(every),
        "speed-machine": pd.DataFrame(named),
    }


def _goal(row: Row) -> str:
    if row.part not in _GOALS_S:
        return ""
    goal_s = _GOALS_S[row.part]
    return f"at most {1000 * goal_s:g} ms: {'met' if row.seconds <= goal_s else 'not met'}"


if __name__ == "__main__":
    try:
        _threads, _folder, _quick, *_groups = sys.argv[1:]
        for _row in carry_out(int(_threads), Path(_folder), bool(_quick), _groups):
            print(json.dumps(asdict(_row)), flush=True)
    except TumortrackError as _error:
        sys.exit(str(_error))  # one line on the standard error, for the process that asked
