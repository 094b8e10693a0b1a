"""A case -> the folder of its twin's scenes, state by state, resumable at any point.

SCENES/
  twin.json                     what everything here was made from
  states/STATE.safetensors      the anatomy at rest in each state (bench frame), with its report
  VARIANT-VIEW/                 a scene each, with targets.csv and scene.png
  manifest.json                 the seal, last: sha256 of every scene
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import load_case
from tumortrack.simulate.scene_folder import write_scene_files
from tumortrack.simulate.targets import TARGETS, InnerPoints, draw_targets
from tumortrack_lab.twin.bench import Apparatus, ApparatusConfig, State
from tumortrack_lab.twin.pictures import twin_picture
from tumortrack_lab.twin.states import solve
from tumortrack_lab.twin.stock import StateCache
from tumortrack_lab.twin.variants import (
    VARIANTS,
    VIEWS,
    EquilibriumState,
    View,
    ViewConfig,
    for_organ,
    make_scene,
)

KIND = "twin"
_STATES = "states"
_STATE_SHARE = 15.0  # a state takes about as long as so many scenes

Build = Callable[[Anatomy, tuple[float, float, float], ApparatusConfig], Any]


@dataclass(frozen=True)
class TwinRun:
    """What decides every file: a case, the bench, the views, one seed (of views and targets)."""

    case_folder: Path
    bench: ApparatusConfig = field(default_factory=ApparatusConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    seed: int = 0
    build: Build = Apparatus  # these two have stand-ins in tests
    solve: Callable[..., State] = solve


@dataclass(frozen=True)
class TwinStatus:
    """Where the work stands: share of it done (a guess), and what was done last."""

    share: float
    text: str


def make_scenes(
    run: TwinRun,
    out: Path,
    variants: Sequence[str] = tuple(VARIANTS),
    views: Sequence[View] = VIEWS,
    report: Callable[[TwinStatus], None] | None = None,
) -> list[Path]:
    """The scenes of these variants in these views; those that are there already stay.

    A state is solved once and kept; a run that is killed loses the state or scene at work.

    Returns:
        The scenes' folders.

    Raises:
        InputError: no case; an unknown variant or view; ``out`` holds something else, or scenes
            made from another case, seed or configuration.
        TumortrackError: a state has no equilibrium.
        StorageError: the disk refused.
    """
    wanted = [(v, w) for v in _known(variants, VARIANTS) for w in _known(views, VIEWS)]
    case = load_case(run.case_folder)
    targets = draw_targets(case.anatomy, run.seed)
    identity = _claim(run, out)
    todo = [(v, w) for v, w in wanted if not (out / f"{v}-{w}").exists()]
    states = list(dict.fromkeys(VARIANTS[v].state for v, _ in todo))
    stock = StateCache(
        out / _STATES,
        case.anatomy,
        targets.points_ct,
        lambda: run.build(case.anatomy, case.up_lps, run.bench),
        run.solve,
    )
    pace = _Pace(report, len(todo) + _STATE_SHARE * sum(not stock.has(s) for s in states))
    for state in states:
        fresh = not stock.has(state)
        settled = stock.get(state, pace.say)
        if fresh:
            pace.add(_STATE_SHARE, f"{state}: settled")
        for variant, view in todo:
            if VARIANTS[variant].state == state:
                _write(out / f"{variant}-{view}", settled, run, targets, case.anatomy, identity)
                pace.add(1.0, f"{variant}-{view}")
    seal_scenes(out, identity)
    return [out / f"{v}-{w}" for v, w in wanted]


def seal_scenes(out: Path, identity: dict) -> None:
    """Write the manifest over all finished scenes.

    Raises:
        StorageError: the disk refused.
    """
    names = [f"{variant}-{view}" for variant in VARIANTS for view in VIEWS]
    scenes = {name: store.sha256_of(out / name) for name in names if (out / name).is_dir()}
    store.seal(out, KIND, {**identity, "scenes": scenes}, frame="camera")


def _known(names: Sequence[Any], allowed: Sequence[str] | dict) -> list:
    for name in names:
        if name not in allowed:
            raise InputError(f"{name!r} is not known; allowed: {', '.join(allowed)}.")
    if not names:
        raise InputError(f"nothing to make; choose among {', '.join(allowed)}.")
    return list(dict.fromkeys(names))


def _claim(run: TwinRun, out: Path) -> dict:
    """State what the folder is made from, or check that it is the same."""
    identity = {
        "case_sha256": store.sha256_of(run.case_folder / store.MANIFEST),
        "seed": run.seed,
        "targets": TARGETS,
        "bench_config": to_builtins(run.bench),
        "view_config": to_builtins(run.view),
    }
    path = out / "twin.json"
    if path.exists():
        differ = [k for k, v in identity.items() if store.read_json(path).get(k) != v]
        if differ:
            raise InputError(
                f"{out} holds scenes of another {' and '.join(differ)}. Choose another SCENES "
                "folder, or remove this one."
            )
        return identity
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds other files. Choose a new or empty folder for the scenes.")
    try:
        (out / _STATES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write {out}: {error.strerror}.") from error
    store.write_json(path, identity)
    return identity


def _write(
    folder: Path,
    settled: EquilibriumState,
    run: TwinRun,
    targets: InnerPoints,
    anatomy_ct: Anatomy,
    identity: dict,
) -> None:
    """One scene's folder with targets and picture, all or nothing."""
    variant, _, view = folder.name.partition("-")
    height_mm = float(np.ptp(anatomy_ct.organ.vertices_mm @ settled.bench_from_ct[2, :3]))
    config = for_organ(run.view, height_mm)
    scene, targets_mm = make_scene(settled, variant, view, config, run.seed)  # type: ignore[arg-type]
    scene = replace(scene, meta={**identity, **scene.meta}, targets=targets.at(targets_mm))
    with store.new_folder(folder) as aside:
        write_scene_files(aside, scene)
        rest = anatomy_ct.organ
        rest = rest.moved(transform_points(settled.bench_from_ct, rest.vertices_mm))
        twin_picture(scene, settled, rest, aside / "scene.png")


class _Pace:
    """Turns pieces of work done into a share of all."""

    def __init__(self, report: Callable[[TwinStatus], None] | None, total: float) -> None:
        self._report = report or (lambda status: None)
        self._total = max(total, 1.0)
        self._done = 0.0

    def say(self, text: str) -> None:
        self._report(TwinStatus(self._done / self._total, text))

    def add(self, amount: float, text: str) -> None:
        self._done += amount
        self.say(text)
