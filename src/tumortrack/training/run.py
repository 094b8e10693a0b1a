"""What a training run is: case, configuration, seed and length; its name and its origin."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any, Literal

import torch

from tumortrack.core import store
from tumortrack.core.config import identity
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.models.config import TrainConfig
from tumortrack.training.model import PretrainedWeights
from tumortrack.training.state import RunSettings, TrainingProgress


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
        check_settings(self, seed=0, steps=1, workers=0)
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"minutes is {self.minutes}; it must be positive.")
        if self.start is not None:
            self.start.check(self.config.network)

    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights, so that a resumed run is the same run."""
        start = {} if self.start is None else {"start": self.start.sha256}
        more = {"case": self.case_sha256, "minutes": self.minutes, **start}
        return settings_sha256(self.config, self.seed, self.steps, **more)


def run_identity(run: TrainingRun) -> str:
    """``run.identity``."""
    return run.identity


def check_settings(run: RunSettings, **smallest: int) -> None:
    """Refuse numbers smaller than these, and impossible times between checkpoints.

    Raises:
        InputError: one of them is out of range.
    """
    for name, least in smallest.items():
        value = getattr(run, name)
        if value is not None and value < least:
            raise InputError(f"{name} is {value}; it must be at least {least}.")
    if not 0 <= run.checkpoint_every_s < float("inf"):
        raise InputError(
            f"--checkpoint-every is {run.checkpoint_every_s}; give seconds, 0 or more."
        )


def settings_sha256(config: TrainConfig, seed: int, steps: int | None, **more: object) -> str:
    """sha256 of the configuration, the seed, the number of steps, and of ``more``."""
    content = {"config": identity(config), "seed": seed, "steps": steps, **more}
    content["schema"] = store.SCHEMA
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def provenance(
    run: TrainingRun, progress: TrainingProgress, device: torch.device
) -> dict[str, Any]:
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
