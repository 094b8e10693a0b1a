"""One network trained on many random kidneys: a start for every patient's own training.

Each batch shows one kidney. Its scenes are made at true size, then turned and scaled into the
upright frame that all organs share (``registration.canonical_frame``), so that one network learns
where any organ lies and how it is bent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save
from torch import nn

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.models.config import NetworkConfig, RegistrationHeadConfig, TrainConfig
from tumortrack.models.folder import WEIGHTS
from tumortrack.models.hardware import choose_device
from tumortrack.registration.canonical_frame import (
    FIELDS,
    UPRIGHT_MM,
    CanonicalFrame,
    generic_fields,
    generic_points,
    upright_of,
)
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.rest_shape import long_axis_of
from tumortrack.simulate.coarse import coarsened
from tumortrack.simulate.deform import ElasticConfig
from tumortrack.simulate.elastic.body import BodyConfig
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.scene import Batch, SceneStream, body_for
from tumortrack.training.model import PRETRAINED
from tumortrack.training.presets import Rotations, clinic_rules
from tumortrack.training.scenes import Scenes, batches
from tumortrack.training.state import Run, TrainingState, check_run
from tumortrack.training.train import Report, divide_cores, run_steps, work_folder
from tumortrack_lab.pretraining.kidneys import random_anatomy

# Kidneys and tumors of those who are operated on (KiTS19's tumors: arXiv:1904.00445), and beyond.
LENGTHS_MM, TUMORS_MM = (80.0, 150.0), (8.0, 80.0)
RISES_DEG = 50.0  # upper poles lie farther back: by 25, 29 and 41 degrees in three patients
_BODY = BodyConfig(cells=500, modes=24, responses=120, patches=250, states=200)

Poses = Float[np.ndarray, "b 4 4"]


@dataclass(frozen=True)
class Pretraining(Run):
    """What to pretrain: on how many random kidneys, for how many steps."""

    config: TrainConfig
    anatomies: int
    steps: int
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0

    minutes = None  # steps alone decide

    def __post_init__(self) -> None:
        check_run(self, anatomies=1, steps=1, workers=0)

    @property
    def end(self) -> int:
        return self.steps

    @property
    def decided_by(self) -> dict[str, Any]:
        return {**super().decided_by, "--anatomies": self.anatomies}


def pretraining(rotations: Rotations = "limited") -> TrainConfig:
    """The scenes and network of ``clinic``, for many organs in their common frame, each with a
    small elastic body that takes half a second to build."""
    return clinic_rules(ElasticConfig(body=_BODY), FIELDS, UPRIGHT_MM, rotations)


@dataclass(frozen=True, eq=False)
class KidneyStream:
    """Batches of a run's random kidneys in turn, each in its upright frame: batch ``i`` shows
    kidney ``i`` modulo their number. A kidney is made with its body, in about a second, where it is
    first shown. Picklable."""

    run: Pretraining

    def batch(self, index: int) -> Batch:
        """The batch with this number, its lengths scaled with the organ's."""
        turn, which = divmod(index, self.run.anatomies)
        if which not in self._organs:
            self._organs[which] = organ_of(self.run, which)
        stream, upright = self._organs[which]
        clouds_mm, points_mm, labels, camera_from_ct = stream.batch(turn)
        poses, scale = camera_from_upright(upright, camera_from_ct), np.float32(upright.scale)
        return Batch(clouds_mm * scale, points_mm * scale, labels, poses.astype(np.float32))

    @cached_property
    def _organs(self) -> dict[int, tuple[SceneStream, CanonicalFrame]]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        return {"run": self.run}


def organ_of(run: Pretraining, number: int) -> tuple[SceneStream, CanonicalFrame]:
    """The scenes and the upright frame of a run's random kidney with this number."""
    seed = int(np.random.default_rng([run.seed, 0x517E, number]).integers(1 << 31))
    config = run.config
    assert isinstance(config.network.decoder, RegistrationHeadConfig)
    anatomy_ct, up_lps = random_anatomy(seed, LENGTHS_MM, TUMORS_MM, RISES_DEG)
    body = body_for(anatomy_ct, up_lps, config.scene, seed)
    if body is None:
        raise InputError("pretraining needs elastic deformations; the configuration has none.")
    organ = anatomy_ct.organ
    upright = upright_of(organ, up_lps, body.center_ct, long_axis_of(organ))
    generic = generic_points(config.network.decoder.points)
    fixed = FixedPoints(upright.in_ct(generic).astype(np.float32))
    seen_ct, scene = coarsened(anatomy_ct, config.scene, config.coarse)
    about = seen_ct, up_lps, scene, fixed, run.seed
    return SceneStream(*about, "train", config.batch_size, body), upright


def camera_from_upright(upright: CanonicalFrame, camera_from_ct: Poses) -> Poses:
    """Poses of the upright organ before a camera whose lengths are scaled likewise."""
    poses = np.tile(np.eye(4), (len(camera_from_ct), 1, 1))
    rotation = camera_from_ct[:, :3, :3]
    poses[:, :3, :3] = rotation @ upright.facing.T
    poses[:, :3, 3] = upright.scale * (rotation @ upright.center_ct + camera_from_ct[:, :3, 3])
    return poses


def pretrain(run: Pretraining, folder: Path, report: Report) -> dict[str, Any]:
    """Train until the end, resuming what lies in ``folder``; leaves a folder of weights, and
    returns its provenance. Raises as ``train``."""
    with work_folder(folder) as work:
        device = choose_device(run.device)
        workers = divide_cores(device, run.workers)
        state = TrainingState(run, device)
        state.initialize(_tell_what_is_placed)
        state.resume(work)
        steps = range(state.progress.step, run.steps)
        made = batches(KidneyStream(run).batch, steps, 0, workers, device)
        run_steps(state, Scenes(made, f"{workers} processes"), work, report)
        about = {
            "seed": run.seed,
            "anatomies": run.anatomies,
            "steps": state.progress.step,
            "training_s": round(state.progress.elapsed_s, 1),
            "decided_by": run.decided_by,
        }
        save_start(state.average, run.config.network, about, folder)
        return about


def _tell_what_is_placed(network: RegistrationNetwork) -> None:
    """The points and fields of any organ."""
    points = generic_points(len(network.points))
    network.points.copy_(torch.as_tensor(points.astype(np.float32)))
    network.modes.copy_(torch.as_tensor(generic_fields(points).astype(np.float32)))


def save_start(
    network: nn.Module, config: NetworkConfig, provenance: dict[str, Any], folder: Path
) -> None:
    """Write weights, in half precision, and manifest into an existing folder, the manifest last;
    ``training.model.load_start`` reads it."""
    halves = {k: v.detach().cpu().half().contiguous() for k, v in network.state_dict().items()}
    store.write_atomically(folder / WEIGHTS, save(halves))
    options = " ".join(f"--{k} {provenance[k]}" for k in ("anatomies", "steps", "seed"))
    about = {**provenance, "command": f"tumortrack pretrain OUT {options}"}
    content = {"provenance": about, "config": to_builtins(config)}
    store.seal(folder, PRETRAINED, content, frame="camera")
