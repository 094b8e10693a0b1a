"""The patient and the side of the organ, if known.

Geometry cannot verify either (docs/results.md, "Another kidney"), so both are stated when a case is
made, and copied from there to all that is derived from the case.
"""

from __future__ import annotations

from typing import Final, Literal

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError

UNKNOWN: Final = "unknown"
Side = Literal["left", "right", "unknown"]
_LONGEST = 64  # of a DICOM PatientID (PS3.5, LO)


class Patient(Config, frozen=True):
    """``id``: the DICOM PatientID or an identifier from the user, never name or birth date.
    ``side``: the patient's own left or right."""

    id: str = UNKNOWN
    side: Side = UNKNOWN

    def __post_init__(self) -> None:
        plain = self.id.isprintable() and self.id == self.id.strip()
        if not (plain and 1 <= len(self.id) <= _LONGEST):
            raise InputError(
                f"patient {self.id[: 2 * _LONGEST]!r} is no identifier: it needs 1 to {_LONGEST} "
                "printable characters, without blanks at its ends. Give another with --patient."
            )

    def __str__(self) -> str:
        side = "side unknown" if self.side == UNKNOWN else f"{self.side} side"
        return f"patient {self.id}, {side}"

    @property
    def known(self) -> bool:
        return UNKNOWN not in (self.id, self.side)

    def differs(self, other: Patient) -> bool:
        """Whether id or side, where both are known, are different."""
        pairs = (self.id, other.id), (self.side, other.side)
        return any(ours != theirs for ours, theirs in pairs if UNKNOWN not in (ours, theirs))

    def check_shown(self, model: Patient, what: str) -> None:
        """InputError if ``what`` shows another patient than the model's."""
        if self.differs(model):
            raise InputError(f"{what} shows {self}; the model is of {model}. Give what is of one.")

    def check_is(self, stated: Patient, what: str) -> None:
        """InputError if this, the patient of ``what``, is not known to be the stated one."""
        pairs = (stated.id, self.id), (stated.side, self.side)
        if any(wanted not in (UNKNOWN, actual) for wanted, actual in pairs):
            raise InputError(
                f"{what} is of {self}; you stated {stated}. Give what belongs to that patient and "
                "side. If it is unknown, say whose it is when the case is made: tumortrack prepare "
                "--patient ID --side left|right."
            )


NOBODY = Patient()  # nothing is known


def patient_in(entry: object, where: str) -> Patient:
    """From a file's entry ``patient``; none: unknown. Raises InputError: not a patient."""
    return NOBODY if entry is None else from_builtins(entry, Patient, f"{where}: patient")
