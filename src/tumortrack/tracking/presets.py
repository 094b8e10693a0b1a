"""The presets by name: `clinic` registers the organ of the CT, `quick` and `paper` label points."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from tumortrack.core.errors import InputError, PackageError
from tumortrack.core.types import Anatomy
from tumortrack.registration.config import RegistrationConfig
from tumortrack.registration.presets import Rotations, clinic
from tumortrack.sense.noise import CLEAN, SENSORS, Sensor

if TYPE_CHECKING:
    from tumortrack.occupancy.config import TrainConfig

    C = TypeVar("C", RegistrationConfig, TrainConfig)
else:
    C = TypeVar("C")  # the other one's module needs PyTorch

__all__ = ["PRESETS", "clinic", "paper", "quick", "seen_by"]


def occupancy(module: str) -> Any:
    """A module of the paper's method. Raises PackageError: its extra is not installed."""
    if find_spec("torch") is None:
        raise PackageError(
            "the presets quick and paper need PyTorch, which the default method does not: "
            "pip install 'tumortrack[occupancy]'."
        )
    return import_module(f"tumortrack.occupancy.{module}")


def quick(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """See ``occupancy.presets``; PackageError without its extra."""
    return occupancy("presets").quick(anatomy, rotations)


def paper(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """See ``occupancy.presets``; PackageError without its extra."""
    return occupancy("presets").paper(anatomy, rotations)


PRESETS: dict[str, Callable[[Anatomy, Rotations], Any]] = {
    "clinic": clinic,
    "quick": quick,
    "paper": paper,
}


def seen_by(config: C, sensor: Sensor) -> C:
    """The same preset for scenes as another sensor sees them. Raises InputError: its scenes have no
    noise of a sensor."""
    noise = config.scene.noise
    if noise == SENSORS[sensor] or (noise == CLEAN and sensor == "d405"):
        return config
    if noise == CLEAN:
        raise InputError(
            f"--sensor {sensor}: scenes of this preset have no sensor's noise. Leave it out, or "
            "choose the preset quick."
        )
    scene = msgspec.structs.replace(config.scene, noise=SENSORS[sensor])
    return msgspec.structs.replace(config, scene=scene)
