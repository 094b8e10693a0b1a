"""What pretraining brings a new patient: accuracy against training steps, with and without it.

    make headstart ARGS='--start runs/start --case NAME=FOLDER'     (about an hour)

Writes a block of docs/results.md and its picture. All trainings of a case and seed, of whatever
length and start, see the same batches, which are made once. Each is measured on scenes whose
elastic states are of a library that no training has seen. Measurements are kept under --out.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path

os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import numpy as np
import pandas as pd
import torch

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.imaging.case import Case, load_case
from tumortrack.phantom.digital import PhantomParameters
from tumortrack.registration.canonical_frame import carry_over, upright_of
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import RestShape, shape_of
from tumortrack.report.drawing import new_figure, save
from tumortrack.training.model import PretrainedWeights, load_start
from tumortrack.training.presets import clinic
from tumortrack.training.state import TrainingRun, TrainingState
from tumortrack.training.task import RegistrationTask, ValidationScenes
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import ReportWriter, table
from tumortrack_lab.study.methods import named_folders, phantom_case
from tumortrack_lab.study.tables import text as seeds_text

BLOCK = "pretraining"
TITLES = {
    "first_tre_mm": "error before refinement",
    "worst_first_tre_mm": "its 90th percentile",
    "tre_mm": "error",
    "worst_tre_mm": "its 90th percentile",
    "miou": "mIoU",
}
COLORS = {True: "#0072B2", False: "#D55E00"}
KEYS = ["case", "steps", "pretrained"]


@dataclass(frozen=True, kw_only=True)
class Options(trainings.KeptOptions):
    """Train a new patient with and without pretrained weights, and measure."""

    start: Path
    """Folder that `tumortrack pretrain` wrote."""
    case: tuple[str, ...] = ()
    """More cases than the phantom, each NAME=FOLDER (folders that `tumortrack prepare` wrote)."""
    steps: tuple[int, ...] = (0, 100, 300, 1000)
    """Lengths of the trainings."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the trainings."""
    scenes: int = 64
    """To measure on."""
    out: Path = Path("runs/pretraining")
    document: Path = Path("docs/results.md")


def main(options: Options) -> None:
    """Every case and seed, then the block."""
    torch.set_num_threads(1)
    start, writer = load_start(options.start), options.begin("headstart", BLOCK)
    cases = {"phantom": phantom_case(options.out / "phantom", PhantomParameters())}
    cases |= named_folders(options.case, cases)
    made, rows = {name: load_case(folder) for name, folder in cases.items()}, []

    @cache
    def scenes(name: str) -> ValidationScenes:
        return trainings.unseen_scenes(made[name], clinic(made[name].anatomy), options.scenes)

    for (name, folder), seed in product(cases.items(), options.seeds):
        about = {
            "case": name,
            "case_sha256": store.sha256_of(folder / store.MANIFEST),
            "start_sha256": start.sha256,
            "seed": seed,
            "steps": list(options.steps),
            "scenes": options.scenes,
        }
        measure = partial(_curve, made[name], partial(scenes, name), start, seed, options.steps)
        curve = trainings.kept(options.out / f"{name}_{seed}.json", about, measure)
        rows += [{"case": name, "seed": seed, **row} for row in curve]
    about = store.read_manifest(options.start, "pretrained")["provenance"]
    _write(pd.DataFrame(rows), about, writer)


def _curve(
    case: Case, scenes: Callable, start: PretrainedWeights, seed: int, lengths: tuple[int, ...]
) -> list[dict]:
    """All trainings of one case and seed, side by side over the same batches."""
    device, config = torch.device("cpu"), clinic(case.anatomy)
    training = TrainingRun(case.anatomy, case.up_lps, "", config, seed, steps=max(*lengths, 1))
    task = RegistrationTask(training, device)
    shape = shape_of(case.anatomy, task.body)
    upright = upright_of(case.anatomy.organ, case.up_lps, shape.body.center_ct, shape.long_axis)
    states: dict[tuple[int, bool], TrainingState] = {}
    for length, pretrained in product(lengths, (False, True)):
        state = TrainingState(replace(training, steps=max(length, 1)), device)
        state.initialize(task.initialize)
        if pretrained:
            state.initialize(lambda network: carry_over(network, start.weights, upright))
        states[length, pretrained] = state
    rows = []

    def judge(steps: int) -> None:
        for (length, pretrained), state in states.items():
            if length == steps:
                method = Registration(state.average.eval(), shape, config.refine)
                row = {"steps": steps, "pretrained": pretrained, **_errors(method, shape, scenes())}
                figures = (f"{key}={round(row[key], 2)}" for key in TITLES)
                say(f"steps={steps} pretrained={pretrained} {' '.join(figures)}")
                rows.append(row)

    judge(0)
    made = trainings.training_batches(training, task, max(lengths))
    for step, batch in enumerate(made, start=1):
        for (length, _), state in states.items():
            if step <= length:
                state.step(batch)
        judge(step)
    return rows


def _errors(method: Registration, shape: RestShape, scenes: ValidationScenes) -> dict[str, float]:
    """Target errors (a scene's mean; then the scenes' median and 90th percentile), before and
    after refinement, and mIoU of the refined labels."""
    first, refined, motions = [], [], []
    for cloud, points_mm, points_ct, labels in zip(
        scenes.clouds_mm, scenes.points_mm, scenes.points_ct, scenes.labels, strict=True
    ):
        starts = method.propose(cloud)
        motions.append(method.best_fit(cloud, starts).motion)
        inside = points_ct[labels > 0], points_mm[labels > 0]
        first.append(_error_mm(starts[0], *inside))
        refined.append(_error_mm(motions[-1], *inside))
    numbers = [
        f(errors) for errors in (first, refined) for f in (np.median, partial(np.percentile, q=90))
    ]
    numbers.append(trainings.placed_miou(motions, shape, scenes))
    return dict(zip(TITLES, map(float, numbers), strict=True))


def _error_mm(motion: ElasticMotion, points_ct: np.ndarray, points_mm: np.ndarray) -> float:
    return float(np.linalg.norm(motion.carry(points_ct) - points_mm, axis=1).mean())


def _write(frame: pd.DataFrame, about: dict, writer: ReportWriter) -> None:
    """The block: one table and picture over all cases."""
    body = [
        [case, f"{steps:,}", "pretrained" if pretrained else "random"]
        + [seeds_text(rows[key], 2 if key == "miou" else 1) for key in TITLES]
        for (case, steps, pretrained), rows in frame.groupby(KEYS)
    ]
    image = writer.image(f"results_{BLOCK}")
    _draw(frame, image)
    text = (
        f"`{writer.command}`: pretrained for {about['steps']:,} steps on {about['anatomies']} "
        f"random kidneys (seed {about['seed']}, {about['training_s'] / 60:.0f} minutes on a shared "
        f"machine); then each case for so many steps of the preset clinic, seeds "
        f"{', '.join(map(str, sorted(frame.seed.unique())))}. Target errors in mm: median and 90th "
        "percentile over scenes with elastic states of a library that no training has seen; ± is "
        "the standard deviation over the seeds."
    )
    picture = writer.link(image, "error against training steps")
    head = ["case", "steps", "start", *TITLES.values()]
    writer.write({BLOCK: f"{picture}\n\n{table(head, body, 3)}\n\n{text}"})


def _draw(frame: pd.DataFrame, path: Path) -> None:
    """Error before (dashed) and after refinement against steps, one panel a case."""
    means = frame.groupby(KEYS)[list(TITLES)].mean()
    cases = sorted(frame.case.unique())
    figure = new_figure(4.6 * len(cases), 3.6)
    for number, case in enumerate(cases):
        axes = figure.add_subplot(1, len(cases), number + 1)
        for pretrained, color in COLORS.items():
            mine = means.xs((case, pretrained), level=("case", "pretrained"))
            for key, style in (("first_tre_mm", "--"), ("tre_mm", "-")):
                name = "pretrained" if pretrained else "random start"
                label = name + (", before refinement" if style == "--" else "")
                axes.plot(mine.index, mine[key], style, color=color, marker="o", label=label)
        axes.set_xscale("symlog", linthresh=100)
        axes.set_xticks(mine.index, [f"{steps:,}" for steps in mine.index])
        axes.set_yscale("log")
        axes.set(title=case, xlabel="training steps", ylabel="median target error (mm)")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, handlelength=3.5)  # long enough for a dash
    figure.tight_layout()
    save(figure, path)


if __name__ == "__main__":
    trainings.run(main, Options)
