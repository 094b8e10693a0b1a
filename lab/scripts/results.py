"""Everything in docs/results.md that is measured on the digital twin, from one command.

    make results                 (hours; go on with the same command after an interruption)

Scenes, models and measurements are kept under --out; what is there already is not made again.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from tumortrack.cli.console import say
from tumortrack.core.errors import TumortrackError
from tumortrack.phantom.digital import PhantomParameters
from tumortrack.training.train import TrainingStatus
from tumortrack_lab.study import goals, scripts, tables
from tumortrack_lab.study.measure import measured
from tumortrack_lab.study.methods import (
    CLINIC,
    Method,
    StudyCase,
    Trainer,
    named_folders,
    peer,
    phantom_case,
    second_phantom,
    study_case,
)
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.twin.views import VARIANTS

EVERY_S = 15.0  # between lines of progress
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
    models: tuple[str, ...] = (CLINIC,)
    """In accuracy: clinic, and M_lim and M_full (quick)."""
    peers: tuple[str, ...] = (goals.RIGID, "rigid", "elastic")
    """Beside them in accuracy (docs/peers.md)."""
    clinic_steps: int = 6_000
    """Of training clinic (the preset's)."""
    steps: int = 12_000
    """Of training the others."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of training the phantoms' models: of network, scenes and elastic body."""
    case_seeds: tuple[int, ...] | None = None
    """Of training --case (the same as the phantoms')."""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """States and turns of the twin."""
    grid: int = 160
    """Voxels along the longest side (the paper's: 400)."""
    device: str = "auto"
    """Of networks: auto, cpu or cuda."""
    out: Path = Path("runs/results")
    document: Path = Path("docs/results.md")


def main(options: Options) -> None:
    """Scenes, models, measurements, blocks, in this order and section by section."""
    writer = options.begin("results", *options.sections)
    cases, trainer = list(cases_of(options)), Trainer(options.out / "models", options.device)
    trainer = trainer._replace(report=lines())
    for section in options.sections:
        say(f"== {section}")
        rows: Rows = []
        for case in cases:
            make_scenes(case, options.variants)
            for method in methods_of(section, case, options, trainer):
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


def methods_of(
    section: Section, case: StudyCase, options: Options, trainer: Trainer
) -> Iterator[Method]:
    """One after the other, so that one model is held at a time."""
    seeds = options.seeds if case.name in PHANTOMS else options.case_seeds or options.seeds
    models = (CLINIC,) if section == "goals" else options.models
    for name, seed in product(models, seeds):
        steps = options.clinic_steps if name == CLINIC else options.steps
        yield trainer.model(case, name, seed, steps)
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


def lines() -> Callable[[str, TrainingStatus], None]:
    """A training's progress with the seconds left, a line now and then."""
    last_s = -EVERY_S

    def line(name: str, now: TrainingStatus) -> None:
        nonlocal last_s
        if now.step == now.end or time.monotonic() - last_s >= EVERY_S:
            say(f"{name}: step {now.step}/{now.end}, {now.seconds_left / 60:.1f} minutes left")
            last_s = time.monotonic()

    return line


if __name__ == "__main__":
    scripts.run(main, Options)
