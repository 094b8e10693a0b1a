"""A `clinic` model: the network, the organ at rest, and how far its own figures can be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.numpy import load, save

from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.models.folder import SHAPE, organ_of, read_tensors
from tumortrack.models.model import Model
from tumortrack.registration.network import RegistrationNetwork
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import RestShape


class UncertaintyCalibration(Config, frozen=True):
    """What validation scenes taught: standard deviations are multiplied by ``std_scale``; where a
    fit costs more than ``usual_cost``, a search made anew looks all around."""

    std_scale: float
    usual_cost: float

    def __post_init__(self) -> None:
        self.check_between("calibration", std_scale=(0.05, 50), usual_cost=(1e-3, 1e6))


@dataclass(frozen=True, eq=False, kw_only=True)
class RegistrationModel(Model):
    """See ``Model``; ``shape`` is the organ of the CT with its elastic body."""

    new_network = RegistrationNetwork

    network: RegistrationNetwork
    shape: RestShape
    calibration: UncertaintyCalibration

    def registration(self) -> Registration:
        """The method, with this model's network and organ."""
        return Registration(self.network, self.shape, self.config.refine)

    def extra_files(self) -> dict[str, bytes]:
        return {SHAPE: save(self.shape.to_arrays())}

    def extra_entries(self) -> dict[str, Any]:
        return {"trust": to_builtins(self.calibration)}

    @classmethod
    def from_folder(cls, folder: Path, manifest: dict[str, Any], **known: Any) -> RegistrationModel:
        kind = organ_of(manifest, folder)
        shape = RestShape.from_arrays(read_tensors(folder / SHAPE, load), len(known["parts"]), kind)
        calibration = from_builtins(manifest["trust"], UncertaintyCalibration, f"{folder}: trust")
        return cls(shape=shape, calibration=calibration, **known)
