"""What a training run is: case, configuration, seed and length; its name and its origin."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Literal

import torch

from tumortrack.core import store
from tumortrack.core.config import identity
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.models.config import TrainConfig
from tumortrack.training.checkpoint import TrainingProgress
from tumortrack.training.head_start import HeadStart


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
    start: HeadStart | None = None  # pretrained weights, for warps
    scenes: Literal["auto", "workers", "device"] = "auto"  # who makes them; see ``training.scenes``

    def __post_init__(self) -> None:
        for name, value, fewest in (
            ("seed", self.seed, 0),
            ("steps", self.steps, 1),
            ("workers", self.workers, 0),
        ):
            if value is not None and value < fewest:
                raise InputError(f"{name} is {value}; it must be at least {fewest}.")
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"minutes is {self.minutes}; it must be positive.")
        if not 0 <= self.checkpoint_every_s < float("inf"):
            raise InputError(
                f"--checkpoint-every is {self.checkpoint_every_s}; give seconds, 0 or more."
            )
        if self.start is not None:
            self.start.check(self.config.network)

    @property
    def identity(self) -> str:
        return run_identity(self)


def run_identity(run: TrainingRun) -> str:
    """sha256 of all that decides the weights, so that a resumed run is the same run."""
    content = {
        "case": run.case_sha256,
        "config": identity(run.config),
        "seed": run.seed,
        "steps": run.steps,
        "minutes": run.minutes,
        "schema": store.SCHEMA,
    }
    if run.start is not None:
        content["start"] = run.start.sha256
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def provenance(run: TrainingRun, progress: TrainingProgress, device: torch.device) -> dict:
    about = {
        "seed": run.seed,
        "steps": progress.step,
        "training_s": round(progress.elapsed_s, 1),
        "validation_miou": round(progress.best_miou, 4),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "run_sha256": run_identity(run),
        "case_sha256": run.case_sha256,
        "up_lps": list(run.up_lps),
    }
    return about if run.start is None else {**about, "start_sha256": run.start.sha256}


_FLOOR = 0.01  # of the peak rate, at the end of the tail


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


def settle_end(config: TrainConfig, progress: TrainingProgress, minutes: float | None) -> bool:
    """With a limit in minutes: when the tail's time has come, fix the step that the run will end
    at, from its pace so far; True when that happened now. From then on the schedule depends on
    steps alone, so that a resumed run repeats it."""
    if progress.end is not None or minutes is None:
        return False
    head = 1 - config.schedule.tail
    if progress.step >= head * config.steps:
        progress.end = config.steps
    elif progress.elapsed_s >= head * minutes * 60:
        progress.end = max(progress.step + 1, round(progress.step / head))
    return progress.end is not None
