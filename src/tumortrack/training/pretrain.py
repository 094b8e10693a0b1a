"""One network trained on many random kidneys: a start for every patient's own training.

Each batch shows one kidney. Its scenes are made at true size, then turned and scaled into the
upright frame that all organs share (``registration.canonical_frame``), so that one network learns
where any organ lies and how it is bent.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.models.config import RegistrationHeadConfig
from tumortrack.models.hardware import choose_device
from tumortrack.phantom.kidneys import random_anatomy
from tumortrack.registration import canonical_frame
from tumortrack.registration.rest_shape import long_axis_of
from tumortrack.simulate.coarse import coarsened
from tumortrack.simulate.occupancy import FixedPoints
from tumortrack.simulate.scene import Batch, SceneStream, body_for
from tumortrack.training.model import save_start
from tumortrack.training.scenes import Scenes, batches
from tumortrack.training.state import Pretraining, TrainingState
from tumortrack.training.train import Report, divide_cores, run_steps, work_folder

# Kidneys and tumors of those who are operated on (KiTS19's tumors: arXiv:1904.00445), and beyond.
LENGTHS_MM, TUMORS_MM = (80.0, 150.0), (8.0, 80.0)
RISES_DEG = 50.0  # upper poles lie farther back: by 25, 29 and 41 degrees in three patients


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
        poses, scale = upright.camera_from_upright(camera_from_ct), np.float32(upright.scale)
        return Batch(clouds_mm * scale, points_mm * scale, labels, poses.astype(np.float32))

    @cached_property
    def _organs(self) -> dict[int, tuple[SceneStream, canonical_frame.CanonicalFrame]]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        return {"run": self.run}


def organ_of(run: Pretraining, number: int) -> tuple[SceneStream, canonical_frame.CanonicalFrame]:
    """The scenes and the upright frame of a run's random kidney with this number."""
    seed = int(np.random.default_rng([run.seed, 0x517E, number]).integers(1 << 31))
    config = run.config
    assert isinstance(config.network.decoder, RegistrationHeadConfig)
    anatomy_ct, up_lps = random_anatomy(seed, LENGTHS_MM, TUMORS_MM, RISES_DEG)
    body = body_for(anatomy_ct, up_lps, config.scene, seed)
    if body is None:
        raise InputError("pretraining needs elastic deformations; the configuration has none.")
    organ = anatomy_ct.organ
    upright = canonical_frame.upright_of(organ, up_lps, body.center_ct, long_axis_of(organ))
    generic = canonical_frame.generic_points(config.network.decoder.points)
    fixed = FixedPoints(upright.in_ct(generic).astype(np.float32))
    seen_ct, scene = coarsened(anatomy_ct, config.scene, config.coarse)
    about = seen_ct, up_lps, scene, fixed, run.seed
    return SceneStream(*about, "train", config.batch_size, body), upright


def pretrain(run: Pretraining, folder: Path, report: Report) -> dict[str, Any]:
    """Train until the end, resuming what lies in ``folder``; leaves a folder of weights, and
    returns its provenance. Raises as ``train``."""
    with work_folder(folder) as work:
        device = choose_device(run.device)
        workers = divide_cores(device, run.workers)
        state = TrainingState(run, device)
        state.initialize(canonical_frame.initialize_canonical)
        state.resume(work)
        steps = range(state.progress.step, run.steps)
        made = batches(KidneyStream(run).batch, steps, 0, workers, device)
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
