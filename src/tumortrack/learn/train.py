"""The training loop, read top to bottom.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
"""

from __future__ import annotations

import hashlib
import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import StorageError, TumortrackError
from tumortrack.core.types import Anatomy
from tumortrack.learn.allocator import keep_freed_memory
from tumortrack.learn.checkpoint import (
    Progress,
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.history import History
from tumortrack.learn.loader import Tensors, available_cores, batches, default_workers
from tumortrack.learn.model import Model, choose_device, has_fast_bfloat16, save_model
from tumortrack.learn.network import OccupancyNetwork
from tumortrack.learn.schedule import learning_rate, settle_end
from tumortrack.learn.validate import ValidationSet
from tumortrack.simulate.dataset import SceneStream
from tumortrack.simulate.occupancy import OccupancyPool

REPORT_EVERY_S = 5.0


@dataclass(frozen=True)
class Run:
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


@dataclass(frozen=True)
class Status:
    """What the loop tells while it runs; ``end`` is None while minutes decide."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation


class Interrupted(TumortrackError):
    """Ctrl-C: the state is saved, the same command goes on."""

    exit_code = 130


def train(run: Run, folder: Path, report: Callable[[Status], None]) -> Model:
    """Train until the end, resuming what lies in ``folder``; leaves a model folder.

    Raises:
        ArtifactError: ``folder`` holds another run, or a damaged one.
        StorageError: the disk is full; the last checkpoint is whole.
        Interrupted: Ctrl-C; a checkpoint is written.
    """
    config, device, work = run.config, choose_device(run.device), _work_folder(folder)
    workers = default_workers() if run.workers is None else run.workers
    if device.type == "cpu":
        keep_freed_memory()
        torch.set_num_threads(max(1, available_cores() - workers))
    state = _State(run, device)
    state.resume(work)

    pool = OccupancyPool(run.anatomy_ct, config.scene.occupancy, run.seed)
    stream = SceneStream(
        run.anatomy_ct, run.up_lps, config.scene, pool, run.seed, "train", config.batch_size
    )
    validation = ValidationSet(run.anatomy_ct, run.up_lps, config, pool, run.seed, device)
    steps = range(state.progress.step, state.progress.end or config.steps)
    period = config.training_pairs // config.batch_size

    progress, clock, miou = state.progress, _Clock(state.progress), None
    source = closing(batches(stream, steps, period, workers))
    with History(work, progress) as history, _ctrl_c() as stopped, source as loaded:
        for batch in loaded:
            loss = state.step(batch)
            progress.elapsed_s = clock.elapsed()
            settled = settle_end(config, progress, run.minutes)
            done, stop = progress.step == progress.end, stopped()
            if done or progress.step % config.validate_every == 0:
                miou = validation.miou(state.average)
                state.keep_if_best(miou)
                history.write(progress, loss.item(), miou)
            if done or settled or stop or clock.due("checkpoint", run.checkpoint_every_s):
                state.save(work)
            if done or clock.due("report", REPORT_EVERY_S):
                report(_status(run, progress, clock.rate(progress), loss.item(), miou))
            if done:
                break
            if stop:
                raise Interrupted(
                    f"stopped at step {progress.step}; the state is saved in {folder}. The same "
                    "command goes on from there."
                )
    network = state.best_network()
    model = Model(
        network,
        config,
        run.anatomy_ct.names,
        validation.query_box_mm,
        validation.familiar(network),
        _provenance(run, progress, device),
    )
    save_model(model, folder)
    return model


class _State:
    """All that changes while training, and nothing else."""

    def __init__(self, run: Run, device: torch.device) -> None:
        self._run, self._device = run, device
        self._bf16 = has_fast_bfloat16(device)
        config = run.config
        torch.manual_seed(run.seed)
        self.network = OccupancyNetwork(config.network).to(device)
        self.average = OccupancyNetwork(config.network).to(device).eval().requires_grad_(False)
        self.average.load_state_dict(self.network.state_dict())
        self.optimizer = torch.optim.Adam(
            self.network.parameters(),
            config.schedule.learning_rate,
            weight_decay=config.weight_decay,
        )
        end = run.steps or (config.steps if run.minutes is None else None)
        self.progress = Progress(end=end)
        self._best: dict[str, Tensor] = {}

    def resume(self, work: Path) -> None:
        """Take up the last checkpoint, if there is one."""
        found = load_checkpoint(work, run_identity(self._run))
        if found is None:
            return
        self.progress, groups = found
        self.network.load_state_dict(groups["network"])
        self.average.load_state_dict(groups["average"])
        restore_optimizer(self.optimizer, groups["optimizer"])
        self._best = groups.get("best", {})

    def save(self, work: Path) -> None:
        groups = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": optimizer_tensors(self.optimizer),
            "best": self._best,
        }
        save_checkpoint(work, self.progress, groups, run_identity(self._run))

    def step(self, batch: Tensors) -> Tensor:
        """One optimizer step; returns the loss."""
        config, progress = self._run.config, self.progress
        clouds, points, labels = (part.to(self._device, non_blocking=True) for part in batch)
        # Clouds are in random order: leaving out the last points leaves out random ones.
        rng = np.random.default_rng([self._run.seed, 0xD20, progress.step])
        share = rng.uniform(0, config.drop_points)
        encoded = min(clouds.shape[1], config.network.encoder.n_points or clouds.shape[1])
        clouds = clouds[:, : max(round(encoded * (1 - share)), 64)]
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(config, progress)
        self.network.train()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
            logits = self.network.query(self.network.encode(clouds), points)
        loss = nn.functional.cross_entropy(logits.float().flatten(0, 1), labels.long().flatten())
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        self._follow()
        progress.step += 1
        return loss.detach()

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

    def best_network(self) -> OccupancyNetwork:
        """The averaged weights of the best validation."""
        self.average.load_state_dict(self._best)
        return self.average


class _Clock:
    """Time spent in all sessions of a run, and when things are due again."""

    def __init__(self, progress: Progress) -> None:
        self._start, self._first_step = time.monotonic(), progress.step
        self._before = progress.elapsed_s
        self._last: dict[str, float] = {}

    def elapsed(self) -> float:
        return self._before + time.monotonic() - self._start

    def rate(self, progress: Progress) -> float:
        """Steps per second in this session."""
        return (progress.step - self._first_step) / max(time.monotonic() - self._start, 1e-9)

    def due(self, what: str, every_s: float) -> bool:
        now = time.monotonic()
        if now - self._last.setdefault(what, self._start) < every_s:
            return False
        self._last[what] = now
        return True


def _status(run: Run, progress: Progress, rate: float, loss: float, miou: float | None) -> Status:
    left = ((progress.end or run.config.steps) - progress.step) / rate
    if progress.end is None and run.minutes is not None:
        left = min(left, run.minutes * 60 - progress.elapsed_s)
    speed = rate * run.config.batch_size
    return Status(progress.step, progress.end, max(left, 0.0), speed, loss, miou)


def _work_folder(folder: Path) -> Path:
    work = folder / "training"
    try:
        work.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write into {folder}: {error.strerror}.") from error
    return work


@contextmanager
def _ctrl_c() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C and SIGTERM into a question that the loop asks after each step."""
    asked: list[int] = []
    before = {
        number: signal.signal(number, lambda received, _: asked.append(received))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_identity(run: Run) -> str:
    """sha256 of all that decides the weights, so that a resumed run is the same run."""
    content = {
        "case": run.case_sha256,
        "config": to_builtins(run.config),
        "seed": run.seed,
        "steps": run.steps,
        "minutes": run.minutes,
        "schema": store.SCHEMA,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _provenance(run: Run, progress: Progress, device: torch.device) -> dict:
    return {
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
