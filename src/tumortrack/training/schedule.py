"""How long a run lasts and how its learning rate goes."""

from __future__ import annotations

import math

from tumortrack.models.config import TrainConfig
from tumortrack.training.checkpoint import TrainingProgress

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
