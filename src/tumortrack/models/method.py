"""What a method other than the default one offers, and how an installed package adds it.

    [project.entry-points."tumortrack.methods"]
    occupancy = "tumortrack_occupancy.method:METHOD"

The object is a ``Method``. It is loaded where a preset, configuration or model folder of such a
method is used, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from tumortrack.core.errors import InputError, PackageError
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.types import Anatomy, Look
from tumortrack.imaging.case import Case
from tumortrack.models.model import Model, ModelConfig

GROUP = "tumortrack.methods"
Preset = Callable[[Anatomy, Literal["limited", "full"]], Any]  # -> a configuration


@runtime_checkable
class Locator(Protocol):
    """What locates with one model."""

    anatomy_ct: Anatomy | None

    def locate(self, looks: Sequence[Look], grid: int, seed: int) -> Estimate:
        """See ``Tracker.locate``; in the frame of the first look's camera."""

    def follow(self, looks: Sequence[Look], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``Tracker.follow``; likewise."""

    def warm(self) -> None:
        """See ``Tracker.warm``."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How a model is trained; ``api.train`` says what each option means."""

    seed: int = 0
    steps: int | None = None
    minutes: float | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0


@dataclass(frozen=True)
class TrainingStatus:
    """What a training reports while it runs; ``end`` is None while minutes decide."""

    step: int
    end: int | None
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    waiting: float = 0.0  # fraction of the time that was spent waiting for scenes
    warming_up: bool = False  # the learning rate still rises: hardly anything is learnt so far


@runtime_checkable
class Method(Protocol):
    """A method: its presets, its models, how they are trained and how they locate."""

    presets: Mapping[str, Preset]

    def has_config(self, config: object) -> bool:
        """Whether a configuration is one of this method's."""

    def has_model(self, manifest: Mapping[str, Any]) -> bool:
        """Whether a model folder's manifest describes one of this method's models."""

    def train(
        self,
        case: Case,
        folder: Path,
        config: Any,
        options: TrainOptions,
        report: Callable[[TrainingStatus], None],
    ) -> Model:
        """Train into ``folder``, resuming what lies there; see ``api.train``."""

    def load(self, folder: Path, manifest: dict[str, Any], device: str, **known: Any) -> Model:
        """The model of a folder whose fields ``known`` are read already; InputError, KeyError,
        ValueError, RuntimeError or OSError where the folder lacks something."""

    def locator(self, model: Model) -> Locator:
        """Locates with one of this method's models."""

    def hardware(self) -> Sequence[str]:
        """Lines for `doctor`: what of this machine the method can use."""


def method_of_preset(preset: str) -> Method:
    """The method that a preset belongs to. Raises PackageError: it is not installed."""
    return _installed(lambda method: preset in method.presets)


def method_of_config(config: ModelConfig) -> Method:
    """The method that a configuration belongs to. Raises PackageError: it is not installed."""
    return _installed(lambda method: method.has_config(config))


def method_of_folder(manifest: Mapping[str, Any]) -> Method:
    """The method of a model folder. Raises PackageError: it is not installed."""
    return _installed(lambda method: method.has_model(manifest))


def _installed(wanted: Callable[[Method], bool]) -> Method:
    faults, methods = list[str](), list[str]()
    for point in entry_points(group=GROUP):
        try:
            method: Method = point.load()
        except PackageError as error:
            faults.append(str(error))
        except Exception as error:  # a foreign package raises anything
            fault = f"the method {point.name} ({point.value}) cannot be imported: {error}"
            faults.append(f"{fault}. Repair or uninstall its package.")
        else:
            if wanted(method):
                return method
            methods.append(point.name)
    if faults:
        raise PackageError(faults[0])
    if methods:
        raise InputError(f"this is of no method that is installed here ({', '.join(methods)}).")
    raise PackageError(
        "the presets quick and paper need PyTorch, which the default method does not: "
        "pip install tumortrack-occupancy."
    )
