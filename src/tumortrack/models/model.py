"""What models of both methods have in common, and what each of them adds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from tumortrack.core.organ import Organ, organ_in
from tumortrack.core.patient import Patient, patient_in
from tumortrack.models.in_distribution import InDistributionRange

if TYPE_CHECKING:
    from tumortrack.occupancy.config import TrainConfig
    from tumortrack.registration.config import RegistrationConfig
    from tumortrack.tracking.margins import ModelMargins


@dataclass(frozen=True, eq=False, kw_only=True)
class Model(ABC):
    """What locates one patient's organ. ``provenance``: seeds, steps, hashes; ``margins``: None
    where it was not calibrated."""

    config: RegistrationConfig | TrainConfig  # all that decides it, apart from case and seed
    parts: tuple[str, ...]
    in_distribution: InDistributionRange
    provenance: dict[str, Any] = field(default_factory=dict)
    margins: ModelMargins | None = None

    @property
    def patient(self) -> Patient:
        """Whose organ it is made for, as far as it is known."""
        return patient_in(self.provenance.get("patient"), "provenance")

    @property
    def organ(self) -> Organ:
        """Which organ it is made for."""
        return organ_in(self.provenance.get("organ"), "provenance")

    @abstractmethod
    def files(self) -> dict[str, bytes]:
        """Files of a model folder, by name."""

    def entries(self) -> dict[str, Any]:
        """Entries of the manifest that only this kind has."""
        return {}

    @abstractmethod
    def synchronise(self) -> None:
        """Wait for what runs beside; for clocks."""

    @classmethod
    @abstractmethod
    def from_folder(cls: type[M], folder: Path, manifest: dict[str, Any], **known: Any) -> M:
        """The model of a folder whose fields ``known`` are read already; InputError, KeyError,
        ValueError, RuntimeError or OSError where the folder lacks something."""


M = TypeVar("M", bound=Model)
