"""All that changes while training: weights, their average, the optimizer, the best so far."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from tumortrack.core.errors import TumortrackError
from tumortrack.models.config import TrainConfig
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.model import Network
from tumortrack.training.checkpoint import (
    TrainingProgress,
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from tumortrack.training.distributed import ProcessGroup
from tumortrack.training.model import model_class
from tumortrack.training.run import learning_rate
from tumortrack.training.scenes import Tensors


class Diverged(TumortrackError):
    """The loss or a weight is no number any more; the last checkpoint is from before."""

    def __init__(self, step: int) -> None:
        super().__init__(
            f"training diverged at step {step}: the loss is no finite number. The last checkpoint "
            "is from before; a smaller learning rate or another seed may go through."
        )


class RunSettings(Protocol):
    """What the state has to know of a run."""

    @property
    def config(self) -> TrainConfig: ...
    @property
    def seed(self) -> int: ...
    @property
    def steps(self) -> int | None: ...
    @property
    def minutes(self) -> float | None: ...
    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights."""
        ...


class TrainingState:
    """All that changes while training, and nothing else."""

    def __init__(
        self, run: RunSettings, device: torch.device, ranks: ProcessGroup | None = None
    ) -> None:
        self._run, self._device = run, device
        self._ranks = ranks or ProcessGroup(device)
        self._bf16 = has_fast_bfloat16(device)
        config = run.config
        torch.manual_seed(run.seed)
        new_network = model_class(config.network).new_network
        self.network = new_network(config.network).to(device)
        self.average = new_network(config.network).to(device).eval().requires_grad_(False)
        self.average.load_state_dict(self.network.state_dict())
        self.optimizer = torch.optim.Adam(
            self.network.parameters(),
            config.schedule.learning_rate,
            weight_decay=config.weight_decay,
            fused=True,  # a twentieth of the quick step on a CPU
        )
        end = run.steps or (config.steps if run.minutes is None else None)
        self.progress = TrainingProgress(end=end)
        self._best: dict[str, Tensor] = {}
        self.learning_rate = 0.0  # of the last step

    def know(self, teach: Callable[[Any], None]) -> None:
        """Give both networks what does not have to be learnt."""
        teach(self.network)
        teach(self.average)

    def resume(self, work: Path) -> None:
        """Take up the last checkpoint, if there is one."""
        found = load_checkpoint(work, self._run.identity)
        if found is None:
            return
        self.progress, groups = found
        self.network.load_state_dict(groups["network"])
        self.average.load_state_dict(groups["average"])
        restore_optimizer(self.optimizer, groups["optimizer"])
        self._best = groups.get("best", {})

    def save(self, work: Path) -> None:
        """Write the checkpoint.

        Raises:
            Diverged: a weight is no number; the checkpoint before stays.
            StorageError: the disk is full; the checkpoint before stays.
        """
        if not all(bool(p.isfinite().all()) for p in self.network.parameters()):
            raise Diverged(self.progress.step)
        groups = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": optimizer_tensors(self.optimizer),
            "best": self._best,
        }
        save_checkpoint(work, self.progress, groups, self._run.identity)

    def step(self, batch: Tensors) -> float:
        """One optimizer step on this process's share of the batch; returns the whole one's loss.

        Raises:
            Diverged: the loss is no number; the weights are as they were.
            RankLost: another process of this training has ended.
        """
        config, progress = self._run.config, self.progress
        clouds, points, labels, poses = (part.to(self._device, non_blocking=True) for part in batch)
        clouds = clouds[:, : self.points_kept(clouds.shape[1])]
        self.learning_rate = learning_rate(config, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.network.train()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            first = self._ranks.rank * len(clouds)  # in the whole batch
            loss = self.network.loss(clouds, points, labels, poses, first=first)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        value = float(self._ranks.mean(self.network.parameters(), loss.detach()))
        if not math.isfinite(value):
            raise Diverged(progress.step)
        self.optimizer.step()
        self._follow()
        progress.step += 1
        return value

    def points_kept(self, n_points: int) -> int:
        """How many of a batch's points this step sees: those that the encoder takes, less a
        random share. Clouds are in random order, so that the first ones are a random draw."""
        config = self._run.config
        rng = np.random.default_rng([self._run.seed, 0xD20, self.progress.step])
        share = rng.uniform(0, config.drop_points)
        encoded = min(n_points, config.network.encoder.n_points or n_points)
        return max(round(encoded * (1 - share)), 64)

    @torch.no_grad()
    def _follow(self) -> None:
        """Exponential moving average of weights and running statistics; short memory at first."""
        decay = min(self._run.config.ema, (1 + self.progress.step) / (10 + self.progress.step))
        pairs = zip(
            self.average.state_dict().values(), self.network.state_dict().values(), strict=True
        )
        floats = [(mine, theirs) for mine, theirs in pairs if mine.is_floating_point()]
        torch._foreach_lerp_([m for m, _ in floats], [t for _, t in floats], 1 - decay)

    def keep_if_best(self, miou: float) -> None:
        if miou > self.progress.best_miou:
            self.progress.best_miou = miou
            self._best = {k: v.clone() for k, v in self.average.state_dict().items()}

    def best_network(self) -> Network:
        """The averaged weights of the best validation."""
        self.average.load_state_dict(self._best)
        return self.average
