"""The organ: its name in files, parts and messages, and its SNOMED CT term. It is stated when a
case is made, and copied from there to all that is derived from the case."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from tumortrack.core.config import Config, from_builtins, to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.patient import UNKNOWN, Patient
from tumortrack.core.tables import read_table

_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_CODE = re.compile(r"[1-9][0-9]{5,17}")
_TAKEN = (  # names of files, topics and report entries that are not parts
    *("camera", "case", "cloud", "depth", "estimate", "labels", "map", "observed", "occupancy"),
    *("points", "quality", "state", "status", "strokes", "targets", "workcell"),
)
_TERMS = read_table("tumortrack.core", "organs.toml", dict[str, tuple[str, str]])
KNOWN = frozenset(_TERMS)  # names
_UNNAMED = ("113343008", "Organ")
_IN_PAIRS = ("adrenal_gland", "breast", "kidney", "lung", "ovary", "testis")


class Organ(Config, frozen=True):
    """``name``: lower-case letters, digits and _. ``term``: SNOMED CT code and meaning; None: the
    known one for that name, or a general organ's. Raises InputError for others."""

    name: str = "kidney"
    term: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        check_name(self.name, "the organ", "--name")
        if self.term is not None:
            code, meaning = self.term
            allowed = meaning.isprintable() and not set(meaning) & set("^~|")
            if not (_CODE.fullmatch(code) and allowed and 0 < len(meaning) < 65):
                raise InputError(
                    f"term {code!r} {meaning!r} is none: give a SNOMED CT code, 6 to 18 digits, "
                    'and its meaning, up to 64 characters (--term 10200004 "Liver").'
                )

    @property
    def snomed(self) -> tuple[str, str]:
        """Code and meaning."""
        return self.term or _TERMS.get(self.name, _UNNAMED)

    def doubts(self) -> list[str]:
        """A note on a name that is unknown and has no term: it may be misspelt."""
        if self.term or self.name in _TERMS:
            return []
        similar = get_close_matches(self.name, _TERMS, 1)
        question = f"did you mean --name {similar[0]}? If not, " if similar else ""
        return [
            f"{self.name!r} is not an organ that is known here: {question}give its SNOMED code "
            "with --term CODE MEANING, or it is a plain Organ in segmentations"
        ]

    @property
    def words(self) -> str:
        return self.name.replace("_", " ")

    @property
    def in_pairs(self) -> bool:
        return self.name in _IN_PAIRS

    def check_side(self, side: str | None) -> None:
        """InputError for a side of an organ that is known to be single."""
        if side not in (None, UNKNOWN) and self.name in _TERMS and not self.in_pairs:
            raise InputError(f"--side {side}: there is one {self.words} only. Leave --side out.")

    def identified(self, patient: Patient) -> bool:
        """Whether the patient is known and, for organs in pairs, the side."""
        return patient.known or (patient.id != UNKNOWN and not self.in_pairs)


def check_name(name: str, what: str, option: str) -> None:
    """InputError for a name that is not allowed for a part or structure."""
    if not _NAME.fullmatch(name) or is_tumor(name) or name in _TAKEN or name.endswith("_margin"):
        raise InputError(
            f"{name!r} can't be the name of {what}: it needs 1 to 32 lower-case letters, digits or "
            "_ and a letter first; it must not begin with tumor or end with _margin, and "
            f"{', '.join(_TAKEN)} are taken. Give another with {option}."
        )


def is_tumor(name: str) -> bool:
    """Whether a part with this name is a tumor (tumor_1, tumor_2, ...)."""
    return name.startswith("tumor")


KIDNEY = Organ()


def organ_name(parts: Iterable[str]) -> str | None:
    """The organ's name among those of parts; None: only tumors."""
    return next((name for name in parts if not is_tumor(name)), None)


def organ_first(parts: Iterable[str]) -> list[str]:
    """Sorted, but with the organ before its tumors."""
    return sorted(parts, key=lambda name: (is_tumor(name), name))


def organ_in(entry: object, where: str) -> Organ:
    """From a file's entry ``organ``; none: a kidney. Raises InputError: not an organ."""
    return KIDNEY if entry is None else from_builtins(entry, Organ, f"{where}: organ")


def organ_entry(organ: Organ) -> dict[str, Any]:
    """A file's entry ``organ``: the name, and the SNOMED CT code and meaning."""
    return to_builtins(Organ(name=organ.name, term=organ.snomed))
