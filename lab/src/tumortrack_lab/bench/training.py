"""Workloads of training, and of a GPU."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Literal

import torch
from msgspec.structs import replace

from tumortrack.models.method import TrainingStatus
from tumortrack.tracking.model_files import load_model
from tumortrack_lab.bench.occupancy import OccupancyForms
from tumortrack_lab.bench.rows import TRAINING, Workload, timing_of
from tumortrack_lab.bench.subject import SEED, UP, BenchSubject
from tumortrack_occupancy.model import OccupancyModel
from tumortrack_occupancy.presets import paper, quick
from tumortrack_occupancy.training.train import TrainingRun, train

_TRAINED = {"quick": quick, "paper": paper}

Device = Literal["cpu", "cuda"]


def whole(
    subject: BenchSubject, budget_s: float, preset: str = "quick", device: Device = "cpu"
) -> Iterator[Workload]:
    """A preset as a user trains it: workers make scenes, the network learns them."""
    config = replace(_TRAINED[preset](subject.anatomy), validation_pairs=4)
    run = TrainingRun(subject.anatomy, UP, "", config, SEED, minutes=budget_s / 60, device=device)
    seen: list[tuple[float, TrainingStatus]] = []
    with tempfile.TemporaryDirectory() as folder:
        train(run, Path(folder) / "model", lambda now: seen.append((time.perf_counter(), now)))
    # Between reports, and so without the start; where the end was the first, by the last's word.
    spans = [
        (later - early) / (after.step - before.step)
        for (early, before), (later, after) in pairwise(seen)
        if after.step > before.step
    ]
    facts = {
        "per_call": config.batch_size,
        "note": f"`train` for {budget_s:.0f} s, {config.batch_size} samples a step",
        "device": device,
    }
    took = timing_of(spans or [config.batch_size / seen[-1][1].samples_per_s])
    yield Workload(TRAINING, preset, "step", took, facts=lambda: facts)


def on_gpu(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """Those of ``on_device``, if PyTorch sees a GPU; else none."""
    return on_device(subject, "cuda", budget_s) if torch.cuda.is_available() else iter(())


def on_device(
    subject: BenchSubject, device: Device, budget_s: float, trained: str = "paper"
) -> Iterator[Workload]:
    """Frame, volume and training of the paper's network, generator included."""
    model = load_model(subject.model_folder("paper"), device)
    assert isinstance(model, OccupancyModel)
    forms = OccupancyForms(model, subject.cloud.points_mm, device)
    yield from forms.frames()
    yield from forms.volumes()
    yield from whole(subject, budget_s, trained, device)
