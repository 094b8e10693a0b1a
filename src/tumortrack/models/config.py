"""What a training run is, as one value."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.occupancy.network import NetworkConfig
from tumortrack.registration.gauss_newton import GaussNewtonConfig
from tumortrack.simulate.scene import SceneConfig


class Schedule(Config, frozen=True):
    """Learning rate over the run.

    ``decay``: linear warm-up, then constant, then cosine to zero over the last ``tail`` of the
    steps; ``exponential``: times ``gamma`` after each ``epoch_pairs`` samples.
    """

    kind: Literal["decay", "exponential"] = "decay"
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    tail: float = 0.5
    gamma: float = 0.99
    epoch_pairs: int = 31_000


class TrainConfig(Config, frozen=True):
    """Everything that decides the weights, apart from case, seed and number of steps; ``refine``
    is how a warp is laid on the cloud, in validation and in use."""

    LATER = ("refine",)

    network: NetworkConfig
    scene: SceneConfig
    schedule: Schedule
    batch_size: int
    steps: int  # the preset's end
    drop_points: float = 0.0  # each batch loses a random share, up to this, of what is encoded
    weight_decay: float = 0.0
    ema: float = 0.999  # 0: the plain weights are kept
    training_pairs: int = 0  # 0: endless; else scenes repeat after so many
    validation_pairs: int = 64
    validation_points: int = 2048
    validate_every: int = 250  # steps
    refine: GaussNewtonConfig = GaussNewtonConfig()
