"""A network and its training as frozen values: every preset is one ``TrainConfig``."""

from __future__ import annotations

from typing import Literal

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.models.encoders import EncoderConfig
from tumortrack.models.normalisation import Aligned, CloudBox
from tumortrack.simulate.coarse import CoarseConfig
from tumortrack.simulate.scene import SceneConfig

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


class RegistrationHeadConfig(Config, frozen=True, tag="warp"):
    """Two hidden layers of ``width``, then a rotation, a centre, ``modes`` coefficients and whether
    the cloud lies the right way round. The loss compares the positions of ``points`` points."""

    modes: int
    width: int = 256
    points: int = 96

    def __post_init__(self) -> None:
        sizes = (1, _WIDEST)
        self.check_between("warp", modes=sizes, width=sizes, points=(1, 10**6))


class NetworkConfig(Config, frozen=True):
    """A network as data; which method it serves follows from the kind of its decoder."""

    encoder: EncoderConfig
    decoder: MlpDecoderConfig | RegistrationHeadConfig
    normalisation: CloudBox | Aligned


class GaussNewtonConfig(Config, frozen=True):
    """``n_effective``: independent points in a cloud: errors of neighbours are correlated.
    ``sigma_mm``: of a point that belongs to the organ, model errors included. ``first_mm`` and
    ``last_mm``: the robust kernel's width falls from the one to the other; a point pulls most at
    0.58 of it, and points far beyond do not count. ``shift_mm``, ``turn_rad``: how far a hypothesis
    may be off."""

    steps: int = 20
    n_effective: float = 300.0
    sigma_mm: float = 1.0
    first_mm: float = 5.0
    last_mm: float = 1.0
    narrowing: float = 0.7
    shift_mm: float = 20.0
    turn_rad: float = 0.5
    enough_mm: float = 0.02  # a step that moves less is the last

    def __post_init__(self) -> None:
        self.check_between(
            "refine",
            steps=(0, 1000),
            n_effective=(1, 1e6),
            sigma_mm=(0.01, 100),
            first_mm=(0.01, 1000),
            last_mm=(0.01, 1000),
            narrowing=(0.01, 1),
            shift_mm=(0.01, 1000),
            turn_rad=(0.001, 10),
            enough_mm=(0, 10),
        )


class Schedule(Config, frozen=True):
    """Learning rate. ``decay``: linear warm-up, then constant, then cosine to zero over the last
    ``tail`` of the steps; ``exponential``: times ``gamma`` after each ``epoch_pairs`` samples."""

    kind: Literal["decay", "exponential"] = "decay"
    learning_rate: float = 2e-3
    warmup_steps: int = 100
    tail: float = 0.5
    gamma: float = 0.99
    epoch_pairs: int = 31_000


class TrainConfig(Config, frozen=True):
    """Everything that decides the weights, apart from case, seed and number of steps; ``refine``
    is how an elastic body is fitted to the cloud, in validation and in use."""

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
    refine: GaussNewtonConfig = GaussNewtonConfig()
    coarse: CoarseConfig | None = None  # training scenes; those of validation stay as they are
    steps_from_start: int | None = None  # the preset's end with a head start; None: ``steps``
