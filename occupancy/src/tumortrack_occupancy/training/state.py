"""What a training is (configuration, seed, length), all that changes while it runs (weights, their
average, optimizer, best so far), and the checkpoint that holds the latter.

A checkpoint is one file, written atomically: kill -9 loses the steps since the last one.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from tumortrack.core import store
from tumortrack.core.config import check_seed, to_builtins
from tumortrack.core.errors import ArtifactError, InputError, TumortrackError
from tumortrack.core.organ import organ_entry
from tumortrack.core.patient import NOBODY, Patient
from tumortrack.core.types import Anatomy
from tumortrack_occupancy.config import TrainConfig
from tumortrack_occupancy.hardware import has_fast_bfloat16
from tumortrack_occupancy.network import OccupancyNetwork
from tumortrack_occupancy.training.scenes import Tensors

_FILE = "checkpoint.safetensors"
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
    patient: Patient = NOBODY  # whose organ it is

    def __post_init__(self) -> None:
        check_seed(self.seed)
        for name, least in (("steps", 1), ("workers", 0)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{name} is {value}; it must be at least {least}.")
        if not 0 <= self.checkpoint_every_s < float("inf"):
            raise InputError(
                f"--checkpoint-every is {self.checkpoint_every_s}; give seconds, 0 or more."
            )
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise InputError(f"minutes is {self.minutes}; it must be more than 0.")

    @property
    def end(self) -> int | None:
        """The last step; None if a limit in minutes fixes it later."""
        if self.steps is not None:
            return self.steps
        return None if self.minutes is not None else self.config.steps

    @property
    def decided_by(self) -> dict[str, Any]:
        """All that determines the weights, by the options that set it (long values as a sha256).
        Only a run with equal entries may be resumed."""
        config = json.dumps([store.SCHEMA, to_builtins(self.config)], sort_keys=True).encode()
        return {
            "--preset, --rotations, --sensor or the version": hashlib.sha256(config).hexdigest(),
            "--seed": self.seed,
            "--steps": self.steps,
            "CASE": self.case_sha256,
            "--minutes": self.minutes,
        }

    def differences(self, other: Mapping[str, Any]) -> str:
        """In which options the run that was ``decided_by`` the other ones differs; empty if in
        none."""
        options = []
        for name, here in self.decided_by.items():
            there = other.get(name)
            if there == here:
                continue
            if isinstance(there or here, str):  # a sha256
                options.append(name)
            else:
                there, here = ("not given" if value is None else value for value in (there, here))
                options.append(f"{name} ({there} there, {here} here)")
        return ", and in ".join(options)


@dataclass
class TrainingProgress:
    """How far a run is. ``end``: its last step; None while a limit in minutes has not fixed it."""

    step: int = 0
    elapsed_s: float = 0.0
    end: int | None = None
    best_miou: float = -1.0


def provenance(
    run: TrainingRun, progress: TrainingProgress, device: torch.device
) -> dict[str, Any]:
    """What a model's manifest says of its training."""
    return {
        "seed": run.seed,
        "steps": progress.step,
        "training_s": round(progress.elapsed_s, 1),
        "validation_miou": round(progress.best_miou, 4),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
        "decided_by": run.decided_by,
        "case_sha256": run.case_sha256,
        "up_lps": list(run.up_lps),
        "patient": to_builtins(run.patient),
        "organ": organ_entry(run.anatomy_ct.organ_kind),
    }


def fix_last_step(config: TrainConfig, progress: TrainingProgress, minutes: float | None) -> bool:
    """With a limit in minutes: once the schedule's tail has to begin, fix the last step from the
    pace so far; True if that happened now. From then on the schedule depends on steps alone, so
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
    """The learning rate of the next step."""
    schedule, step = config.schedule, progress.step
    peak = schedule.learning_rate
    if schedule.kind == "exponential":
        return peak * schedule.gamma ** (step * config.batch_size // schedule.epoch_pairs)
    warmup = min(1.0, (step + 1) / schedule.warmup_steps)
    if progress.end is None:
        return peak * warmup
    begin = progress.end * (1 - schedule.tail)
    tail = min(max((step - begin) / max(progress.end - begin, 1), 0.0), 1.0)
    return peak * warmup * (_FLOOR + (1 - _FLOOR) * (1 + math.cos(math.pi * tail)) / 2)


class Diverged(TumortrackError):
    """The loss or a weight is not finite any more; the last checkpoint is from before."""

    def __init__(self, step: int) -> None:
        super().__init__(
            f"training diverged at step {step}: the loss is not finite. The last checkpoint "
            "is from before; a smaller learning rate or another seed may go through."
        )


class TrainingState:
    """All that changes while training, and nothing else."""

    def __init__(self, run: TrainingRun, device: torch.device) -> None:
        self.run, self._device = run, device
        self._bf16 = has_fast_bfloat16(device)
        network = run.config.network
        torch.manual_seed(run.seed)
        self.network = OccupancyNetwork(network).to(device)
        self.average = OccupancyNetwork(network).to(device).eval().requires_grad_(False)
        self.average.load_state_dict(self.network.state_dict())
        self.progress = TrainingProgress(end=run.end)
        self._best: dict[str, Tensor] = {}
        self.learning_rate = 0.0  # of the last step

    @cached_property
    def optimizer(self) -> torch.optim.Optimizer:
        """Created at the first step: PyTorch loads its compiler for it, which takes 2 s."""
        config = self.run.config
        return torch.optim.Adam(
            self.network.parameters(),
            config.schedule.learning_rate,
            fused=True,  # a twentieth of the quick step on a CPU
        )

    def resume(self, work: Path) -> None:
        """Restore the last checkpoint, if there is one; ArtifactError if it is damaged or of
        another run."""
        path = work / _FILE
        if not path.exists():
            return
        groups: dict[str, dict[str, Tensor]] = {}
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                progress = TrainingProgress(**json.loads(metadata["progress"]))
                decided_by = dict(json.loads(metadata["decided_by"]))
                for key in file.keys():  # noqa: SIM118 - safe_open is no dict
                    group, name = key.split("/", 1)
                    groups.setdefault(group, {})[name] = file.get_tensor(key)
        except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
            raise ArtifactError(
                f"{path} is damaged: {error}. Remove {work.parent} and train again."
            ) from error
        if differences := self.run.differences(decided_by):
            raise ArtifactError(
                f"{work.parent} holds a run that differs from this command in {differences}. Give "
                "the same command to resume it, or another MODEL folder to start a new one."
            )
        self.progress = progress
        self.network.load_state_dict(groups["network"])
        self.average.load_state_dict(groups["average"])
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in groups["optimizer"].items():
            index, name = key.split(".", 1)
            moments.setdefault(int(index), {})[name] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self._best = groups.get("best", {})

    def save(self, work: Path) -> None:
        """Write the checkpoint. The previous one stays if a weight is not finite (Diverged) or the
        disk is full (StorageError)."""
        if not all(bool(p.isfinite().all()) for p in self.network.parameters()):
            raise Diverged(self.progress.step)
        moments = self.optimizer.state_dict()["state"]  # Adam's, and step counts, by parameter
        groups = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": {f"{n}.{k}": v for n, state in moments.items() for k, v in state.items()},
            "best": self._best,
        }
        tensors = {
            f"{group}/{name}": tensor.detach().cpu().contiguous()
            for group, members in groups.items()
            for name, tensor in members.items()
        }
        metadata = {
            "progress": json.dumps(asdict(self.progress)),
            "decided_by": json.dumps(self.run.decided_by),
        }
        store.write_atomically(work / _FILE, save(tensors, metadata))

    def step(self, batch: Tensors) -> float:
        """One optimizer step; returns the batch's loss. Raises Diverged, with the weights
        unchanged, if that is not finite."""
        progress = self.progress
        clouds, points, labels = (part.to(self._device, non_blocking=True) for part in batch)
        clouds = clouds[:, : self.points_kept(clouds.shape[1])]
        self.learning_rate = learning_rate(self.run.config, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.network.train()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            loss = self.network.loss(clouds, points, labels)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        value = float(loss.detach())
        if not math.isfinite(value):
            raise Diverged(progress.step)
        self.optimizer.step()
        self._update_average()
        progress.step += 1
        return value

    def points_kept(self, n_points: int) -> int:
        """How many points of each cloud this step sees: those that the encoder takes, less a random
        fraction. Clouds are in random order, so that the first points are a random draw."""
        config = self.run.config
        rng = np.random.default_rng([self.run.seed, 0xD20, self.progress.step])
        dropped = rng.uniform(0, config.drop_points)
        encoded = min(n_points, config.network.encoder.n_points or n_points)
        return max(round(encoded * (1 - dropped)), 64)

    @torch.no_grad()
    def _update_average(self) -> None:
        """Exponential moving average of weights and running statistics, with a short memory at
        first."""
        decay = min(self.run.config.ema, (1 + self.progress.step) / (10 + self.progress.step))
        networks = (network.state_dict().values() for network in (self.average, self.network))
        pairs = (pair for pair in zip(*networks, strict=True) if pair[0].is_floating_point())
        averages, weights = zip(*pairs, strict=True)
        torch._foreach_lerp_(averages, weights, 1 - decay)

    def keep_if_best(self, miou: float) -> None:
        if miou > self.progress.best_miou:
            self.progress.best_miou = miou
            self._best = {k: v.clone() for k, v in self.average.state_dict().items()}

    def best_network(self) -> OccupancyNetwork:
        """The averaged weights of the best validation."""
        self.average.load_state_dict(self._best)
        return self.average
