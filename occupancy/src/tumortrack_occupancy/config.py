"""Configuration of a network and its training; every preset is a ``TrainConfig``."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.registration.base_model import ModelConfig
from tumortrack.simulation.scene import SceneConfig
from tumortrack_occupancy.encoders import EncoderConfig
from tumortrack_occupancy.normalisation import Aligned, CloudBox

_WIDEST = 4096  # units of a layer: far beyond use, and its weights still fit into memory


class MlpDecoderConfig(Config, frozen=True, tag="mlp"):
    """``hidden_layers`` of ``width`` with ReLU, then a linear layer to the classes' logits. Hidden
    layers are numbered from 1. ``skip_layer``: takes [latent, query] again; None: no skip.
    ``norm_layers``: with batch norm before ReLU. ``octaves``: positional encoding, the k of sin and
    cos(2^k pi q) beside each raw coordinate q; () for raw coordinates alone."""

    n_classes: int
    width: int
    hidden_layers: int
    skip_layer: int | None = None
    norm_layers: tuple[int, ...] = ()
    octaves: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        self.check_between("decoder", width=(1, _WIDEST), hidden_layers=(1, 32))
        allowed = range(1, self.hidden_layers + 1)
        skip = () if self.skip_layer is None else (self.skip_layer,)
        layers = (*self.norm_layers, *skip)
        if self.n_classes < 2 or not set(layers) <= set(allowed):
            raise InputError(
                f"decoder: layers {layers} must lie in 1..{self.hidden_layers}, and there must be "
                "at least 2 classes."
            )


class NetworkConfig(Config, frozen=True):
    """Encoder, decoder, and the frame in which they see points."""

    encoder: EncoderConfig
    decoder: MlpDecoderConfig
    normalisation: CloudBox | Aligned


class Schedule(Config, frozen=True):
    """Learning rate. ``decay``: linear warm-up, constant, then cosine decay over the last ``tail``
    of the steps; ``exponential``: times ``gamma`` after every ``epoch_pairs`` samples."""

    kind: Literal["decay", "exponential"] = "decay"
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    tail: float = 0.5
    gamma: float = 0.99
    epoch_pairs: int = 31_000


class TrainConfig(ModelConfig, frozen=True):
    """All that determines the weights, apart from case, seed and number of steps."""

    network: NetworkConfig
    scene: SceneConfig
    schedule: Schedule
    batch_size: int
    steps: int  # where neither steps nor minutes are given
    cell_mm: float = 0.0  # scenes show an organ of so much larger triangles; 0: the case's
    drop_points: float = 0.0  # largest fraction of a batch's encoded points dropped at random
    ema: float = 0.999  # of the weights; 0: no average
    training_pairs: int = 0  # scenes repeat after so many; 0: never
    validation_pairs: int = 64
    validation_points: int = 2048
    validate_every: int = 250  # steps
