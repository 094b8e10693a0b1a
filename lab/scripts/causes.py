"""Which part of the tumors' errors has which cause: fits that are told parts of the truth.

    make causes ARGS='CASE WORLD MODEL OUT'     (WORLD: scenes by `make world`; 2 s a state)

OUT keeps rows, a file a state, and the same command goes on; --beside counts other organs in.
Scenes with errors of segmentation, slits and organs at rest are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tyro

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import TumortrackError
from tumortrack.imaging.case import load_case
from tumortrack.simulate.elastic.body import BodyConfig
from tumortrack.simulate.scene_folder import list_scenes, read_scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import ReportWriter, make_folder, table
from tumortrack_lab.world import causes
from tumortrack_lab.world.scenes import TETS, World, WorldConfig
from tumortrack_lab.world.tables import STATES

BLOCK = "causes"
LADDER = {  # what is told of the surface, what else is known
    "best rigid pose": ("", "rigid"),
    "best state of the modes": ("", "modes"),
    "whole surface told, finite elements within": ("whole surface", "finite elements"),
    "whole surface told, the library within": ("whole surface", "recognised, weigh more"),
    "the same, along normals alone": ("whole surface", "points weigh more"),
    "the same, points weighed as usual": ("whole surface", "as used"),
    "what three views show of it": ("three views", "as used"),
    "what one view shows of it": ("one view", "as used"),
    "the same through a calibrated camera": ("calibrated", "as used"),
    "the same as cameras and region err": ("as it is seen", "as used"),
    "the same, found from nothing": ("as it is seen", "found"),
}
TOLD = (
    "whole surface", "three views", "one view", "one view and the underside", "calibrated",
    "as it is seen",
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """Fits that are told parts of the truth, and the tables of causes."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    world: tyro.conf.Positional[Path]
    """Scenes of it that `make world` wrote."""
    model: tyro.conf.Positional[Path]
    """Folder that `tumortrack train` wrote."""
    out: tyro.conf.Positional[Path]
    """Folder of the rows."""
    count: int = 60
    """States at most."""
    beside: tuple[Path, ...] = ()
    """Other organs' rows join the tables."""
    document: Path | None = None
    """Its block is replaced."""


def main(options: Options) -> None:
    """Measure what is missing, then the tables."""
    writer = ReportWriter(options.document or Path(), trainings.make_command("causes"))
    if options.document is not None:
        writer.check([BLOCK])
    make_folder(options.out)
    _measure(options)
    files = [path for out in (options.out, *options.beside) for path in sorted(out.glob("*.json"))]
    text = summary(pd.DataFrame([row for path in files for row in store.read_json(path)["rows"]]))
    print(text)
    if options.document is not None:
        writer.write({BLOCK: f"`{writer.command}`\n\n{text}"})


def _measure(options: Options) -> None:
    world = World.opened(options.case, WorldConfig(hidden=0.0), options.world / TETS)
    about = {"model_sha256": store.sha256_of(options.model / store.MANIFEST)}
    about |= {"case_sha256": world.case_sha256, "count": options.count}
    known = [(path, store.read_json(path / "meta.json")) for path in list_scenes(options.world)]
    scenes = [
        (path, meta)
        for path, meta in known
        if meta["family"] not in ("rest", "cut")
        and all(meta[error]["kind"] == "none" for error in ("segmentation", "disturbance"))
    ][: options.count]
    if all((options.out / f"{path.name}.json").exists() for path, _ in scenes):
        return
    tracker = Tracker(load_model(options.model, "cpu", with_margins=False))
    shape = tracker.model.shape
    priors = causes.Priors(load_case(options.case), shape, BodyConfig())
    say(f"{len(scenes)} states; bodies are built")
    shown = [world.kept(read_scene(path)) for path, _ in scenes]
    told = [causes.Told.of(world.anatomy_ct, read_scene(path).reference, m) for path, m in scenes]
    truths = np.array([causes.best_of_modes(shape, state).coefficients for state in told])
    families = np.array([meta["family"] for _, meta in scenes])

    def measure(n: int) -> list[dict[str, Any]]:
        others, meta = np.arange(len(scenes)) != n, scenes[n][1]
        alike = truths[others & (families == families[n])]
        shapes = {"": shape, **priors.exchanged(meta["material"], truths[others], alike)}
        scene = world.again(shown[n], meta["world"]["number"], "none")
        state = causes.Told.of(world.anatomy_ct, scene.reference, scene.meta)
        return causes.judged(state, scene, shapes, world.organ, tracker)

    for n, (path, _) in enumerate(scenes):
        try:
            trainings.kept(options.out / f"{path.name}.json", about, partial(measure, n))
            say(f"{n + 1}/{len(scenes)} {path.name}")
        except TumortrackError as error:
            say(f"{n + 1}/{len(scenes)} {path.name} is left out: {error}")


def summary(rows: pd.DataFrame) -> str:
    """Markdown: the ladder by kind of tumor and size of state, and what exchanges change."""
    size = np.array(list(STATES))[np.searchsorted(list(STATES.values()), rows["bend_mm"])]
    kind = np.where(rows["family"] == "pull", "one is pulled", rows["site"])
    rows = rows.assign(size=size, site=kind)[size != "at rest"]
    sites, head = sorted(set(rows["site"])), ["told"]
    cells = [(site, size) for site in sites for size in list(STATES)[1:]]
    head += [
        f"{site}, {size} ({len(_of(rows, '', 'modes', *cell))})"
        for site, size in cells
        for cell in [(site, size)]
    ]
    body = [
        [name, *(_three(_of(rows, *rung, *cell)) for cell in cells)]
        for name, rung in LADDER.items()
    ]
    parts = [table(head, body)]
    kinds = dict.fromkeys(rows["what"][rows["told"] == "one view"])
    for site in sites:
        body = [[what, *(_three(_of(rows, told, what, site)) for told in TOLD)] for what in kinds]
        parts.append(table([f"{site}; also known", *TOLD], body))
    return "\n\n".join([*parts, "mm off: median / 95 % / worst; (number of tumors)."])


def _of(rows: pd.DataFrame, *wanted: str) -> pd.Series:
    chosen = np.ones(len(rows), bool)
    for name, value in zip(("told", "what", "site", "size"), wanted, strict=False):
        chosen &= rows[name] == value
    return rows["off_mm"][chosen]


def _three(off: pd.Series) -> str:
    shown = [off.median(), off.quantile(0.95), off.max()]
    return " / ".join(f"{value:.1f}" for value in shown) if len(off) else "-"


if __name__ == "__main__":
    trainings.run(main, Options)
