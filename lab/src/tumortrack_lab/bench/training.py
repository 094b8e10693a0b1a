"""Workloads of training: the scene generator, an optimizer step, a whole training; and of a GPU."""

from __future__ import annotations

import copy
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, cycle, pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from msgspec.structs import replace
from torch.nn import functional

from tumortrack.core.process import keep_freed_memory
from tumortrack.models.hardware import has_fast_bfloat16
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.network import OccupancyNetwork
from tumortrack.simulate.coarse import CoarseConfig, coarsened
from tumortrack.simulate.deform import DragConfig, ElasticConfig
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import FixedPoints, OccupancyConfig, OccupancyPool, PointSource
from tumortrack.simulate.scene import SceneConfig, SceneRecipe, SceneStream, Simulator
from tumortrack.training.model import load_model
from tumortrack.training.state import TrainingRun, TrainingState
from tumortrack.training.train import TrainingStatus, train
from tumortrack_lab.bench.naive import NaiveOccupancy, plain_pair
from tumortrack_lab.bench.occupancy import OccupancyForms, module_flops, weight_bytes
from tumortrack_lab.bench.registration import flow_flops
from tumortrack_lab.bench.rows import GENERATOR, STEP, TRAINING, Work, Workload, timing_of
from tumortrack_lab.bench.subject import LABELLING, SEED, UP, BenchSubject

_LABELS = 2000
_PAIRS = 20  # in one call of ours
_COVERED = 0.25  # of the image, by the organ
_DRAG = 16  # of a point: square, exponential, three products and sums
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
    """States of the organ's elastic body; and the scenes that `clinic` learns from."""
    yield from _generator(subject, "elastic", ElasticConfig(), subject.body)
    ours, full = _learnt_scenes(subject, CoarseConfig(), _PAIRS), _learnt_scenes(subject, None, 1)
    naive_is = "the same with its whole image and surface, each state seen once"
    note = "one thread whatever there is: workers are processes; sensor errors and occlusion too"
    facts = {"note": note}
    yield Workload(GENERATOR, "clinic", "scene", ours, full, naive_is, _PAIRS, facts=lambda: facts)


def _learnt_scenes(
    subject: BenchSubject, coarse: CoarseConfig | None, scenes: int
) -> Callable[[], None]:
    """So many scenes as `clinic` has them, with points to be placed; one after the other."""
    config = subject.presets["clinic"](subject.anatomy)
    anatomy, scene = coarsened(subject.anatomy, config.scene, coarse)
    simulator, index = Simulator(anatomy, UP, scene, subject.body), count()
    points = FixedPoints(subject.anatomy.organ.vertices_mm[:200].astype(np.float32))

    def make() -> None:
        for _ in range(scenes):
            simulator.pair(SceneRecipe(SEED, "train", next(index)), points)

    return make


def _generator(
    subject: BenchSubject, what: str, deform: DragConfig | ElasticConfig, body: ElasticBody | None
) -> Iterator[Workload]:
    anatomy, config = subject.anatomy, OccupancyConfig(per_side=283)
    simulator = Simulator(anatomy, UP, SceneConfig(occupancy=config, deform=(deform,)), body)
    pool, index = OccupancyPool(anatomy, config, SEED), count()

    def ours() -> None:
        for _ in range(_PAIRS):
            simulator.pair(SceneRecipe(SEED, "train", next(index)), pool)

    def naive() -> None:
        plain_pair(anatomy, simulator.render(SceneRecipe(SEED, "train", next(index))), _LABELS)

    def facts() -> dict:
        note = "one thread whatever there is: workers are processes"
        return {"work": _generator_work(simulator, body), "note": note}

    naive_is = "NumPy, a ray a pixel, inside tests on deformed surfaces"
    yield Workload(GENERATOR, what, "pair", ours, naive, naive_is, _PAIRS, facts=facts)


def _generator_work(simulator: Simulator, body: ElasticBody | None) -> Work:
    """Of one pair: points and the organ's surface moved, the surface drawn; vertices, faces,
    image, points and cloud moved through memory once."""
    config, organ = simulator.config, simulator.anatomy_ct.organ
    moved, pixels = len(organ.vertices_mm) + _LABELS, config.width * config.height
    moved_bytes = 2 * 12 * moved + 12 * len(organ.faces) + 4 * pixels + 12 * 1000
    if body is None:
        drags = sum(times for _, _, times in DragConfig().steps)
        flops = float(moved * drags * _DRAG)
    else:  # a field blended of the modes
        flops = float(2 * body.modes.size) + flow_flops(moved)
        moved_bytes += body.modes.nbytes
    # A z-buffer: corners projected and edges set up once a triangle, three edges and a depth worked
    # out at each pixel that the organ covers, about twice.
    flops += 60 * (len(organ.faces) // 2) + 2 * 20 * round(_COVERED * pixels)
    return Work(flops=flops, bytes=float(moved_bytes))


def steps(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """A step of each preset, as training does it; naive: single precision, everything in one
    piece, plain Adam."""
    keep_freed_memory()  # as training does
    for preset in subject.presets:
        state, batches = training_state(subject, preset, _SAMPLES[preset], _BATCHES)
        yield Workload(
            STEP, preset, "step",
            ours=_over(batches, state.step),
            naive=_over(batches, naive_step(state)),
            naive_is="single precision, latent beside every query, Python loops, plain Adam",
            facts=partial(_step_facts, state, batches[0], _SAMPLES[preset]),
        )  # fmt: skip


def _over(batches: list[Batch], step: Callable[[Batch], object]) -> Callable[[], object]:
    turns = cycle(batches)
    return lambda: step(next(turns))


def _step_facts(state: TrainingState, batch: Batch, samples: int) -> dict:
    clouds, *truth = batch
    forward = module_flops(lambda: state.network.loss(clouds, *truth))
    # Backward costs twice the forward pass; Adam reads and writes weights and two moments.
    moved = 7 * weight_bytes(state.network) + 3 * sum(t.nbytes for t in batch)
    precision: Literal["bf16", "fp32"] = "bf16" if has_fast_bfloat16(CPU) else "fp32"
    work = Work(flops=3 * forward, bytes=moved, precision=precision)
    return {"work": work, "per_call": samples, "note": f"{samples} samples a step"}


def training_state(
    subject: BenchSubject, preset: str, size: int, batches: int
) -> tuple[TrainingState, list[Batch]]:
    """Of the preset with so many samples a step, told what it does not have to learn; and so many
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
    seen, scene = coarsened(anatomy, config.scene, config.coarse)
    stream = SceneStream(seen, UP, scene, points, SEED, "train", size, body)
    run = TrainingRun(anatomy, UP, "", config, SEED, steps=_STEPS, device="cpu")
    made = []
    for one in map(stream.batch, range(batches)):
        arrays = one.clouds_mm, one.points_mm, one.labels, one.camera_from_ct
        made.append(tuple(map(torch.from_numpy, arrays)))
    state = TrainingState(run, CPU)
    for network in (state.network, state.average) if known else ():
        for name, buffer in network.named_buffers():
            buffer.copy_(known[name])
    return state, made  # type: ignore[return-value]


def naive_step(state: TrainingState) -> Callable[[Batch], None]:
    """One step in the plain way, on weights of its own."""
    network = copy.deepcopy(state.network).train()
    optimizer = torch.optim.Adam(network.parameters(), 1e-4, foreach=False)
    plain = NaiveOccupancy(network) if isinstance(network, OccupancyNetwork) else None

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


def whole(subject: BenchSubject, budget_s: float) -> Iterator[Workload]:
    """Preset ``quick``."""
    yield _whole_training(subject, "quick", "cpu", budget_s)


def _whole_training(
    subject: BenchSubject, preset: str, device: Device, budget_s: float
) -> Workload:
    """A preset as a user trains it: workers make scenes, the network learns them."""
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
        forms = OccupancyForms(preset, model, subject.cloud(preset).points_mm, device)
        yield from forms.frames()
        yield from forms.volumes()
        yield _whole_training(subject, preset, device, budget_s)
