"""One process of a training as torchrun starts it: FOLDER, and the step where rank 1 dies."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import msgspec
import numpy as np
import trimesh

from tumortrack.core.errors import TumortrackError
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulate.occupancy import OccupancyConfig
from tumortrack.simulate.scene import SceneConfig
from tumortrack.training import state
from tumortrack.training.presets import quick
from tumortrack.training.state import TrainingState
from tumortrack.training.train import TrainingRun, train

STEPS = 6
UP = (0.0, -1.0, 0.0)


def anatomy() -> Anatomy:
    """An egg with a ball in it."""
    sphere = trimesh.creation.icosphere(3)
    parts = [
        Mesh(sphere.vertices * np.array(radii) + centre, sphere.faces)
        for radii, centre in (((25, 20, 45), 0), ((8, 8, 8), 10))
    ]
    return Anatomy(tuple(parts))


def small_run() -> TrainingRun:
    """A few steps of a small ``quick``, in single precision so that a mean of halves is told from
    another sum."""
    state.has_fast_bfloat16 = lambda _: False
    organ = anatomy()
    config = msgspec.structs.replace(
        quick(organ),
        scene=SceneConfig(width=212, height=120, occupancy=OccupancyConfig(per_side=16, pool=4000)),
        batch_size=4,
        validation_pairs=2,
        validation_points=256,
    )
    settings = {"steps": STEPS, "workers": 0, "device": "cpu", "checkpoint_every_s": 0.0}
    return TrainingRun(organ, UP, "no digest", config, **settings)


def die_at(step: int) -> None:
    """Let rank 1 be killed before this step."""
    whole = TrainingState.step

    def partly(self: TrainingState, batch: state.Tensors) -> float:
        if self.progress.step == step and os.environ["RANK"] == "1":
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(self, batch)

    TrainingState.step = partly


if __name__ == "__main__":
    die_at(int(sys.argv[2]))
    try:
        model = train(small_run(), Path(sys.argv[1]), lambda _: print("reported by", os.getpid()))
    except TumortrackError as error:
        sys.exit(f"peer: {error}")
    print("trained", model.provenance["steps"])
