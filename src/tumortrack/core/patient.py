"""Whose organ it is: a patient and a side, as far as they are known.

Geometry cannot verify either (docs/results.md, "Another kidney"), so both are stated once, where a
case is made, and travel from there to everything that is made of it.
"""

from __future__ import annotations

from typing import Final, Literal

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError

UNKNOWN: Final = "unknown"
Side = Literal["left", "right", "unknown"]
_LONGEST = 64  # of a DICOM PatientID (PS3.5, LO)


class Patient(Config, frozen=True):
    """``id``: as DICOM's PatientID or whatever the user calls the patient; never name or birth
    date. ``side``: the patient's own left or right."""

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
        """Both are."""
        return UNKNOWN not in (self.id, self.side)

    def differs(self, other: Patient) -> bool:
        """Whether they cannot be the same, as far as both are known."""
        pairs = (self.id, other.id), (self.side, other.side)
        return any(one != two for one, two in pairs if UNKNOWN not in (one, two))

    def check_shown(self, model: Patient, what: str) -> None:
        """Raises InputError where what is shown is known to be of another than the model."""
        if self.differs(model):
            raise InputError(f"{what} shows {self}; the model is of {model}. Give what is of one.")

    def check_is(self, stated: Patient, what: str) -> None:
        """Raises InputError where this, the patient of ``what``, is not known to be the stated
        one, in all that was stated."""
        pairs = (stated.id, self.id), (stated.side, self.side)
        if any(wanted not in (UNKNOWN, mine) for wanted, mine in pairs):
            raise InputError(
                f"{what} is of {self}; you stated {stated}. Give what belongs to that patient and "
                "side. If it is unknown, say whose it is when the case is made: tumortrack prepare "
                "--patient ID --side left|right."
            )


NOBODY = Patient()  # nothing is known


def patient_in(found: object, where: str) -> Patient:
    """What a file says under ``patient``; nothing: unknown. InputError where it is no patient."""
    return NOBODY if found is None else from_builtins(found, Patient, f"{where}: patient")
