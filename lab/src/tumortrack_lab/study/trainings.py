"""What scripts that train and judge share: unseen scenes, kept rows, the command line."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import msgspec
import numpy as np
import tyro

from tumortrack.core import store
from tumortrack.core.errors import TumortrackError
from tumortrack.imaging.case import Case
from tumortrack.models.config import TrainConfig
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.rest_shape import RestShape
from tumortrack.simulate.occupancy import organ_pool
from tumortrack.simulate.scene import SceneStream, Simulator, body_for
from tumortrack.training.scenes import batches
from tumortrack.training.state import TrainingRun
from tumortrack.training.task import TrainingTask, ValidationScenes, mean_iou_of, validation_scenes
from tumortrack_lab.study.document import ReportWriter

Options = TypeVar("Options")
_UNSEEN_SEED = 1_000_003  # of the judged scenes and their library of states


@dataclass(frozen=True, kw_only=True)
class KeptOptions:
    """What the scripts' options have in common."""

    out: Path
    """Where cases, models and rows are kept."""
    document: Path
    """Whose marked blocks are replaced."""

    def begin(self, target: str, *blocks: str) -> ReportWriter:
        """Make the folder; what writes the document's blocks. Raises InputError: it lacks one."""
        writer = ReportWriter(self.document, make_command(target))
        writer.check(blocks)
        self.out.mkdir(parents=True, exist_ok=True)
        return writer


def unseen_scenes(case: Case, config: TrainConfig, count: int) -> ValidationScenes:
    """Scenes of a configuration that no training has seen, nor the library of their states."""
    body = body_for(case.anatomy, case.up_lps, config.scene, _UNSEEN_SEED)
    simulator = Simulator(case.anatomy, case.up_lps, config.scene, body)
    pool = organ_pool(case.anatomy, config.scene.occupancy, _UNSEEN_SEED)
    few = msgspec.structs.replace(config, validation_pairs=count)
    return validation_scenes(simulator, pool, few, _UNSEEN_SEED)


def training_batches(training: TrainingRun, task: TrainingTask, steps: int) -> Iterator:
    """A training's batches, made here as they are asked for; what has to be compiled is, first."""
    import torch

    stream = SceneStream(
        training.anatomy_ct, training.up_lps, training.config.scene, task.points, training.seed,
        "train", training.config.batch_size, task.body,
    )  # fmt: skip
    stream.batch(0)
    return iter(batches(stream.batch, range(steps), 0, 0, torch.device("cpu")))


def placed_miou(
    motions: Iterable[ElasticMotion], shape: RestShape, scenes: ValidationScenes
) -> float:
    """Mean IoU over the parts, of the labels that an organ so placed in each scene has."""
    guesses = [
        shape.labels_at(motion.back(points_mm).astype(np.float32))[0]
        for motion, points_mm in zip(motions, scenes.points_mm, strict=True)
    ]
    return mean_iou_of(np.stack(guesses), scenes.labels, len(shape.anatomy_ct.parts) + 1)


def kept(path: Path, about: dict, measure: Callable[[], list[dict]]) -> list[dict]:
    """The rows in a file if they were measured by what ``about`` says; else measured now."""
    known = store.read_json(path) if path.is_file() else {}
    if known.get("about") == about and "rows" in known:
        return known["rows"]
    rows = measure()
    store.write_json(path, {"about": about, "rows": rows})
    return rows


def make_command(target: str) -> str:
    """What a block names: the call of make that this run is."""
    given = f" ARGS='{shlex.join(sys.argv[1:])}'" if sys.argv[1:] else ""
    return f"make {target}{given}"


def run(main: Callable[[Options], None], options: type[Options]) -> NoReturn:
    """Run a script by its command line; errors are one line, and the exit code says which."""
    name = Path(sys.argv[0]).stem
    try:
        main(tyro.cli(options))
    except TumortrackError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print(f"{name}: stopped; the same command goes on.", file=sys.stderr)
        sys.exit(130)
    sys.exit(0)
