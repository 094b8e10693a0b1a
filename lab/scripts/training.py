"""Batch, learning rate and queries a scene, by the accuracy reached per second.

    make training-speed          (about half an hour on one core)

Every setting trains for the same number of seconds on one core, the making of its scenes
included, and is judged on scenes that no training has seen: of the kinds it was trained on, and of
another kind of deformation. Writes a block of docs/training.md and its picture; measurements are
kept under --out, and what is there is not measured again.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pandas as pd
import torch
from msgspec.structs import replace

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.process import keep_freed_memory
from tumortrack.imaging.case import Case, load_case
from tumortrack.models.config import GaussNewtonConfig, TrainConfig
from tumortrack.models.model import Network
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.phantom.digital import PhantomParameters
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import shape_of
from tumortrack.report.drawing import new_figure, save
from tumortrack.simulate.scene import body_for
from tumortrack.training.presets import PRESETS
from tumortrack.training.state import TrainingRun, TrainingState, settle_end
from tumortrack.training.task import ValidationScenes, label_miou, task_of
from tumortrack_lab.study import trainings
from tumortrack_lab.study.document import ReportWriter, table
from tumortrack_lab.study.methods import phantom_case

BLOCK = "training-speed"
CPU = torch.device("cpu")
BATCHES = (8, 16, 32, 64)
USUAL_BATCH = {"quick": 16, "clinic": 32}
COLORS = dict(zip(BATCHES, ("#D55E00", "#0072B2", "#009E73", "#CC79A7"), strict=True))
SETTING = ["preset", "batch", "per_side", "learning_rate"]


@dataclass(frozen=True, kw_only=True)
class Options(trainings.KeptOptions):
    """Train every setting for the same time, and judge it."""

    seconds: float = 45.0
    """Of training, on one core."""
    seeds: int = 2
    """Of the trainings of quick; clinic has one."""
    scenes: int = 32
    """To judge on, of each kind."""
    looks: int = 5
    """How often a training is judged."""
    out: Path = Path("runs/training")
    document: Path = Path("docs/training.md")


@dataclass(frozen=True)
class Setting:
    """One training: a preset with other numbers."""

    preset: str
    batch: int
    per_side: int
    learning_rate: float
    seed: int

    @property
    def name(self) -> str:
        numbers = (self.batch, self.per_side, f"{self.learning_rate * 1e5:.0f}", self.seed)
        return "_".join(map(str, (self.preset, *numbers)))

    def config(self, case: Case) -> TrainConfig:
        config = PRESETS[self.preset](case.anatomy, "limited")
        occupancy = replace(config.scene.occupancy, per_side=self.per_side)
        return replace(
            config,
            batch_size=self.batch,
            schedule=replace(config.schedule, learning_rate=self.learning_rate),
            scene=replace(config.scene, occupancy=occupancy),
        )


def settings(case: Case, options: Options) -> Iterator[Setting]:
    """The presets' numbers, and one thing changed at a time: the batch at the same learning rate,
    the batch with a learning rate that grows as its root, the queries a scene."""
    for preset, seed in (*(("quick", n) for n in range(options.seeds)), ("clinic", 0)):
        usual = PRESETS[preset](case.anatomy, "limited")
        rate, per_side = usual.schedule.learning_rate, usual.scene.occupancy.per_side
        others = [batch for batch in BATCHES if batch != usual.batch_size]
        rows = [(batch, per_side, rate) for batch in BATCHES]
        rows += [(n, per_side, round(rate * (n / usual.batch_size) ** 0.5, 6)) for n in others]
        rows += [(usual.batch_size, sides, rate) for sides in (32, 128) if preset == "quick"]
        yield from (Setting(preset, *row, seed) for row in rows)


def main(options: Options) -> None:
    """Every setting, then the block."""
    torch.set_num_threads(1)
    keep_freed_memory()
    writer = options.begin(BLOCK, BLOCK)
    folder = phantom_case(options.out / "phantom", PhantomParameters())
    case, rows = load_case(folder), []
    judge = cache(partial(judge_of, case, count=options.scenes))
    for setting in settings(case, options):
        about = {
            "setting": asdict(setting),
            "case_sha256": store.sha256_of(folder / store.MANIFEST),
            **{name: getattr(options, name) for name in ("seconds", "scenes", "looks")},
        }
        measure = partial(_curve, case, setting, judge, options)
        curve = trainings.kept(options.out / f"{setting.name}.json", about, measure)
        rows += [{**asdict(setting), **row} for row in curve]
        say(f"{setting.name}: " + " ".join(f"{k}={round(v, 3)}" for k, v in curve[-1].items()))
    frame = pd.DataFrame(rows)
    frame["both"] = (frame.miou + frame.other_miou) / 2
    _write(frame, options, writer)


def _curve(case: Case, setting: Setting, judges: Callable, options: Options) -> list[dict]:
    """A training of so many seconds; judging does not count."""
    judge = judges(setting.preset)
    config, minutes = setting.config(case), options.seconds / 60
    training = TrainingRun(case.anatomy, case.up_lps, "", config, setting.seed, minutes=minutes)
    task, state = task_of(training, CPU), TrainingState(training, CPU)
    state.initialize(task.initialize)
    progress, curve, spent = state.progress, [], 0.0
    batches, began = trainings.training_batches(training, task, 10**9), time.perf_counter()
    while progress.step != progress.end:
        state.step(next(batches))
        progress.elapsed_s = spent + time.perf_counter() - began
        settle_end(config, progress, training.minutes)
        look_s = options.seconds * (len(curve) + 1) / options.looks
        if progress.step == progress.end or progress.elapsed_s >= look_s:
            spent = progress.elapsed_s
            row = {"seconds": spent, "samples": progress.step * setting.batch}
            curve.append({**row, **judge(state.average)})
            began = time.perf_counter()
    return curve


def judge_of(case: Case, preset: str, count: int) -> Callable[[Network], dict[str, float]]:
    """Mean IoU over the parts, on scenes of the kinds that a preset trains on and on those of
    another kind; of ``clinic`` as the network places the organ, before the refinement, which makes
    up for much that was not learnt."""
    own = PRESETS[preset](case.anatomy, "limited")
    other = PRESETS["clinic" if preset == "quick" else "quick"](case.anatomy, "limited")
    scene = replace(own.scene, deform=other.scene.deform[-1:])
    sets = {
        "miou": trainings.unseen_scenes(case, own, count),
        "other_miou": trainings.unseen_scenes(case, replace(own, scene=scene), count),
    }
    body = body_for(case.anatomy, case.up_lps, own.scene, 0)
    shape = None if body is None else shape_of(case.anatomy, body)

    def miou(network: Network, scenes: ValidationScenes) -> float:
        network.eval()
        if isinstance(network, OccupancyNetwork):
            return label_miou(network, scenes, len(case.anatomy.parts) + 1, CPU)
        method = Registration(network, shape, GaussNewtonConfig())
        motions = (method.propose(cloud)[0] for cloud in scenes.clouds_mm)
        return trainings.placed_miou(motions, shape, scenes)

    return lambda network: {name: miou(network, scenes) for name, scenes in sets.items()}


def _write(frame: pd.DataFrame, options: Options, writer: ReportWriter) -> None:
    last = frame.groupby([*SETTING, "seed"], sort=False).last().reset_index()
    groups = sorted(last.groupby(SETTING, sort=False), key=lambda g: (g[0][0], -g[1].both.mean()))
    body = []
    for (preset, batch, per_side, rate), seeds in groups:
        each = [" / ".join(f"{v:.3f}" for v in seeds[key]) for key in ("miou", "other_miou")]
        speed, sides = (seeds.samples / seeds.seconds).mean(), f"{per_side}"
        sides = sides if preset == "quick" else "-"
        body.append([preset, str(batch), sides, f"{rate:g}", f"{speed:.0f}", *each])
    image = writer.image("training_speed")
    _draw(frame, image)
    text = (
        f"`{writer.command}`: {options.seconds:g} s of training each, on one core, scenes included "
        f"(phantom; judging not counted), then mIoU on {options.scenes} unseen scenes of the "
        f"kinds trained on and on {options.scenes} of another kind (quick: elastic states; "
        "clinic: drags, squeezed and bent); of clinic as its network places the organ, before any "
        "refinement. Several numbers: one a seed. Best first, by the mean of both kinds."
    )
    head = ["preset", "batch", "per side", "learning rate", "samples/s", "mIoU", "other kind"]
    picture = writer.link(image, "mIoU against seconds of training")
    writer.write({BLOCK: f"{picture}\n\n{table(head, body)}\n\n{text}"})


def _draw(frame: pd.DataFrame, path: Path) -> None:
    """The mean of both kinds against seconds, by batch and rate, and by queries a scene."""
    figure = new_figure(13.5, 4.6)
    panels = (("quick", "batch"), ("quick", "queries"), ("clinic", "batch"))
    for number, (preset, what) in enumerate(panels, start=1):
        axes = figure.add_subplot(1, 3, number)
        mine = frame[frame.preset == preset]
        usual = mine[mine.batch == USUAL_BATCH[preset]].iloc[0]
        for (_, _, batch, per_side, rate), curve in mine.groupby(["seed", *SETTING], sort=False):
            by_batch = what == "batch" and per_side == usual.per_side
            alike = (batch, rate) == (usual.batch, usual.learning_rate)
            if not (by_batch or (what == "queries" and alike)):
                continue
            axes.plot(
                curve.seconds, curve.both, "-" if rate == usual.learning_rate else "--",
                color=COLORS[batch] if by_batch else f"C{(32, 64, 128).index(per_side)}",
                marker=".",
                label=f"batch {batch}, rate {rate:g}" if by_batch else f"{per_side} per side",
            )  # fmt: skip
        axes.set(title=f"{preset}: {what}", xlabel="seconds of training, one core")
        axes.set_ylabel("mIoU, mean of both kinds of scenes")
        axes.grid(alpha=0.3)
        # Below: in the picture it covers a line, wherever it stands.
        axes.legend(fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.16))
    figure.tight_layout()
    save(figure, path)


if __name__ == "__main__":
    trainings.run(main, Options)
