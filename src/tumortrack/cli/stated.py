"""Whom the user means: the options that say so, and what refuses anybody else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tumortrack.core.errors import InputError
from tumortrack.core.patient import UNKNOWN, Patient


@dataclass(frozen=True, kw_only=True)
class StatedPatient:
    """Options of commands that work on one patient.

    Attributes:
        patient: the patient you mean; what belongs to another or an unknown one is refused.
        side: the side you mean, the patient's own; the other or an unknown one is refused.
    """

    patient: str | None = None
    side: Literal["left", "right"] | None = None

    @property
    def stated(self) -> Patient:
        """Raises InputError for an identifier that is none: of an empty variable in a script, say,
        which must not pass for nothing stated."""
        if self.patient == UNKNOWN:
            raise InputError(f"--patient {UNKNOWN} is nobody. Leave it out, or say who it is.")
        return Patient(UNKNOWN if self.patient is None else self.patient, self.side or UNKNOWN)
