"""What models of all methods have in common, and what each of them adds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tumortrack.core.config import Config, findings_in
from tumortrack.core.organ import Organ, organ_in
from tumortrack.core.patient import Patient, patient_in
from tumortrack.core.report import Finding
from tumortrack.registration.in_distribution import InDistributionRange

if TYPE_CHECKING:
    from tumortrack.simulation.scene import SceneConfig


class ModelConfig(Config, frozen=True):
    """All that decides a model of any method, apart from case and seed."""

    @property
    def scene(self) -> SceneConfig:
        """What is seen of the organ; a field of each method's configuration."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class Model(ABC):
    """What locates one patient's organ. ``provenance``: seeds, steps, hashes; ``bound_factor``: by
    which error bounds are multiplied, as found on scenes of known truth (1: not tried)."""

    config: ModelConfig
    parts: tuple[str, ...]
    in_distribution: InDistributionRange
    provenance: dict[str, Any] = field(default_factory=dict)
    bound_factor: float = 1.0

    @property
    def patient(self) -> Patient:
        """Whose organ it is made for, as far as it is known."""
        return patient_in(self.provenance.get("patient"), "provenance")

    @property
    def organ(self) -> Organ:
        return organ_in(self.provenance.get("organ"), "provenance")

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What weakens the case that it is made of."""
        return findings_in(self.provenance.get("warnings"), "provenance")

    @abstractmethod
    def files(self) -> dict[str, bytes]:
        """Files of a model folder, by name."""

    def entries(self) -> dict[str, Any]:
        """Entries of the manifest that only this kind has."""
        return {}

    @abstractmethod
    def synchronise(self) -> None:
        """Wait for what runs beside; for clocks."""
