"""What a training is: configuration, seed and length; its name, its origin and its schedule."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any, Literal

import torch

from tumortrack.core import store
from tumortrack.core.config import identity
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.models.config import TrainConfig
from tumortrack.training.model import PretrainedWeights

_FLOOR = 0.01  # of the peak learning rate, at the end of the tail


@dataclass(frozen=True)
class TrainingRun:
    """What to train, on what, for how long: to the end of ``steps``, or about ``minutes``."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    case_sha256: str
    config: TrainConfig
    seed: int = 0
    steps: int | None = None  # None: the preset's
    minutes: float | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None  # processes that make scenes; None: as the machine allows
    checkpoint_every_s: float = 30.0
    start: PretrainedWeights | None = None  # of a registration network
    scenes: Literal["auto", "workers", "device"] = "auto"  # who makes them; see ``training.scenes``

    def __post_init__(self) -> None:
        _check(self, seed=0, steps=1, workers=0)
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"minutes is {self.minutes}; it must be positive.")
        if self.start is not None:
            self.start.check(self.config.network)

    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights, so that a resumed run is the same run."""
        start = {} if self.start is None else {"start": self.start.sha256}
        return _sha256(self, case=self.case_sha256, minutes=self.minutes, **start)


@dataclass(frozen=True)
class Pretraining:
    """What to pretrain: on how many random kidneys, for how many steps."""

    config: TrainConfig
    anatomies: int
    steps: int
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0

    minutes = None  # steps alone decide

    def __post_init__(self) -> None:
        _check(self, anatomies=1, steps=1, seed=0, workers=0)

    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights."""
        return _sha256(self, anatomies=self.anatomies)


Run = TrainingRun | Pretraining


def _check(run: Run, **smallest: int) -> None:
    """Refuse numbers smaller than these, and impossible times between checkpoints."""
    for name, least in smallest.items():
        value = getattr(run, name)
        if value is not None and value < least:
            raise InputError(f"{name} is {value}; it must be at least {least}.")
    if not 0 <= run.checkpoint_every_s < float("inf"):
        raise InputError(
            f"--checkpoint-every is {run.checkpoint_every_s}; give seconds, 0 or more."
        )


def _sha256(run: Run, **more: object) -> str:
    content = {"config": identity(run.config), "seed": run.seed, "steps": run.steps, **more}
    content["schema"] = store.SCHEMA
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass
class TrainingProgress:
    """Where a run stands. ``end`` is the step it will stop at; None while minutes decide."""

    step: int = 0
    elapsed_s: float = 0.0
    end: int | None = None
    best_miou: float = -1.0


def provenance(
    run: TrainingRun, progress: TrainingProgress, device: torch.device
) -> dict[str, Any]:
    """What a model's manifest says of its training."""
    about = {
        "seed": run.seed,
        "steps": progress.step,
        "training_s": round(progress.elapsed_s, 1),
        "validation_miou": round(progress.best_miou, 4),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "run_sha256": run.identity,
        "case_sha256": run.case_sha256,
        "up_lps": list(run.up_lps),
    }
    return about if run.start is None else {**about, "start_sha256": run.start.sha256}


def settle_end(config: TrainConfig, progress: TrainingProgress, minutes: float | None) -> bool:
    """With a limit in minutes: fix the last step, from the pace so far, once the schedule's tail
    has to begin; True when that happened now. From then on the schedule depends on steps alone, so
    that a resumed run repeats it."""
    if progress.end is not None or minutes is None:
        return False
    head = 1 - config.schedule.tail
    if progress.step >= head * config.steps:
        progress.end = config.steps
    elif progress.elapsed_s >= head * minutes * 60:
        progress.end = max(progress.step + 1, round(progress.step / head))
    return progress.end is not None


def learning_rate(config: TrainConfig, progress: TrainingProgress) -> float:
    """The learning rate of the step that comes next."""
    schedule, step = config.schedule, progress.step
    peak = schedule.learning_rate
    if schedule.kind == "exponential":
        return peak * schedule.gamma ** (step * config.batch_size // schedule.epoch_pairs)
    warm = min(1.0, (step + 1) / schedule.warmup_steps)
    if progress.end is None:
        return peak * warm
    begin = progress.end * (1 - schedule.tail)
    through = min(max((step - begin) / max(progress.end - begin, 1), 0.0), 1.0)
    return peak * warm * (_FLOOR + (1 - _FLOOR) * (1 + math.cos(math.pi * through)) / 2)
