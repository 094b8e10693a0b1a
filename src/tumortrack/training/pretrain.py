"""One network taught on many random kidneys: a start for every patient's own training.

Each batch shows one kidney. Its scenes are made at true size, then turned and scaled into the
upright frame that all organs share (``warp.generic``), so that one network learns where any organ
lies and how it is bent.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from tumortrack.core import store
from tumortrack.core.config import identity
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.models.config import RegistrationHeadConfig, TrainConfig
from tumortrack.models.hardware import choose_device
from tumortrack.phantom.kidneys import random_anatomy
from tumortrack.registration.canonical_frame import (
    CanonicalFrame,
    generic_points,
    initialize_canonical,
    upright_of,
)
from tumortrack.registration.rest_shape import long_axis_of
from tumortrack.simulate.dataset import Batch, SceneStream
from tumortrack.simulate.elastic.body import ElasticBody
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.scene import body_for
from tumortrack.training.checkpoint import work_folder
from tumortrack.training.head_start import save_start
from tumortrack.training.pace import (
    REPORT_EVERY_S,
    Interrupted,
    TrainingClock,
    TrainingStatus,
    ctrl_c,
    use_cores,
)
from tumortrack.training.scenes import batches, default_workers, network_leaves
from tumortrack.training.state import TrainingState


@dataclass(frozen=True)
class Pretraining:
    """What to pretrain: on how many kidneys, for how many steps."""

    config: TrainConfig
    anatomies: int
    steps: int
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0
    minutes: None = field(default=None, init=False)  # steps alone decide

    def __post_init__(self) -> None:
        for name, value, fewest in (
            ("anatomies", self.anatomies, 1),
            ("steps", self.steps, 1),
            ("seed", self.seed, 0),
            ("workers", self.workers, 0),
        ):
            if value is not None and value < fewest:
                raise InputError(f"{name} is {value}; it must be at least {fewest}.")
        if not 0 <= self.checkpoint_every_s < float("inf"):
            raise InputError(
                f"--checkpoint-every is {self.checkpoint_every_s}; give seconds, 0 or more."
            )

    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights."""
        content = {
            "config": identity(self.config),
            "anatomies": self.anatomies,
            "steps": self.steps,
            "seed": self.seed,
            "schema": store.SCHEMA,
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, eq=False)
class UprightStream:
    """A scene stream of one organ in its upright frame; the addressing is the scene stream's."""

    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    body: ElasticBody
    config: TrainConfig
    seed: int

    @cached_property
    def upright(self) -> CanonicalFrame:
        """The organ's upright frame."""
        organ = self.anatomy_ct.organ
        return upright_of(organ, self.up_lps, self.body.center_ct, long_axis_of(organ))

    @cached_property
    def _scenes(self) -> SceneStream:
        decoder = self.config.network.decoder
        assert isinstance(decoder, RegistrationHeadConfig)
        points = self.upright.in_ct(generic_points(decoder.points)).astype(np.float32)
        return SceneStream(
            self.anatomy_ct,
            self.up_lps,
            self.config.scene,
            FixedPoints(points, np.zeros(len(points), np.uint8)),
            self.seed,
            "train",
            self.config.batch_size,
            self.body,
        )

    def batch(self, index: int) -> Batch:
        """The batch with this number, its lengths scaled with the organ's."""
        batch, scale = self._scenes.batch(index), np.float32(self.upright.scale)
        poses = self.upright.camera_from_upright(batch.camera_from_ct)
        return Batch(
            batch.clouds_mm * scale,
            batch.points_mm * scale,
            batch.labels,
            poses.astype(np.float32),
        )


@dataclass(frozen=True, eq=False)
class KidneyStream:
    """Batches of many organs in turn: batch ``i`` shows organ ``i`` modulo their number."""

    organs: tuple[UprightStream, ...]

    def batch(self, index: int) -> Batch:
        """The batch with this number."""
        turn, which = divmod(index, len(self.organs))
        return self.organs[which].batch(turn)


def kidney_stream(run: Pretraining) -> KidneyStream:
    """The random kidneys of a run with their bodies; about a second each."""
    seeds = np.random.default_rng([run.seed, 0x517E]).integers(1 << 31, size=run.anatomies)
    organs = []
    for seed in seeds.tolist():
        anatomy_ct, up_lps = random_anatomy(seed)
        body = body_for(anatomy_ct, up_lps, run.config.scene, seed)
        if body is None:
            raise InputError("pretraining needs elastic deformations; the configuration has none.")
        organs.append(UprightStream(anatomy_ct, up_lps, body, run.config, run.seed))
    return KidneyStream(tuple(organs))


def pretrain(run: Pretraining, folder: Path, report: Callable[[TrainingStatus], None]) -> dict:
    """Train until the end, resuming what lies in ``folder``; leaves a folder of weights, and
    returns its provenance.

    Raises: as ``train``.
    """
    with work_folder(folder) as work:
        return _pretrain(run, folder, work, report)


def _pretrain(
    run: Pretraining, folder: Path, work: Path, report: Callable[[TrainingStatus], None]
) -> dict:
    device = choose_device(run.device)
    workers = default_workers() if run.workers is None else run.workers
    use_cores(device, network_leaves(workers))
    state = TrainingState(run, device)
    state.know(initialize_canonical)
    state.resume(work)
    progress, clock = state.progress, TrainingClock(state.progress)
    steps = range(progress.step, run.steps)
    source = closing(batches(kidney_stream(run), steps, 0, workers, device))
    with ctrl_c() as stopped, source as loaded:
        for batch in loaded:
            loss = state.step(batch)
            progress.elapsed_s = clock.elapsed()
            done, stop = progress.step == run.steps, stopped()
            if done or stop or clock.due("checkpoint", run.checkpoint_every_s):
                state.save(work)
            if done or clock.due("report", REPORT_EVERY_S):
                rate = clock.rate(progress)
                left, speed = (run.steps - progress.step) / rate, rate * run.config.batch_size
                report(TrainingStatus(progress.step, run.steps, left, speed, loss, None))
            if stop and not done:
                raise Interrupted.at(progress.step, folder)
    about = {
        "seed": run.seed,
        "anatomies": run.anatomies,
        "steps": progress.step,
        "training_s": round(progress.elapsed_s, 1),
        "run_sha256": run.identity,
    }
    save_start(state.average, run.config.network, about, folder)
    return about
