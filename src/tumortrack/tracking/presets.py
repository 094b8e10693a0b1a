"""The presets by name: `elastic` registers the CT's organ, the others classify points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from tumortrack.core.errors import InputError
from tumortrack.core.renamed import attributes_of
from tumortrack.core.types import Anatomy
from tumortrack.registration.base_model import ModelConfig
from tumortrack.registration.config import Rotations, elastic
from tumortrack.registration.method import Preset, method_of_preset
from tumortrack.simulation.noise import CLEAN, SENSORS, Sensor

C = TypeVar("C", bound=ModelConfig)

if not TYPE_CHECKING:
    __getattr__ = attributes_of("tumortrack.presets")
__all__ = ["PRESETS", "elastic", "paper", "quick", "quick_long", "seen_by"]


def quick(anatomy: Anatomy, rotations: Rotations = "limited") -> Any:
    """A slim network's ``TrainConfig``, from tumortrack-occupancy; PackageError without it."""
    return method_of_preset("quick").presets["quick"](anatomy, rotations)


def quick_long(anatomy: Anatomy, rotations: Rotations = "limited") -> Any:
    """``quick`` for hours; likewise."""
    return method_of_preset("quick-long").presets["quick-long"](anatomy, rotations)


def paper(anatomy: Anatomy, rotations: Rotations = "limited") -> Any:
    """The ``TrainConfig`` of the paper's network; likewise."""
    return method_of_preset("paper").presets["paper"](anatomy, rotations)


PRESETS: dict[str, Preset] = {
    "elastic": elastic,
    "quick": quick,
    "quick-long": quick_long,
    "paper": paper,
}


def seen_by(config: C, sensor: Sensor) -> C:
    """The configuration with another sensor's noise. Raises InputError: its scenes have none."""
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
