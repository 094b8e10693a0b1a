"""Does a plan cut out a tumor that the holder pulls at?

    make pulls ARGS='OUT CASE [CASE ...] --count 40'       (about 20 s a scene)

Each case has its model. Kept in OUT, a file a scene; the same command goes on where it was
stopped.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import tyro

import tumortrack_resection
from tumortrack.cli.console import model_folder, say
from tumortrack.core import store
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.study import pulls, scripts
from tumortrack_lab.study.document import table_of
from tumortrack_lab.study.methods import code_sha256
from tumortrack_lab.world.scenes import TETS, World, WorldConfig


@dataclass(frozen=True)
class Options:
    """Pull, locate, plan, cut."""

    out: tyro.conf.Positional[Path]
    """Where rows are kept."""
    cases: tyro.conf.Positional[tuple[Path, ...]]
    """Folders that `tumortrack prepare` wrote, with their models."""
    count: int = 40
    """Scenes of each case."""
    seed: int = 0
    """Of everything."""
    document: Path | None = None
    """A page that shows the table, which goes beside it."""


def main(options: Options) -> None:
    """Make missing rows, then the table."""
    writer = scripts.begun("pulls", options.document)
    rows, lost = [], 0
    planner = code_sha256(Path(tumortrack_resection.__path__[0]).rglob("*.py"))
    for number in range(options.count):
        for case in options.cases:
            sha256 = store.sha256_of(case / store.MANIFEST)
            folder = options.out / sha256[:8]
            measure = partial(_tried, case, folder, options.seed, number)
            known = scripts.kept(folder / f"{number:05d}.json", {"planner": planner}, measure)
            rows += [{"case": sha256[:8], **row} for row in known]
            lost += not known
    shown = pulls.table(rows)
    sample = f"{options.count * len(options.cases)} scenes, {lost} without a plan"
    print(sample, table_of(shown), sep="\n\n")
    writer.tables({"pulls": shown}, sample=sample)


def _tried(case: Path, folder: Path, seed: int, number: int) -> list[dict]:
    made, why = pulls.tried(_tracker(case), _world(case, folder, seed), number)
    say(f"{case.name} {number}: {why or f'{len(made)} cuts'}")
    return made


@cache
def _tracker(case: Path) -> Tracker:
    return Tracker(load_model(model_folder(case)))


@cache
def _world(case: Path, folder: Path, seed: int) -> World:
    return World.opened(case, WorldConfig(seed=seed), folder / TETS)


if __name__ == "__main__":
    scripts.run(main, Options)
