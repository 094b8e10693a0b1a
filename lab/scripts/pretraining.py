"""What pretraining brings a new patient: accuracy against training steps, with and without it.

    make headstart ARGS='--start runs/start --case NAME=FOLDER'     (about an hour)

Writes a block of docs/results.md and its picture. All trainings of a case and seed, of whatever
length and start, see the same batches, which are made once. Each is measured on scenes whose
elastic states are of a library that no training has seen. Measurements are kept under --out.
"""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import msgspec
import numpy as np
import torch
import tyro

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError, TumortrackError
from tumortrack.imaging.case import Case, load_case
from tumortrack.phantom.digital import PhantomParameters
from tumortrack.registration.canonical_frame import carry_over, upright_of
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import RestShape, shape_of
from tumortrack.report.drawing import new_figure, save
from tumortrack.simulate.dataset import SceneStream
from tumortrack.simulate.occupancy import organ_pool
from tumortrack.simulate.scene import Simulator, body_for
from tumortrack.training.model import PretrainedWeights, load_start
from tumortrack.training.presets import clinic
from tumortrack.training.registration_task import RegistrationTask
from tumortrack.training.run import TrainingRun
from tumortrack.training.scenes import batches
from tumortrack.training.state import TrainingState
from tumortrack.training.task import ValidationScenes, mean_iou_of, validation_scenes
from tumortrack_lab.study.book import ReportWriter
from tumortrack_lab.study.markdown import table
from tumortrack_lab.study.phantoms import phantom_case

BLOCK = "pretraining"
UNSEEN_SEED = 1_000_003  # of the measured scenes and their library of states
FIGURES = ("first_tre_mm", "worst_first_tre_mm", "tre_mm", "worst_tre_mm", "miou")
TITLES = {
    "first_tre_mm": "error before refinement",
    "worst_first_tre_mm": "its 90th percentile",
    "tre_mm": "error",
    "worst_tre_mm": "its 90th percentile",
    "miou": "mIoU",
}
COLORS = {True: "#0072B2", False: "#D55E00"}


@dataclass(frozen=True)
class Options:
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
    """Where measurements are kept."""
    document: Path = Path("docs/results.md")
    """Whose marked block is replaced."""


def main(options: Options) -> None:
    """Every case and seed, then the block."""
    torch.set_num_threads(1)
    start = load_start(options.start)
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, folder in _cases(options):
        case, judge = load_case(folder), None
        for seed in options.seeds:
            about = {
                "case": name,
                "case_sha256": store.sha256_of(folder / store.MANIFEST),
                "start_sha256": start.sha256,
                "seed": seed,
                "steps": list(options.steps),
                "scenes": options.scenes,
            }
            cell = options.out / f"{name}_{seed}.json"
            if not (cell.is_file() and (known := store.read_json(cell))["about"] == about):
                judge = judge or Judge(case, options.scenes)
                known = {"about": about, "rows": _curve(case, judge, start, seed, options.steps)}
                store.write_json(cell, known)
            rows += [{"case": name, "seed": seed, **row} for row in known["rows"]]
    command = shlex.join(["make", "headstart", f"ARGS={shlex.join(sys.argv[1:])}"])
    about = store.read_manifest(options.start, "pretrained")["provenance"]
    _write(rows, about, ReportWriter(options.document, command))


def _cases(options: Options) -> list[tuple[str, Path]]:
    folder = options.out / "phantom"
    phantom_case(folder, PhantomParameters(), 0.8)
    cases = [("phantom", folder)]
    for text in options.case:
        name, _, given = text.partition("=")
        if not name.isidentifier() or not given or name in dict(cases):
            raise InputError(f"--case {text!r} must be NAME=FOLDER, with a name of its own.")
        cases.append((name, Path(given)))
    return cases


def _curve(
    case: Case, judge: Judge, start: PretrainedWeights, seed: int, lengths: tuple[int, ...]
) -> list[dict]:
    """All trainings of one case and seed, side by side over the same batches."""
    device, config = torch.device("cpu"), clinic(case.anatomy)
    run = TrainingRun(case.anatomy, case.up_lps, "", config, seed, steps=max(*lengths, 1))
    course = RegistrationTask(run, device)
    shape = shape_of(case.anatomy, course.body)
    upright = upright_of(case.anatomy.organ, case.up_lps, shape.body.center_ct, shape.long_axis)
    states: dict[tuple[int, bool], TrainingState] = {}
    for length in lengths:
        for pretrained in (False, True):
            state = TrainingState(replace(run, steps=max(length, 1)), device)
            state.initialize(course.initialize)
            if pretrained:
                state.initialize(lambda network: carry_over(network, start.weights, upright))
            states[length, pretrained] = state
    stream = SceneStream(
        case.anatomy, case.up_lps, config.scene, course.points, seed, "train",
        config.batch_size, course.body,
    )  # fmt: skip
    rows = [_row(judge, shape, state, *arm) for arm, state in states.items() if arm[0] == 0]
    for step, batch in enumerate(batches(stream, range(max(lengths)), 0, 0, device), start=1):
        for (length, pretrained), state in states.items():
            if step <= length:
                state.step(batch)
            if step == length:
                rows.append(_row(judge, shape, state, length, pretrained))
    return rows


def _row(
    judge: Judge, shape: RestShape, state: TrainingState, steps: int, pretrained: bool
) -> dict:
    row = {"steps": steps, "pretrained": pretrained, **judge.figures(state.average, shape)}
    say(" ".join(f"{k}={v if not isinstance(v, float) else round(v, 2)}" for k, v in row.items()))
    return row


class Judge:
    """Scenes of one case with states that no training has seen."""

    def __init__(self, case: Case, scenes: int) -> None:
        config = clinic(case.anatomy)
        body = body_for(case.anatomy, case.up_lps, config.scene, UNSEEN_SEED)
        simulator = Simulator(case.anatomy, case.up_lps, config.scene, body)
        pool = organ_pool(case.anatomy, config.scene.occupancy, UNSEEN_SEED)
        few = msgspec.structs.replace(config, validation_pairs=scenes)
        self._refine = config.refine
        self._scenes: ValidationScenes = validation_scenes(simulator, pool, few, UNSEEN_SEED)

    def figures(self, network: RegistrationNetwork, shape: RestShape) -> dict[str, float]:
        """Target errors (a scene's mean; then the scenes' median and 90th percentile), before and
        after refinement, and mIoU of the refined labels."""
        network.eval()
        scenes = self._scenes
        first, refined, guesses = [], [], []
        for cloud, points_mm, points_ct, labels in zip(
            scenes.clouds_mm, scenes.points_mm, scenes.points_ct, scenes.labels, strict=True
        ):
            motion = Registration(network, shape, self._refine).register(cloud).motion
            inside = labels > 0
            first.append(_error_mm(starts[0], points_ct[inside], points_mm[inside]))
            refined.append(_error_mm(motion, points_ct[inside], points_mm[inside]))
            guesses.append(shape.labels_at(motion.back(points_mm).astype(np.float32))[0])
        parts = len(shape.anatomy_ct.parts) + 1
        return {
            "first_tre_mm": float(np.median(first)),
            "worst_first_tre_mm": float(np.percentile(first, 90)),
            "tre_mm": float(np.median(refined)),
            "worst_tre_mm": float(np.percentile(refined, 90)),
            "miou": mean_iou_of(np.stack(guesses), scenes.labels, parts),
        }


def _error_mm(motion: ElasticMotion, points_ct: np.ndarray, points_mm: np.ndarray) -> float:
    return float(np.linalg.norm(motion.carry(points_ct) - points_mm, axis=1).mean())


def _write(rows: list[dict], about: dict, book: ReportWriter) -> None:
    """The block: one table and picture over all cases."""
    cells: dict[tuple, list[dict]] = {}
    for row in rows:
        cells.setdefault((row["case"], row["steps"], row["pretrained"]), []).append(row)
    head = ["case", "steps", "start", *(TITLES[key] for key in FIGURES)]
    body = [
        [case, f"{steps:,}", "pretrained" if pretrained else "random"]
        + [_text([row[key] for row in cells[case, steps, pretrained]], key) for key in FIGURES]
        for case, steps, pretrained in sorted(cells)
    ]
    image = book.image(BLOCK)
    _draw(cells, image)
    seeds = sorted({row["seed"] for row in rows})
    text = (
        f"`{book.command}`: pretrained for {about['steps']:,} steps on {about['anatomies']} random "
        f"kidneys (seed {about['seed']}, {about['training_s'] / 60:.0f} minutes on a shared "
        f"machine); then each case for so many steps of the preset clinic, seeds "
        f"{', '.join(map(str, seeds))}. Target errors in mm: median and 90th percentile over "
        "scenes with elastic states of a library that no training has seen; ± is the standard "
        "deviation over the seeds."
    )
    picture = f"![error against training steps](images/{image.name})"
    book.write({BLOCK: f"{picture}\n\n{table(head, body, 3)}\n\n{text}"})


def _text(values: list[float], key: str) -> str:
    digits = 2 if key == "miou" else 1
    middle = f"{np.mean(values):.{digits}f}"
    return middle if len(values) < 2 else f"{middle} ± {np.std(values, ddof=1):.{digits}f}"


def _draw(cells: dict[tuple, list[dict]], path: Path) -> None:
    """Error before (dashed) and after refinement against steps, one panel a case."""
    cases = sorted({case for case, _, _ in cells})
    figure = new_figure(4.6 * len(cases), 3.6)
    for number, case in enumerate(cases):
        axes = figure.add_subplot(1, len(cases), number + 1)
        for pretrained, color in COLORS.items():
            lengths = sorted(s for c, s, p in cells if (c, p) == (case, pretrained))
            for key, style in (("first_tre_mm", "--"), ("tre_mm", "-")):
                middle = [np.mean([r[key] for r in cells[case, s, pretrained]]) for s in lengths]
                name = "pretrained" if pretrained else "random start"
                label = name + (", before refinement" if style == "--" else "")
                axes.plot(lengths, middle, style, color=color, marker="o", label=label)
        axes.set_xscale("symlog", linthresh=100)
        axes.set_xticks(lengths, [f"{s:,}" for s in lengths])
        axes.set_yscale("log")
        axes.set_title(case)
        axes.set_xlabel("training steps")
        axes.set_ylabel("median target error (mm)")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    figure.tight_layout()
    save(figure, path)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except TumortrackError as error:
        print(f"pretraining: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("pretraining: stopped; the same command goes on.", file=sys.stderr)
        sys.exit(130)
