"""Everything in docs/results.md that is measured on the digital twin, from one command.

    make results                 (hours; go on with the same command after an interruption)
    make results ARGS=--quick    (minutes: one phantom, one seed, few steps; its own document)

Scenes, models and measurements are kept under --out; what is there already is not made again.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated

os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import msgspec
import tyro

from tumortrack.cli.console import say
from tumortrack.core.errors import TumortrackError
from tumortrack.core.store import write_json
from tumortrack.phantom.digital import PhantomParameters, second_phantom
from tumortrack.training.presets import clinic, quick
from tumortrack.training.train import TrainingStatus
from tumortrack_lab.study import plan as studies
from tumortrack_lab.study.bound import BOUNDS, Bound
from tumortrack_lab.study.document import ReportWriter
from tumortrack_lab.study.measure import Job, MeasurementStore, StudyStatus, measure
from tumortrack_lab.study.methods import (
    CLINIC,
    MODELS,
    Method,
    Network,
    Presets,
    StudyCase,
    Trainer,
    named_folders,
    peer_method,
    phantom_case,
    study_case,
)
from tumortrack_lab.study.report import gallery_block, section_blocks
from tumortrack_lab.study.resection import cut_one
from tumortrack_lab.study.trainings import make_command, run

EVERY_S = 15.0  # between lines of progress
TRAINING = ": step {now.step}/{now.end}, {now.samples_per_s:.0f} samples/s, {left}"
MEASURING = ": {now.done}/{now.total}, {now.seconds_each:.1f} s each, {left} ({now.name})"


@dataclass(frozen=True)
class Options:
    """Regenerate the tables and plots of docs/results.md."""

    quick: bool = False
    """A small version in minutes: OUT/results.md instead of the document."""
    out: Path | None = None
    """Where scenes, models and measurements are kept (runs/results, runs/results-quick)."""
    document: Path = Path("docs/results.md")
    """Whose marked blocks are replaced."""
    case: tuple[str, ...] = ()
    """More cases, each NAME=FOLDER (folders that `tumortrack prepare` wrote)."""
    sections: tuple[studies.Section, ...] = studies.SECTIONS
    """Which blocks to make."""
    bcpd: Path = Path("runs/bcpd/bcpd")
    """The built program of the peer BCPD; where there is none it is left out (docs/peers.md)."""
    device: str = "auto"
    """Of networks: auto, cpu or cuda."""
    plan: Annotated[studies.StudyPlan, tyro.conf.arg(name="")] = (
        studies.QUICK if "--quick" in sys.argv else studies.FULL
    )


def main(options: Options) -> None:
    """Scenes, models, measurements, blocks, in this order and section by section."""
    plan, document = options.plan, options.document
    if options.bcpd.is_file() and not options.quick:
        plan = msgspec.structs.replace(plan, peers=(*plan.peers, "bcpd"))
    out = options.out or Path("runs/results-quick" if options.quick else "runs/results")
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "plan.json", msgspec.to_builtins(plan))
    if options.quick:
        document = out / "results.md"
        shutil.copyfile(options.document, document)
    writer = ReportWriter(document, make_command("results"))
    kept = MeasurementStore(out / "cells")
    studied, second = _cases(options, out)
    methods = _methods(options, plan, out)
    for section in options.sections:
        cases = (second,) if section == "deformation" else studied
        if section in ("accuracy", "goals"):  # for its endophytic tumors
            cases = (*studied, second)
        elif section in ("faults", "views", "severity"):
            cases = studied[:1]
        for case in cases:
            _scenes(case, *studies.scenes_of(plan, section, case))
        say(f"== {section}")
        jobs = studies.jobs_of(plan, section, cases, methods)
        one = cut_one if section == "resection" else None
        measured = measure(jobs, kept, partial(_lines(), section + MEASURING), one)
        writer.write(section_blocks(section, measured, cases, writer))
        say(f"{section}: {len(measured)} measurements, block written to {document}")
    if "accuracy" in options.sections:
        case, seed = studied[0], plan.seeds[0]
        chosen: list[Method] = [methods.model(case, name, seed) for name in plan.models]
        chosen += [methods.peer("elastic", case)] * ("elastic" in plan.peers)
        scenes = [variant for variant in plan.variants if not variant.startswith("Rot")]
        shown = [Job(case, m, v, plan.view, plan.grid) for m in chosen for v in scenes]
        writer.write(gallery_block(shown, seed, writer, out / "gallery.json"))
    say(f"done; {document} is up to date.")


def _methods(options: Options, plan: studies.StudyPlan, out: Path) -> studies.Methods:
    """Each is trained, or made ready, once."""
    line = _lines()
    trainer = Trainer(
        out / "models", Presets(quick, clinic), options.device,
        report=lambda name, now: line(name + TRAINING, now),
    )  # fmt: skip
    bcpd = options.bcpd if options.bcpd.is_file() else None

    def model(case: StudyCase, name: str, seed: int) -> Network:
        steps = plan.clinic_steps if name == CLINIC else plan.configuration_steps or plan.steps
        return trainer.model(case, name, seed, plan.steps if name in MODELS else steps)

    def ablated(case: StudyCase, name: str, seed: int) -> Network:
        steps = trainer.steps_for(case, name, plan.ablation_scenes)
        return trainer.model(case, name, seed, steps)

    def peer(name: str, case: StudyCase) -> Method:
        return Bound(name, case) if name in BOUNDS else peer_method(name, case, bcpd)

    return studies.Methods(cache(model), cache(peer), cache(ablated))


def _cases(options: Options, out: Path) -> tuple[tuple[StudyCase, ...], StudyCase]:
    """The paper's phantom and the given cases; and the second phantom."""
    phantoms = {"phantom": PhantomParameters(), "second_phantom": second_phantom()}
    folders = {n: phantom_case(out / "cases" / n, shape) for n, shape in phantoms.items()}
    folders |= named_folders(options.case, folders)
    phantom, second, *given = (
        study_case(name, folder, out / "scenes" / name, is_paper=name in phantoms)
        for name, folder in folders.items()
    )
    return (phantom, *given), second


def _scenes(case: StudyCase, variants: tuple[str, ...], views: tuple[str, ...]) -> None:
    """The twin's scenes of a case; those that are there stay."""
    if not variants:
        return
    command = [sys.executable, "-m", "tumortrack.cli.main", "twin", str(case.folder)]
    command += [str(case.scenes), "--states", *variants, "--views", *views]
    if subprocess.run(command, check=False).returncode != 0:
        raise TumortrackError(f"the scenes of {case.name} could not be made (see above).")


def _lines() -> Callable[[str, TrainingStatus | StudyStatus], None]:
    """Progress with the seconds left, as lines: one now and then, and the last."""
    last_s = -EVERY_S

    def line(text: str, now: TrainingStatus | StudyStatus) -> None:
        nonlocal last_s
        training = isinstance(now, TrainingStatus)
        last = now.step == now.end if training else now.done == now.total
        if last or time.monotonic() - last_s >= EVERY_S:
            s = int(now.seconds_left)
            say(text.format(now=now, left=f"{s // 3600}:{s // 60 % 60:02d}:{s % 60:02d} left"))
            last_s = time.monotonic()

    return line


if __name__ == "__main__":
    run(main, Options)
