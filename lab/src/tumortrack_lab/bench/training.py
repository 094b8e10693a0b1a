"""Workloads of training: the scene generator, an optimizer step, a whole training; and of a GPU."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from itertools import count, cycle, pairwise
from pathlib import Path
from typing import Literal

import torch
from msgspec.structs import replace

from tumortrack.core.process import keep_freed_memory
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.simulate.deform import DragConfig, ElasticConfig
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import FixedPoints, OccupancyConfig, OccupancyPool, PointSource
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, SceneStream, Simulator
from tumortrack.training.model import load_model
from tumortrack.training.state import TrainingRun, TrainingState
from tumortrack.training.train import TrainingStatus, train
from tumortrack_lab.bench.occupancy import OccupancyForms
from tumortrack_lab.bench.rows import GENERATOR, STEP, TRAINING, Workload, timing_of
from tumortrack_lab.bench.subject import LABELLING, SEED, UP, BenchSubject

_PAIRS = 20  # in one call of ours
_SAMPLES = {"clinic": 32, "quick": 16, "paper": 8}  # in a step here
_BATCHES = 4  # made before and used again
_STEPS = 10**6  # never reached
CPU = torch.device("cpu")

Device = Literal["cpu", "cuda"]
Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def drags(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A pair of depth image (424 x 240) and 2,000 labels, by the paper's drags."""
    return _generator(subject, "drags", DragConfig(), None)


def elastic(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """States of the organ's elastic body."""
    return _generator(subject, "elastic", ElasticConfig(), subject.body)


def _generator(
    subject: BenchSubject, what: str, deform: DragConfig | ElasticConfig, body: ElasticBody | None
) -> Iterator[Workload]:
    anatomy, config = subject.anatomy, OccupancyConfig(per_side=283)
    simulator = Simulator(anatomy, UP, SceneConfig(occupancy=config, deform=(deform,)), body)
    pool, index = OccupancyPool(anatomy, config, SEED), count()

    def ours() -> None:
        for _ in range(_PAIRS):
            simulator.pair(SceneRecipe(SEED, "train", next(index)), pool)

    note = {"note": "one thread whatever there is: workers are processes"}
    yield Workload(GENERATOR, what, "pair", ours, calls=_PAIRS, facts=lambda: note)


def steps(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A step of each preset, as training does it."""
    keep_freed_memory()  # as training does
    for preset in subject.presets:
        state, batches = _training_state(subject, preset, _SAMPLES[preset])
        facts = {"per_call": _SAMPLES[preset], "note": f"{_SAMPLES[preset]} samples a step"}
        ours = partial(_step, state, cycle(batches))
        yield Workload(STEP, preset, "step", ours, facts=partial(dict, facts))


def _step(state: TrainingState, batches: Iterator[Batch]) -> None:
    state.step(next(batches))


def _training_state(
    subject: BenchSubject, preset: str, size: int
) -> tuple[TrainingState, list[Batch]]:
    """Of the preset with so many samples a step, told what it does not have to learn; and some
    of its batches."""
    config = replace(subject.presets[preset](subject.anatomy), batch_size=size)
    anatomy, body, known = subject.anatomy, None, {}
    points: PointSource
    if preset == "clinic":
        body, known = subject.body, subject.model(preset).network.state_dict()
        places = (known["points"] + known["center_ct"]).numpy()
        points = FixedPoints(places)
    else:
        points = OccupancyPool(anatomy, config.scene.occupancy, SEED)
    stream = SceneStream(anatomy, UP, config.scene, points, SEED, "train", size, body)
    run = TrainingRun(anatomy, UP, "", config, SEED, steps=_STEPS, device="cpu")
    made = []
    for one in map(stream.batch, range(_BATCHES)):
        arrays = one.clouds_mm, one.points_mm, one.labels, one.camera_from_ct
        made.append(tuple(map(torch.from_numpy, arrays)))
    state = TrainingState(run, CPU)
    for network in (state.network, state.average) if known else ():
        for name, buffer in network.named_buffers():
            buffer.copy_(known[name])
    return state, made  # type: ignore[return-value]


def whole(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """Preset ``quick``."""
    yield _whole_training(subject, "quick", "cpu", budget_s)


def _whole_training(
    subject: BenchSubject, preset: str, device: Device, budget_s: float
) -> Workload:
    """A preset as a user trains it: workers, or the GPU itself, make scenes, the network learns
    them."""
    config = replace(subject.presets[preset](subject.anatomy), validation_pairs=4)
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
    return Workload(TRAINING, preset, "step", took, facts=lambda: facts)


def on_gpu(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """Those of ``on_device``, if PyTorch sees a GPU; else none."""
    return on_device(subject, "cuda", budget_s) if torch.cuda.is_available() else iter(())


def on_device(subject: BenchSubject, device: Device, budget_s: float) -> Iterator[Workload]:
    """Frame and volume of the presets that label points, and a training of each, generator
    included."""
    for preset in LABELLING:
        model = load_model(subject.model_folder(preset), device)
        assert isinstance(model, OccupancyModel)
        forms = OccupancyForms(preset, model, subject.cloud.points_mm, device)
        yield from forms.frames()
        yield from forms.volumes()
        yield _whole_training(subject, preset, device, budget_s)
