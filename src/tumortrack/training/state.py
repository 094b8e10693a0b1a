"""All that changes while training: weights, their average, the optimizer, the best so far; and the
checkpoint that holds it.

A checkpoint is one file, written atomically: kill -9 loses the steps since the last one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from tumortrack.core.errors import ArtifactError, TumortrackError
from tumortrack.core.store import write_atomically
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.models.model import Network
from tumortrack.simulate.batched.stream import Tensors
from tumortrack.training.distributed import ProcessGroup
from tumortrack.training.model import model_class
from tumortrack.training.run import Run, TrainingProgress, learning_rate

_FILE = "checkpoint.safetensors"


class Diverged(TumortrackError):
    """The loss or a weight is not finite any more; the last checkpoint is from before."""

    def __init__(self, step: int) -> None:
        super().__init__(
            f"training diverged at step {step}: the loss is no finite number. The last checkpoint "
            "is from before; a smaller learning rate or another seed may go through."
        )


class TrainingState:
    """All that changes while training, and nothing else."""

    def __init__(self, run: Run, device: torch.device, group: ProcessGroup | None = None) -> None:
        self.run, self._device = run, device
        self.group = group or ProcessGroup(device)
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

    def initialize(self, initialize: Callable[[Any], None]) -> None:
        """Give both networks what does not have to be learnt."""
        initialize(self.network)
        initialize(self.average)

    def resume(self, work: Path) -> None:
        """Restore the last checkpoint, if there is one; ArtifactError where it is damaged or of
        another run."""
        path = work / _FILE
        if not path.exists():
            return
        groups: dict[str, dict[str, Tensor]] = {}
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                progress = TrainingProgress(**json.loads(metadata["progress"]))
                for key in file.keys():  # noqa: SIM118 - safe_open is no dict
                    group, name = key.split("/", 1)
                    groups.setdefault(group, {})[name] = file.get_tensor(key)
        except (SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
            raise ArtifactError(
                f"{path} is damaged: {error}. Remove {work.parent} and train again."
            ) from error
        if metadata.get("identity") != self.run.identity:
            raise ArtifactError(
                f"{work.parent} holds a run with another case, preset, seed or option. Give the "
                "same command to resume it, or another MODEL folder to start a new one."
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
        """Write the checkpoint. The one before stays where a weight is not finite (Diverged) or the
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
        metadata = {"progress": json.dumps(asdict(self.progress)), "identity": self.run.identity}
        write_atomically(work / _FILE, save(tensors, metadata))

    def step(self, batch: Tensors) -> float:
        """One optimizer step on this process's part of the batch; returns the whole batch's loss.
        Where that is not finite the weights stay as they were, and Diverged is raised."""
        progress = self.progress
        clouds, points, labels, poses = (part.to(self._device, non_blocking=True) for part in batch)
        clouds = clouds[:, : self.points_kept(clouds.shape[1])]
        self.learning_rate = learning_rate(self.run.config, progress)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate
        self.network.train()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            first = self.group.rank * len(clouds)  # in the whole batch
            loss = self.network.loss(clouds, points, labels, poses, first=first)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        value = float(self.group.mean(self.network.parameters(), loss.detach()))
        if not math.isfinite(value):
            raise Diverged(progress.step)
        self.optimizer.step()
        self._update_average()
        progress.step += 1
        return value

    def points_kept(self, n_points: int) -> int:
        """How many of a batch's points this step sees: those that the encoder takes, less a
        random fraction. Clouds are in random order, so that the first ones are a random draw."""
        config = self.run.config
        rng = np.random.default_rng([self.run.seed, 0xD20, self.progress.step])
        dropped = rng.uniform(0, config.drop_points)
        encoded = min(n_points, config.network.encoder.n_points or n_points)
        return max(round(encoded * (1 - dropped)), 64)

    @torch.no_grad()
    def _update_average(self) -> None:
        """Exponential moving average of weights and running statistics; short memory at first."""
        decay = min(self.run.config.ema, (1 + self.progress.step) / (10 + self.progress.step))
        networks = (network.state_dict().values() for network in (self.average, self.network))
        pairs = (pair for pair in zip(*networks, strict=True) if pair[0].is_floating_point())
        averages, weights = zip(*pairs, strict=True)
        torch._foreach_lerp_(averages, weights, 1 - decay)

    def keep_if_best(self, miou: float) -> None:
        if miou > self.progress.best_miou:
            self.progress.best_miou = miou
            self._best = {k: v.clone() for k, v in self.average.state_dict().items()}

    def best_network(self) -> Network:
        """The averaged weights of the best validation."""
        self.average.load_state_dict(self._best)
        return self.average
