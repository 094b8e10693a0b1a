"""The interface of methods beside the default one, which installed packages add.

A package names an object with the interface ``Method`` in its pyproject.toml, which is loaded only
when a preset, configuration or model folder is not of the default method:

    [project.entry-points."tumortrack.methods"]
    occupancy = "tumortrack_occupancy.method:METHOD"
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from tumortrack.core.errors import InputError, PackageError
from tumortrack.core.estimate import Estimate, FollowOptions
from tumortrack.core.evidence import Evidence
from tumortrack.core.packages import to_install
from tumortrack.core.plugins import plugins
from tumortrack.core.types import Anatomy, View
from tumortrack.io.case import Case
from tumortrack.registration.base_model import Model, ModelConfig

Preset = Callable[[Anatomy, Literal["limited", "full"]], Any]  # rotations -> a ``ModelConfig``


@runtime_checkable
class Locator(Protocol):
    """Locates with one model. ``anatomy_ct``: what the model moves; None if it knows no motion."""

    anatomy_ct: Anatomy | None

    def locate(
        self,
        views: Sequence[View],
        grid: int,
        seed: int,
        evidence: Sequence[Evidence] = (),
        any_pose: bool = False,
    ) -> Estimate:
        """See ``Tracker.locate``. The estimate is in the frame of the first view's camera."""

    def follow(self, views: Sequence[View], last: Estimate | None, how: FollowOptions) -> Estimate:
        """See ``Tracker.follow``. The frame is that of ``locate``."""

    def warm(self) -> None:
        """See ``Tracker.warm``."""


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Options of training; see ``api.train``."""

    seed: int = 0
    steps: int | None = None
    minutes: float | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0


@dataclass(frozen=True)
class TrainingStatus:
    """Progress of a training."""

    step: int
    end: int | None  # the last step; None while a limit in minutes has not fixed it
    seconds_left: float
    samples_per_s: float
    loss: float
    miou: float | None  # of the last validation
    waiting: float = 0.0  # fraction of the time spent waiting for scenes
    warming_up: bool = False  # the learning rate still rises: hardly anything is learnt yet


@runtime_checkable
class Method(Protocol):
    """A method: its presets and models, their training, and localisation with them."""

    presets: Mapping[str, Preset]

    def has_config(self, config: object) -> bool:
        """Whether a configuration belongs to this method."""

    def has_model(self, manifest: Mapping[str, Any]) -> bool:
        """Whether a model folder belongs to this method. Its manifest's ``config`` is what
        ``has_config`` accepts, as JSON. Folders with ``folder.SHAPE`` are the default method's."""

    def train(
        self,
        case: Case,
        folder: Path,
        config: Any,
        options: TrainOptions,
        report: Callable[[TrainingStatus], None],
    ) -> Model:
        """Train into ``folder``, resuming an unfinished training there, and save the model with
        ``folder.save_model``; see ``api.train``."""

    def load(self, folder: Path, manifest: dict[str, Any], device: str, **known: Any) -> Model:
        """The model of a folder. ``known``: the fields of ``Model`` but for ``config``, read
        already. InputError, KeyError, ValueError, RuntimeError or OSError: the folder is
        incomplete."""

    def phantom_model(
        self, preset: str, rotations: Literal["limited", "full"] = "limited"
    ) -> Path | None:
        """The folder of a model of the built-in phantom that the package brings, for a preset."""

    def locator(self, model: Model) -> Locator:
        """For one of this method's models."""

    def hardware(self) -> Sequence[str]:
        """Lines for `doctor`: which of this machine's hardware the method can use."""


def method_of_preset(preset: str) -> Method:
    """The method of a preset; raises as ``method_of_config``."""
    return _installed(f"the preset {preset}", lambda method: preset in method.presets)


def method_of_config(config: ModelConfig) -> Method:
    """The method of a configuration. Raises PackageError: no method is installed, or one that may
    be the right one is broken; InputError: it is of none of the installed methods."""
    name = type(config).__name__
    return _installed(f"the configuration {name}", lambda method: method.has_config(config))


def method_of_folder(manifest: Mapping[str, Any]) -> Method:
    """The method of a model folder, by its manifest; raises as ``method_of_config``."""
    return _installed("the model", lambda method: method.has_model(manifest))


def _installed(what: str, belongs_to: Callable[[Method], bool]) -> Method:
    faults, methods = list[str](), list[str]()
    for each in plugins("methods"):
        if each.fault:
            faults.append(each.refusal)
        elif belongs_to(each.loaded):
            return each.loaded
        else:
            methods.append(each.name)
    if faults:
        raise PackageError(faults[0])
    if methods:
        raise InputError(f"{what} is of no method that is installed here ({', '.join(methods)}).")
    raise PackageError(
        "the presets quick and paper need PyTorch, which the default method does not: "
        f"{to_install('tumortrack-occupancy')}."
    )
