"""Everything in docs/results.md that is measured on the digital twin, from one command.

    make results                 (hours; go on with the same command after an interruption)

Scenes and measurements are kept under --out; what is there already is not made again.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from tumortrack.cli.console import say
from tumortrack.core.errors import TumortrackError
from tumortrack.phantom.digital import PhantomParameters
from tumortrack_lab.study import goals, scripts, tables
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
from tumortrack_lab.twin.views import VARIANTS

PHANTOMS = {"phantom": PhantomParameters(), "second_phantom": second_phantom()}
VIEW = "noise"
Section = Literal["accuracy", "goals"]
Rows = list[dict[str, Any]]
RULES: dict[Section, str] = {
    "accuracy": "Distances in mm: median / 90 % / 95 % / worst of all scenes and seeds (nearest "
    "rank; of mIoU the lowest are the worst). A part that was not found counts as infinitely far. "
    "HD is symmetric; best rigid pose: an oracle, the undeformed organ laid on the true one, in "
    "least squares, so a single distance may come out below it. No method can use it. Target "
    "error: mean over the scene's inner targets, for methods that carry points.",
    "goals": goals.RULE,
}


@dataclass(frozen=True, kw_only=True)
class Options(scripts.KeptOptions):
    """Regenerate the tables of docs/results.md."""

    case: tuple[str, ...] = ()
    """More organs than the two phantoms, each NAME=FOLDER (of `tumortrack prepare`)."""
    sections: tuple[Section, ...] = get_args(Section)
    """Which blocks to make."""
    peers: tuple[str, ...] = (goals.RIGID, "rigid", "elastic")
    """Beside clinic in accuracy (docs/peers.md)."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of models: of elastic body and calibration."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """States and turns of the twin."""
    grid: int = 160
    """Voxels along the longest side (the paper's: 400)."""
    out: Path = Path("runs/results")
    document: Path = Path("docs/results.md")


def main(options: Options) -> None:
    """Scenes, measurements, blocks, in this order and section by section."""
    writer = options.begin("results", *options.sections)
    cases = list(cases_of(options))
    for section in options.sections:
        say(f"== {section}")
        rows: Rows = []
        for case in cases:
            make_scenes(case, options.variants)
            for method in methods_of(section, case, options):
                say(f"{case.name}: {method.name}, seed {method.seed}")
                about = case, method, options.variants, VIEW, options.grid, options.out / "rows"
                rows += measured(*about)
        texts = [*texts_of(section, rows, cases), tables.caption(rows, writer.command)]
        writer.write({section: "\n\n".join(texts) + f" {RULES[section]}"})
        say(f"{section}: block written to {options.document}")


def cases_of(options: Options) -> Iterator[StudyCase]:
    folders = {n: phantom_case(options.out / "cases" / n, one) for n, one in PHANTOMS.items()}
    folders |= named_folders(options.case, folders)
    for name, folder in folders.items():
        yield study_case(name, folder, options.out / "scenes" / name)


def make_scenes(case: StudyCase, variants: tuple[str, ...]) -> None:
    """The twin's scenes; those that are there stay."""
    command = [sys.executable, "-m", "tumortrack.cli.main", "twin", str(case.folder)]
    command += [str(case.scenes), "--states", *variants, "--views", VIEW]
    if subprocess.run(command, check=False).returncode != 0:
        raise TumortrackError(f"the scenes of {case.name} could not be made (see above).")


def methods_of(section: Section, case: StudyCase, options: Options) -> Iterator[Method]:
    """One after the other, so that one model is held at a time."""
    for seed in options.seeds:
        yield clinic(case, seed)
    for name in options.peers if section == "accuracy" else (goals.RIGID,):
        yield peer(name, case)


def texts_of(section: Section, rows: Rows, cases: list[StudyCase]) -> list[str]:
    """The tables of a section."""
    frame = tables.tidy(rows)
    sites = {case.name: tumor_sites_of(case.anatomy_ct) for case in cases}
    if section == "goals":
        return [goals.goal_table(frame, sites)]
    texts = []
    for name, own in sites.items():
        mine = frame[frame.case == name]
        texts += [f"#### {name}", tables.sites_text(name, own), tables.accuracy(mine, own)]
    return texts


if __name__ == "__main__":
    scripts.run(main, Options)
