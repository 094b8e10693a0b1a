"""One network trained on many random kidneys: a start for every patient's own training.

Each batch shows one kidney. Its scenes are made at true size, then turned and scaled into the
upright frame that all organs share (``registration.canonical_frame``), so that one network learns
where any organ lies and how it is bent.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

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
from tumortrack.training.model import save_start
from tumortrack.training.run import check_settings, settings_sha256
from tumortrack.training.scenes import Scenes, batches
from tumortrack.training.session import divide_cores, work_folder
from tumortrack.training.state import TrainingState
from tumortrack.training.train import Report, run_steps


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
        check_settings(self, anatomies=1, steps=1, seed=0, workers=0)

    @property
    def identity(self) -> str:
        """sha256 of all that decides the weights."""
        return settings_sha256(self.config, self.seed, self.steps, anatomies=self.anatomies)


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


def pretrain(run: Pretraining, folder: Path, report: Report) -> dict[str, Any]:
    """Train until the end, resuming what lies in ``folder``; leaves a folder of weights, and
    returns its provenance.

    Raises: as ``train``.
    """
    with work_folder(folder) as work:
        device = choose_device(run.device)
        workers = divide_cores(device, run.workers)
        state = TrainingState(run, device)
        state.initialize(initialize_canonical)
        state.resume(work)
        steps = range(state.progress.step, run.steps)
        made = batches(kidney_stream(run).batch, steps, 0, workers, device)
        run_steps(state, Scenes(made, f"{workers} processes"), work, report)
        about = {
            "seed": run.seed,
            "anatomies": run.anatomies,
            "steps": state.progress.step,
            "training_s": round(state.progress.elapsed_s, 1),
            "run_sha256": run.identity,
        }
        save_start(state.average, run.config.network, about, folder)
        return about
