"""A model that registers an elastic body: the organ at rest, and how far to trust its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load, save

from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.models.folder import SHAPE, organ_of, read_tensors
from tumortrack.models.model import Model
from tumortrack.registration.config import RegistrationConfig
from tumortrack.registration.registration import Registration
from tumortrack.registration.rest_shape import RestShape
from tumortrack.registration.search import PosePrior
from tumortrack.simulate.scene import PoseConfig


class UncertaintyCalibration(Config, frozen=True):
    """By scenes whose truth is known: standard deviations are multiplied by ``std_scale``, and nine
    tenths of the right fits cost no more than ``usual_cost``."""

    std_scale: float
    usual_cost: float

    def __post_init__(self) -> None:
        self.check_between("calibration", std_scale=(0.05, 50), usual_cost=(1e-3, 1e6))


@dataclass(frozen=True, eq=False, kw_only=True)
class RegistrationModel(Model):
    """See ``Model``; ``shape`` is the organ of the CT with its elastic body."""

    config: RegistrationConfig
    shape: RestShape
    calibration: UncertaintyCalibration

    @cached_property
    def registration(self) -> Registration:
        """The method, with this model's organ and how it may lie."""
        up_lps = self.provenance["up_lps"]
        return Registration(
            self.shape, self.config.refine, pose_prior(self.config.scene.pose, up_lps)
        )

    def files(self) -> dict[str, bytes]:
        return {SHAPE: save(self.shape.to_arrays())}

    def entries(self) -> dict[str, Any]:
        return {"trust": to_builtins(self.calibration)}

    def synchronise(self) -> None:
        """Nothing runs beside."""

    @classmethod
    def from_folder(cls, folder: Path, manifest: dict[str, Any], **known: Any) -> RegistrationModel:
        config = from_builtins(manifest["config"], RegistrationConfig, f"{folder}: config")
        kind = organ_of(manifest, folder)
        shape = RestShape.from_arrays(read_tensors(folder / SHAPE, load), len(known["parts"]), kind)
        calibration = from_builtins(manifest["trust"], UncertaintyCalibration, f"{folder}: trust")
        up_lps = np.array(known["provenance"]["up_lps"], float)
        if up_lps.shape != (3,) or not np.isclose(np.linalg.norm(up_lps), 1, atol=1e-3):
            raise InputError(f"up_lps {up_lps.tolist()} is no direction.")
        return cls(config=config, shape=shape, calibration=calibration, **known)


def pose_prior(pose: PoseConfig, up_lps: Sequence[float]) -> PosePrior:
    """How an organ may lie, by the poses that scenes show."""
    tilt_degrees = 180.0 if pose.rotations == "full" else pose.tilt_deg
    return PosePrior(np.array(up_lps, float), tilt_degrees)
