"""Rows of training: one optimizer step, and a whole training with its generator."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import cycle, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tumortrack_lab.bench.counts import module_flops, weight_bytes
from tumortrack_lab.bench.row import BenchRow, Work
from tumortrack_lab.bench.turns import in_turns, timing_of

if TYPE_CHECKING:
    import torch

    from tumortrack.models.config import TrainConfig
    from tumortrack.simulate.dataset import Batch as Stacked
    from tumortrack.training.run import TrainingRun
    from tumortrack.training.state import TrainingState
    from tumortrack.training.train import TrainingStatus
    from tumortrack_lab.bench.subject import Subject

NAME, WHOLE = "training step", "training, generator included"
BATCH = {"clinic": 32, "quick": 16, "paper": 8}  # samples in a step here
_BATCHES = 4  # made before and used again
_STEPS = 10**6  # never reached

Device = Literal["cpu", "cuda"]
Batch = tuple["torch.Tensor", "torch.Tensor", "torch.Tensor", "torch.Tensor"]


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """A step of each preset."""
    from tumortrack.core.process import keep_freed_memory

    keep_freed_memory()  # as training does
    for preset in subject.presets:
        yield _row(subject, preset, threads, budget_s / len(subject.presets))


def _row(subject: Subject, preset: str, threads: int, budget_s: float) -> BenchRow:
    """As training does it; naive: single precision, everything in one piece, plain Adam."""
    import torch

    from tumortrack.models.hardware import has_fast_bfloat16
    from tumortrack.training.state import TrainingState

    size = BATCH[preset]
    run, batches, teach = material(subject, preset, size, _BATCHES)
    state = TrainingState(run, torch.device("cpu"))
    teach(state)
    plain = naive_step(state)
    turns, other = cycle(batches), cycle(batches)
    ours, naive = in_turns(
        lambda: state.step(next(turns)), lambda: plain(next(other)), budget_s=budget_s
    )
    clouds, *truth = batches[0]
    forward = module_flops(lambda: state.network.loss(clouds, *truth))
    half = has_fast_bfloat16(torch.device("cpu"))
    return BenchRow(
        name=NAME,
        what=preset,
        threads=threads,
        item="step",
        per_call=size,
        ours=ours,
        naive=naive,
        naive_is="single precision, latent beside every query, Python loops, plain Adam",
        # Backward costs twice the forward pass; Adam reads and writes weights and two moments.
        work=Work(
            flops=3 * forward,
            bytes=7 * weight_bytes(state.network, 4) + 3 * sum(t.nbytes for t in batches[0]),
            precision="bf16" if half else "fp32",
        ),
        note=f"{size} samples a step",
    )


def material(
    subject: Subject, preset: str, size: int, batches: int
) -> tuple[TrainingRun, list[Batch], Callable[[TrainingState], None]]:
    """A run of the preset with so many samples a step, so many of its batches, and how a state is
    told what it does not have to learn."""
    import msgspec

    from tumortrack.simulate.dataset import SceneStream
    from tumortrack.simulate.occupancy import FixedPoints, OccupancyPool, PointSource
    from tumortrack.training.run import TrainingRun
    from tumortrack_lab.bench.subject import SEED, UP

    config = msgspec.structs.replace(subject.config(preset), batch_size=size)
    anatomy, body, known = subject.anatomy, None, {}
    points: PointSource
    if preset == "clinic":
        body, known = subject.body, subject.model(preset).network.state_dict()
        places = (known["points"] + known["center_ct"]).numpy()
        points = FixedPoints(places, np.zeros(len(places), np.uint8))
    else:
        points = OccupancyPool(anatomy, config.scene.occupancy, SEED)
    stream = SceneStream(anatomy, UP, config.scene, points, SEED, "train", config.batch_size, body)
    run = TrainingRun(anatomy, UP, "", config, SEED, steps=_STEPS, device="cpu")
    made = [_tensors(stream.batch(number)) for number in range(batches)]

    def teach(state: TrainingState) -> None:
        for network in (state.network, state.average) if known else ():
            for name, buffer in network.named_buffers():
                buffer.copy_(known[name])

    return run, made, teach


def naive_step(state: TrainingState) -> Callable[[Batch], None]:
    """One step in the plain way, on weights of its own."""
    import copy

    import torch
    from torch.nn import functional

    from tumortrack.occupancy.network import OccupancyNetwork
    from tumortrack_lab.bench.naive.occupancy import NaiveOccupancy

    network = copy.deepcopy(state.network).train()
    optimizer = torch.optim.Adam(network.parameters(), 1e-4, foreach=False)
    plain = None
    if isinstance(network, OccupancyNetwork):
        plain = NaiveOccupancy(network, training=True)

    def step(batch: Batch) -> None:
        clouds, points, labels, poses = batch
        if plain is None:
            loss = network.loss(clouds, points, labels, poses)
        else:
            logits = plain.logits(plain.encode(clouds), points)
            loss = functional.cross_entropy(logits.flatten(0, 1), labels.long().flatten())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def whole_rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """Preset ``quick``."""
    yield whole_row(subject, "quick", "cpu", threads, budget_s)


def whole_row(
    subject: Subject, preset: str, device: Device, threads: int, budget_s: float
) -> BenchRow:
    """A preset as a user trains it: workers, or the GPU itself, make scenes, the network learns
    them."""
    from tumortrack.training.run import TrainingRun
    from tumortrack.training.train import train
    from tumortrack_lab.bench.subject import SEED, UP

    config: TrainConfig = _barely_validated(subject.config(preset))
    seen: list[tuple[float, TrainingStatus]] = []
    run = TrainingRun(subject.anatomy, UP, "", config, SEED, minutes=budget_s / 60, device=device)
    with tempfile.TemporaryDirectory() as folder:
        train(run, Path(folder) / "model", lambda told: seen.append((time.perf_counter(), told)))
    # Between reports, and so without the start; where the end was the first, by the last's word.
    spans = [
        (later - early) / (after.step - before.step)
        for (early, before), (later, after) in pairwise(seen)
        if after.step > before.step
    ]
    return BenchRow(
        name=WHOLE,
        what=preset,
        threads=threads,
        item="step",
        per_call=config.batch_size,
        ours=timing_of(spans or [config.batch_size / seen[-1][1].samples_per_s]),
        note=f"`train` for {budget_s:.0f} s, {config.batch_size} samples a step",
        device=device,
    )


def _barely_validated(config: TrainConfig) -> TrainConfig:
    import msgspec

    return msgspec.structs.replace(config, validation_pairs=4)


def _tensors(batch: Stacked) -> Batch:
    import torch

    return (
        torch.from_numpy(batch.clouds_mm),
        torch.from_numpy(batch.points_mm),
        torch.from_numpy(batch.labels),
        torch.from_numpy(batch.camera_from_ct),
    )
