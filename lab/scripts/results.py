"""Everything in docs/results.md that is measured on the digital twin, from one command.

    make results                 (hours; go on with the same command after an interruption)

Scenes and measurements are kept under --out; what is there already is not made again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tumortrack.cli.console import say
from tumortrack.phantom.digital import PhantomParameters
from tumortrack_lab.study import scripts, tables
from tumortrack_lab.study.document import ReportWriter
from tumortrack_lab.study.measure import measured
from tumortrack_lab.study.methods import (
    Method,
    StudyCase,
    clinic,
    named_folders,
    peer,
    phantom_case,
    second_phantom,
    study_case,
)
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.twin.dataset import TwinRun, make_scenes
from tumortrack_lab.twin.views import VARIANTS

PHANTOMS = {"phantom": PhantomParameters(), "second_phantom": second_phantom()}
VIEW = "noise"
BLOCK = "accuracy"


@dataclass(frozen=True, kw_only=True)
class Options(scripts.KeptOptions):
    """Regenerate the tables of docs/results.md."""

    case: tuple[str, ...] = ()
    """More organs than the two phantoms, each NAME=FOLDER (of `tumortrack prepare`)."""
    peers: tuple[str, ...] = ("rigid_bound", "rigid_fit", "rigid", "elastic")
    """Beside clinic (docs/peers.md)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of models: of elastic body and calibration."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """States and turns of the twin."""
    grid: int = 160
    """Voxels along the longest side (the paper's: 400)."""
    out: Path = Path("runs/results")
    document: Path = Path("docs/results.md")


def main(options: Options) -> None:
    """Scenes, measurements, the block and its tables, in this order."""
    writer, rows = options.begin("results"), []
    cases = list(cases_of(options))
    for case in cases:
        run = TwinRun(case.folder)
        make_scenes(run, case.scenes, options.variants, (VIEW,), say)
        for method in methods_of(case, options):
            say(f"{case.name}: {method.name}, seed {method.seed}")
            about = case, method, options.variants, VIEW, options.grid, options.out / "rows"
            rows += measured(*about)
    fill(rows, cases, writer)
    say(f"written to {options.document}")


def cases_of(options: Options) -> Iterator[StudyCase]:
    place = options.out / "cases"
    folders = {name: phantom_case(place / name, phantom) for name, phantom in PHANTOMS.items()}
    folders |= named_folders(options.case, folders)
    for name, folder in folders.items():
        yield study_case(name, folder, options.out / "scenes" / name)


def methods_of(case: StudyCase, options: Options) -> Iterator[Method]:
    """One after the other, so that one model is held at a time."""
    yield from (clinic(case, seed) for seed in options.seeds)
    yield from (peer(name, case) for name in options.peers)


def fill(rows: list[dict[str, Any]], cases: list[StudyCase], writer: ReportWriter) -> None:
    """The document's tables, in full and in short."""
    sites = {case.name: tumor_sites_of(case.anatomy_ct) for case in cases}
    accuracy = tables.accuracy(tables.tidy(rows), sites)
    made = {BLOCK: tables.accuracy_summary(accuracy), "results-accuracy": accuracy}
    writer.tables(made, sample=tables.sample(rows))


if __name__ == "__main__":
    scripts.run(main, Options)
