"""The training loop, read top to bottom.

Data are addressed by step, the only randomness is drawn from (seed, step), and the state is one
atomic file: a run that is killed and started again ends with the weights of one that was not.
"""

from __future__ import annotations

import hashlib
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import TumortrackError
from tumortrack.core.types import Anatomy
from tumortrack.learn.checkpoint import (
    Progress,
    load_checkpoint,
    optimizer_tensors,
    restore_optimizer,
    save_checkpoint,
)
from tumortrack.learn.config import Schedule, TrainConfig
from tumortrack.learn.model import Model, choose_device, has_fast_bfloat16, save_model
from tumortrack.learn.network import OccupancyNetwork
from tumortrack.learn.validate import ValidationSet
from tumortrack.simulate.dataset import SceneStream
from tumortrack.simulate.occupancy import OccupancyPool

CHECKPOINT_EVERY_S = 30.0
REPORT_EVERY_S = 5.0


@dataclass(frozen=True)
class Run:
    """What to train, on what, for how long. The run ends at ``steps`` or after ``minutes``."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    case_sha256: str
    config: TrainConfig
    seed: int = 0
    steps: int | None = None  # None: the preset's
    minutes: float | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None  # processes that make scenes; None: as the machine allows


@dataclass(frozen=True)
class Status:
    """What the loop tells while it runs."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    message: str = ""


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
    config, device = run.config, choose_device(run.device)
    work = folder / "training"
    work.mkdir(parents=True, exist_ok=True)
    identity = run_identity(run)
    _use_cores(run, device)

    torch.manual_seed(run.seed)
    network = OccupancyNetwork(config.network).to(device)
    average = OccupancyNetwork(config.network).to(device).eval().requires_grad_(False)
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.Adam(
        network.parameters(), config.schedule.learning_rate, weight_decay=config.weight_decay
    )
    progress, best = Progress(end=_known_end(run)), {}
    if (checkpoint := load_checkpoint(work, identity)) is not None:
        progress, groups = checkpoint
        network.load_state_dict(groups["network"])
        average.load_state_dict(groups["average"])
        restore_optimizer(optimizer, groups["optimizer"])
        best = groups.get("best", {})

    pool = OccupancyPool(run.anatomy_ct, config.scene.occupancy, run.seed)
    validation = ValidationSet(run.anatomy_ct, run.up_lps, config, pool, run.seed, device)
    started = time.monotonic() - progress.elapsed_s
    last = dict.fromkeys(("checkpoint", "report"), time.monotonic())
    first_step, first_time, miou = progress.step, time.monotonic(), None

    def keep() -> None:
        groups = {"network": network.state_dict(), "average": average.state_dict(), "best": best}
        groups["optimizer"] = optimizer_tensors(optimizer)
        save_checkpoint(work, progress, groups, identity)

    def validate() -> float:
        nonlocal best
        score = validation.miou(average)
        if score > progress.best_miou:
            progress.best_miou = score
            best = {k: v.clone() for k, v in average.state_dict().items()}
        return score

    with _History(work) as history, _ctrl_c() as stopped:
        for batch in _batches(run, pool, progress):
            loss = _step(run, network, optimizer, batch, progress, device)
            _follow(average, network, config.ema, progress.step)
            progress.step += 1
            now = time.monotonic()
            progress.elapsed_s = now - started
            _settle_end(run, progress)
            done = progress.end is not None and progress.step >= progress.end
            if done or progress.step % config.validate_every == 0:
                miou = validate()
                history.write(progress, loss.item(), miou)
            if stopped() or done or now - last["checkpoint"] > CHECKPOINT_EVERY_S:
                keep()
                last["checkpoint"] = time.monotonic()
            if done or now - last["report"] > REPORT_EVERY_S:
                rate = (progress.step - first_step) / (now - first_time)
                report(_status(run, progress, rate, loss.item(), miou))
                last["report"] = now
            if stopped() and not done:
                raise Interrupted(
                    f"stopped at step {progress.step}; the state is saved in {folder}. The same "
                    "command goes on from there."
                )
            if done:
                break

    average.load_state_dict(best)
    model = Model(
        average,
        config,
        run.anatomy_ct.names,
        validation.query_box_mm,
        {
            "seed": run.seed,
            "steps": progress.step,
            "training_s": round(progress.elapsed_s, 1),
            "validation_miou": round(progress.best_miou, 4),
            "device": _device_name(device),
            "run_sha256": identity,
            "case_sha256": run.case_sha256,
            "up_lps": list(run.up_lps),
        },
    )
    save_model(model, folder)
    return model


def _step(
    run: Run,
    network: OccupancyNetwork,
    optimizer: torch.optim.Optimizer,
    batch: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    progress: Progress,
    device: torch.device,
) -> torch.Tensor:
    config = run.config
    clouds, points, labels = (part.to(device, non_blocking=True) for part in batch)
    # Clouds are in random order: leaving out the last points leaves out random ones.
    share = np.random.default_rng([run.seed, 0xD20, progress.step]).uniform(0, config.drop_points)
    clouds = clouds[:, : max(round(clouds.shape[1] * (1 - share)), 64)]
    for group in optimizer.param_groups:
        group["lr"] = learning_rate(config.schedule, progress, _horizon(run, progress), config)
    network.train()
    with torch.autocast(device.type, torch.bfloat16, enabled=has_fast_bfloat16(device)):
        logits = network.query(network.encode(clouds), points)
    loss = nn.functional.cross_entropy(logits.float().flatten(0, 1), labels.long().flatten())
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
    return loss.detach()


@torch.no_grad()
def _follow(average: nn.Module, network: nn.Module, decay: float, step: int) -> None:
    """Exponential moving average of weights and running statistics; short memory at first."""
    decay = min(decay, (1 + step) / (10 + step))
    mine, theirs = average.state_dict().values(), network.state_dict().values()
    floats = [(m, t) for m, t in zip(mine, theirs, strict=True) if m.is_floating_point()]
    torch._foreach_lerp_([m for m, _ in floats], [t for _, t in floats], 1 - decay)


def learning_rate(
    schedule: Schedule, progress: Progress, horizon: tuple[int, int], config: TrainConfig
) -> float:
    """The rate at a step; ``horizon``: the steps at which the tail begins and ends."""
    peak = schedule.learning_rate
    if schedule.kind == "exponential":
        epoch = progress.step * config.batch_size // schedule.epoch_pairs
        return peak * schedule.gamma**epoch
    warm = min(1.0, (progress.step + 1) / schedule.warmup_steps)
    begin, end = horizon
    through = min(max((progress.step - begin) / max(end - begin, 1), 0.0), 1.0)
    return peak * warm * (0.01 + 0.99 * (1 + math.cos(math.pi * through)) / 2)


def _known_end(run: Run) -> int | None:
    """The last step where it is known from the start: without a limit in minutes."""
    if run.steps is not None:
        return run.steps
    return run.config.steps if run.minutes is None else None


def _settle_end(run: Run, progress: Progress) -> None:
    """With a limit in minutes: when the tail's time has come, fix the step it will end at, from
    the pace so far. From then on the schedule depends on steps alone."""
    if progress.end is not None or run.minutes is None:
        return
    head = 1 - run.config.schedule.tail
    if progress.step >= head * run.config.steps:
        progress.end = run.config.steps
    elif progress.elapsed_s >= head * run.minutes * 60:
        progress.end = max(progress.step + 1, round(progress.step / head))


def _horizon(run: Run, progress: Progress) -> tuple[int, int]:
    end = progress.end if progress.end is not None else 2**62
    return round(end * (1 - run.config.schedule.tail)), end


def _status(run: Run, progress: Progress, rate: float, loss: float, miou: float | None) -> Status:
    if progress.end is not None:
        left = (progress.end - progress.step) / rate
    else:
        left = (run.minutes or 0) * 60 - progress.elapsed_s
        left = min(left, (run.config.steps - progress.step) / rate)
    speed = rate * run.config.batch_size
    return Status(progress.step, progress.end, max(left, 0.0), speed, loss, miou)


class _Batches(Dataset[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]):
    """A scene stream as torch's loader wants it."""

    def __init__(self, stream: SceneStream, period: int) -> None:
        self._stream = stream
        self._period = period

    def __getitem__(self, step: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        batch = self._stream.batch(step % self._period if self._period else step)
        return (
            torch.from_numpy(batch.clouds_mm),
            torch.from_numpy(batch.points_mm),
            torch.from_numpy(batch.labels),
        )


def _batches(
    run: Run, pool: OccupancyPool, progress: Progress
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    config = run.config
    stream = SceneStream(
        run.anatomy_ct, run.up_lps, config.scene, pool, run.seed, "train", config.batch_size
    )
    workers = _workers(run)
    loader = DataLoader(
        _Batches(stream, config.training_pairs // config.batch_size),
        batch_size=None,
        sampler=range(progress.step, run.config.steps if run.steps is None else run.steps),
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=4 if workers else None,
        worker_init_fn=_quiet_worker,
    )
    return iter(loader)


def _workers(run: Run) -> int:
    return run.workers if run.workers is not None else max(1, min(16, _cores() // 2))


def _use_cores(run: Run, device: torch.device) -> None:
    """The network gets the cores that the scene makers leave."""
    if device.type == "cpu":
        torch.set_num_threads(max(1, _cores() - _workers(run)))


def _cores() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _quiet_worker(_: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    torch.set_num_threads(1)


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


class _History:
    """history.jsonl and TensorBoard: one record a validation."""

    def __init__(self, work: Path) -> None:
        self._work = work

    def __enter__(self) -> _History:
        from torch.utils.tensorboard import SummaryWriter

        self._board = SummaryWriter(self._work / "tensorboard")
        self._lines = (self._work / "history.jsonl").open("a", buffering=1)
        return self

    def __exit__(self, *_: object) -> None:
        self._board.close()
        self._lines.close()

    def write(self, progress: Progress, loss: float, miou: float) -> None:
        record = {
            "step": progress.step,
            "elapsed_s": round(progress.elapsed_s, 1),
            "loss": round(loss, 5),
            "validation_miou": round(miou, 4),
        }
        self._lines.write(json.dumps(record) + "\n")
        self._board.add_scalar("loss/train", loss, progress.step)
        self._board.add_scalar("miou/validation", miou, progress.step)


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


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
