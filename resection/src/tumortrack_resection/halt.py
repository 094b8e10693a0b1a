"""Why arms stand: a kind and its numbers, from which the sentence is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from tumortrack.core.errors import TumortrackError
from tumortrack.core.report import Finding
from tumortrack.core.tables import read_table

HaltKind = Literal[
    "no_estimate", "poor", "missing", "moved", "over_budget", "no_bound", "planning", "silent",
    "no_plan", "defect", "interrupted", "aborted", "ended", "stopped", "slipped", "restless",
]  # fmt: skip
_SENTENCES = read_table("tumortrack_resection", "halts.toml", dict[HaltKind, str])
_WITHOUT_NUMBERS = str.maketrans("", "", "0123456789.")


class Aborted(TumortrackError):
    """Arms were stopped for good before they had finished."""

    exit_code = 3


class Halt(msgspec.Struct, frozen=True):
    """``finding``: of the estimate, where that is the reason."""

    kind: HaltKind
    values: Mapping[str, float | str] = {}
    finding: Finding | None = None

    @property
    def message(self) -> str:
        return _SENTENCES[self.kind].format(**self.values)

    @property
    def words_without_numbers(self) -> str:
        return self.message.translate(_WITHOUT_NUMBERS)

    @property
    def same_as(self) -> tuple[HaltKind, object]:
        """Equal for halts that differ in their numbers alone."""
        if self.finding is not None:
            return self.kind, self.finding.same_as
        texts = tuple(value for value in self.values.values() if isinstance(value, str))
        return self.kind, texts
