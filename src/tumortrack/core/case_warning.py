"""What weakens a case for good, by kind and values: it stands in the case's manifest, and every
answer made with the case repeats it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from tumortrack.core.errors import InputError
from tumortrack.core.tables import read_table

_SAID = read_table("tumortrack.core", "case_warnings.toml", dict[str, str])


class CaseWarning(str):
    """The sentence, so that it can stand among notes, and what it is made of."""

    kind: str
    values: Mapping[str, float | str]

    def __new__(cls, kind: str, **values: float | str) -> CaseWarning:
        made = super().__new__(cls, _SAID[kind].format(**values))
        made.kind, made.values = kind, values
        return made

    @property
    def entry(self) -> dict[str, Any]:
        """For JSON; see ``warnings_in``."""
        return {"kind": self.kind, "values": dict(self.values)}


def warnings_in(entries: Iterable[Mapping[str, Any]] | None, where: str) -> tuple[CaseWarning, ...]:
    """From a file's entries; none: of a version that knew no warnings. Raises InputError."""
    try:
        return tuple(CaseWarning(e["kind"], **e["values"]) for e in entries or ())
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: its warnings are no warnings of this version.") from error
