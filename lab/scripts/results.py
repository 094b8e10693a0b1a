"""Everything in docs/results.md that is measured on the digital twin, from one command.

    make results                 (hours; go on with the same command after an interruption)
    make results ARGS=--quick    (minutes: one phantom, one seed, few steps; its own document)

Scenes, models and measurements are kept under --out; what is there already is not made again.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import msgspec
import tyro
from tumortrack_lab.study.book import ReportWriter, gallery_block, section_blocks
from tumortrack_lab.study.cells import MeasurementStore
from tumortrack_lab.study.peer_methods import peer_method
from tumortrack_lab.study.phantoms import phantom_case, study_case

from tumortrack.cli.console import say
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.core.store import write_json
from tumortrack.phantom.digital import PhantomParameters, second_phantom
from tumortrack.training.presets import clinic, quick
from tumortrack.training.train import StudyStatus as TrainStatus
from tumortrack_lab.study.bound import BOUNDS, Bound
from tumortrack_lab.study.measure import Job, StudyCase, StudyStatus, measure
from tumortrack_lab.study.methods import Method, Network
from tumortrack_lab.study.models import CLINIC, MODELS, Presets, Trainer
from tumortrack_lab.study.plan import (
    FULL,
    QUICK,
    SECTIONS,
    Methods,
    Section,
    StudyPlan,
    jobs_of,
    scenes_of,
)
from tumortrack_lab.study.resection import cut_one

DOCUMENT = Path("docs/results.md")
EVERY_S = 15.0  # between lines of progress
VOXEL_MM = 0.8  # of the phantoms' labels


@dataclass(frozen=True)
class Options:
    """Regenerate the tables and plots of docs/results.md."""

    quick: bool = False
    """A small version in minutes: OUT/results.md instead of the document."""
    out: Path | None = None
    """Where scenes, models and measurements are kept (runs/results, runs/results-quick)."""
    document: Path = DOCUMENT
    """Whose marked blocks are replaced."""
    case: tuple[str, ...] = ()
    """More cases, each NAME=FOLDER (folders that `tumortrack prepare` wrote)."""
    sections: tuple[Section, ...] = SECTIONS
    """Which blocks to make."""
    steps: int | None = None
    """Of training M_lim and M_full."""
    clinic_steps: int | None = None
    """Of training clinic (the preset's)."""
    models: tuple[str, ...] | None = None
    """In accuracy, peers and views: M_lim, M_full, clinic."""
    configuration_steps: int | None = None
    """Of training in the deformation study (as many as --steps)."""
    seeds: tuple[int, ...] | None = None
    """Of training."""
    case_seeds: tuple[int, ...] | None = None
    """Of training for --case (the same as the phantom's)."""
    configuration_seeds: tuple[int, ...] | None = None
    """Of training in the deformation study (the same as the phantom's)."""
    fault_seeds: tuple[int, ...] | None = None
    """Of the random part of each fault."""
    severities: tuple[str, ...] | None = None
    """Faults and their levels, such as visible=60 (those of the plan)."""
    severity_seeds: tuple[int, ...] | None = None
    """Of the random part of each severity."""
    severity_models: tuple[str, ...] | None = None
    """Models beside the severities' peers."""
    severity_peers: tuple[str, ...] | None = None
    """Peers in the severities."""
    goal_models: tuple[str, ...] | None = None
    """Models in the table of goals."""
    resection_models: tuple[str, ...] | None = None
    """Models whose estimates are planned on and cut, beside the truth."""
    ablation_models: tuple[str, ...] | None = None
    """Rows of the ablation."""
    ablation_cases: tuple[str, ...] | None = None
    """Cases of the ablation, of those that are given."""
    ablation_scenes: int | None = None
    """Training scenes of each model in the ablation."""
    ablation_seeds: tuple[int, ...] | None = None
    """Of training in the ablation."""
    ablation_views: tuple[str, ...] | None = None
    """Views in the ablation."""
    grid: int | None = None
    """Voxels along the longest side, in the table of accuracy."""
    case_peers: tuple[str, ...] | None = None
    """Peers for --case (as for the phantom)."""
    case_grid: int | None = None
    """The same for --case (as for the phantom)."""
    bcpd: Path = Path("runs/bcpd/bcpd")
    """The built program of the peer BCPD; where there is none it is left out (docs/peers.md)."""
    device: str = "auto"
    """Of networks: auto, cpu or cuda."""


def main(options: Options) -> None:
    """Scenes, models, cells, blocks, in this order and section by section."""
    plan = _plan(options)
    out = options.out or Path("runs/results-quick" if options.quick else "runs/results")
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "plan.json", msgspec.to_builtins(plan))
    document = options.document
    if options.quick:
        document = out / "results.md"
        shutil.copyfile(options.document, document)
    given = shlex.join(sys.argv[1:])
    book = ReportWriter(document, "make results" + (f" ARGS='{given}'" if given else ""))
    cells = MeasurementStore(out / "cells")
    studied, second = _cases(options, out)
    methods = _methods(options, plan, out)
    for section in options.sections:
        cases = (second,) if section == "deformation" else studied
        if section in ("faults", "views", "severity"):
            cases = studied[:1]
        for case in cases:
            _scenes(case, *scenes_of(plan, section))
        say(f"== {section}")
        jobs = jobs_of(plan, section, cases, methods)
        one = cut_one if section == "resection" else None
        measured = measure(jobs, cells, Measuring(section).show, one)
        book.write(section_blocks(section, measured, cases, book))
        say(f"{section}: {len(measured)} measurements, block written to {document}")
    if "peers" in options.sections:
        shown = [job for job in _gallery_jobs(plan, studied[0], methods)]
        book.write(gallery_block(plan, shown, book, out / "gallery.json"))
    say(f"done; {document} is up to date.")


def _methods(options: Options, plan: StudyPlan, out: Path) -> Methods:
    """Each is trained, or made ready, once."""
    presets = Presets(quick, clinic)
    trainer = Trainer(out / "models", presets, options.device, report=Training().show)
    bcpd = options.bcpd if options.bcpd.is_file() else None

    def model(case: StudyCase, name: str, seed: int) -> Network:
        steps = plan.clinic_steps if name == CLINIC else plan.configuration_steps
        return trainer.model(case, name, seed, plan.steps if name in MODELS else steps)

    def ablated(case: StudyCase, name: str, seed: int) -> Network:
        steps = trainer.steps_for(case, name, plan.ablation_scenes)
        return trainer.model(case, name, seed, steps)

    def peer(name: str, case: StudyCase) -> Method:
        bounds = {bound: Bound(bound, case) for bound in BOUNDS}
        return bounds[name] if name in bounds else peer_method(name, case, bcpd)

    return Methods(cache(model), cache(peer), cache(ablated))


def _plan(options: Options) -> StudyPlan:
    plan = QUICK if options.quick else FULL
    if options.bcpd.is_file() and not options.quick:
        plan = msgspec.structs.replace(plan, peers=(*plan.peers, "bcpd"))
    names = {field.name for field in fields(options)} & set(plan.__struct_fields__)
    given = {name: getattr(options, name) for name in names}
    given["configuration_steps"] = options.configuration_steps or options.steps
    return msgspec.structs.replace(plan, **{k: v for k, v in given.items() if v is not None})


def _cases(options: Options, out: Path) -> tuple[tuple[StudyCase, ...], StudyCase]:
    """The paper's phantom and the given cases; and the second phantom."""
    folders = {}
    for name, parameters in (
        ("phantom", PhantomParameters()),
        ("second_phantom", second_phantom()),
    ):
        folders[name] = out / "cases" / name
        phantom_case(folders[name], parameters, VOXEL_MM)
    given = []
    for text in options.case:
        name, _, folder = text.partition("=")
        if not name.isidentifier() or not folder or name in folders:
            raise InputError(f"--case {text!r} must be NAME=FOLDER, with a name of its own.")
        given.append((name, Path(folder)))
    scenes = out / "scenes"
    phantom = study_case("phantom", folders["phantom"], scenes / "phantom", is_paper=True)
    second = study_case("second_phantom", folders["second_phantom"], scenes / "second_phantom")
    return (phantom, *(study_case(n, f, scenes / n) for n, f in given)), second


def _scenes(case: StudyCase, variants: tuple[str, ...], views: tuple[str, ...]) -> None:
    """The twin's scenes of a case; those that are there stay."""
    command = [sys.executable, "-m", "tumortrack.cli.main", "twin", str(case.folder)]
    command += [str(case.scenes), "--states", *variants, "--views", *views]
    if subprocess.run(command, check=False).returncode != 0:
        raise TumortrackError(f"the scenes of {case.name} could not be made (see above).")


def _gallery_jobs(plan: StudyPlan, case: StudyCase, methods: Methods) -> list[Job]:
    chosen = [methods.model(case, name, plan.seeds[0]) for name in plan.models]
    chosen += [methods.peer(name, case) for name in ("elastic",) if name in plan.peers]
    return [
        Job(case, method, variant, plan.view, plan.coarse_grid)
        for method in chosen
        for variant in plan.variants
        if not variant.startswith("Rot")
    ]


class Lines:
    """Progress as lines, one now and then."""

    def __init__(self) -> None:
        self._said = -EVERY_S

    def line(self, text: str, last: bool) -> None:
        if last or time.monotonic() - self._said >= EVERY_S:
            say(text)
            self._said = time.monotonic()


class Training(Lines):
    """How a training goes."""

    def show(self, name: str, status: TrainStatus) -> None:
        self.line(
            f"{name}: step {status.step}/{status.end}, {status.samples_per_s:.0f} samples/s, "
            f"{_clock(status.seconds_left)} left",
            status.step == status.end,
        )


class Measuring(Lines):
    """How the measuring goes."""

    def __init__(self, section: str) -> None:
        super().__init__()
        self._section = section

    def show(self, status: StudyStatus) -> None:
        self.line(
            f"{self._section}: {status.done}/{status.total}, {status.seconds_per_cell:.1f} s each, "
            f"{_clock(status.seconds_left)} left ({status.name})",
            status.done == status.total,
        )


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 3600}:{int(seconds) // 60 % 60:02d}:{int(seconds) % 60:02d}"


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except TumortrackError as error:
        print(f"results: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("results: stopped; the same command goes on.", file=sys.stderr)
        sys.exit(130)
