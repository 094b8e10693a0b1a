"""A network and its training as frozen values: every preset is one ``TrainConfig``."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.models.model import ModelConfig
from tumortrack.simulate.scene import SceneConfig
from tumortrack_occupancy.encoders import EncoderConfig
from tumortrack_occupancy.normalisation import Aligned, CloudBox

_WIDEST = 4096  # of a layer: far beyond use, and a layer's weights still have room


class MlpDecoderConfig(Config, frozen=True, tag="mlp"):
    """``hidden_layers`` of ``width`` with ReLU, then one linear layer to the classes' logits.
    ``skip_layer``: this hidden layer (counted from 1) sees [latent, query] again; None: no skip.
    ``norm_layers``: hidden layers (from 1) with batch norm between linear part and ReLU.
    ``octaves``: k of sin and cos(2^k pi q) that join each raw coordinate q; () for raw alone."""

    n_classes: int
    width: int
    hidden_layers: int
    skip_layer: int | None = None
    norm_layers: tuple[int, ...] = ()
    octaves: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        self.check_between("decoder", width=(1, _WIDEST), hidden_layers=(1, 32))
        allowed = range(1, self.hidden_layers + 1)
        named = (*self.norm_layers, *(() if self.skip_layer is None else (self.skip_layer,)))
        if self.n_classes < 2 or not set(named) <= set(allowed):
            raise InputError(
                f"decoder: layers {named} must lie in 1..{self.hidden_layers}, and there must be "
                "at least 2 classes."
            )


class NetworkConfig(Config, frozen=True):
    """A network as data."""

    encoder: EncoderConfig
    decoder: MlpDecoderConfig
    normalisation: CloudBox | Aligned


class Schedule(Config, frozen=True):
    """Learning rate. ``decay``: linear warm-up, then constant, then cosine to zero over the last
    ``tail`` of the steps; ``exponential``: times ``gamma`` after each ``epoch_pairs`` samples."""

    kind: Literal["decay", "exponential"] = "decay"
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    tail: float = 0.5
    gamma: float = 0.99
    epoch_pairs: int = 31_000


class TrainConfig(ModelConfig, frozen=True):
    """Everything that decides the weights, apart from case, seed and number of steps."""

    network: NetworkConfig
    scene: SceneConfig
    schedule: Schedule
    batch_size: int
    steps: int  # the preset's end
    drop_points: float = 0.0  # each batch loses a random fraction, up to this, of what is encoded
    ema: float = 0.999  # 0: the plain weights are kept
    training_pairs: int = 0  # 0: endless; else scenes repeat after so many
    validation_pairs: int = 64
    validation_points: int = 2048
    validate_every: int = 250  # steps
