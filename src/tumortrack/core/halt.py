"""Why arms stand: a kind and its numbers, from which the sentence is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from tumortrack.core.report import Finding

HaltKind = Literal[
    "no_estimate", "poor", "missing", "moved", "over_budget", "no_margin", "planning", "silent",
    "no_plan", "defect", "interrupted", "aborted", "ended", "stopped", "slipped",
]  # fmt: skip
_SENTENCES: dict[HaltKind, str] = {
    "no_estimate": "no estimate: {words}",
    "poor": "poor estimate: {words}",
    "missing": "{part} was not found",
    "moved": "{part} has moved by {off_mm:.1f} mm",
    "over_budget": (
        "{sum_mm:.1f} mm of error, most of it {term} ({term_mm:.1f}), against a margin of "
        "{margin_mm:.1f} mm"
    ),
    "no_margin": "the estimate states no {percent:g} % margin, with which it was planned",
    "planning": "planning anew",
    "silent": "no word from the loop",
    "no_plan": "no new plan: {words}",
    "defect": "internal error, {words}",
    "interrupted": "stopped by the user",
    "aborted": "stopped by the viewer, or a real arm gave up",
    "ended": "tracking has ended",
    "stopped": "{words}",
    "slipped": "the grip slipped, or the estimate is wrong: they differ by {off_mm:.1f} mm",
}
CUT_NOTE = "cut: estimates are of the intact organ"
_WITHOUT_NUMBERS = str.maketrans("", "", "0123456789.")


class Halt(msgspec.Struct, frozen=True):
    """``finding``: of the estimate, where that is the reason. ``cut``: a new plan would help, but
    cutting has begun, and the model knows the intact organ alone."""

    kind: HaltKind
    values: Mapping[str, float | str] = {}
    finding: Finding | None = None
    cut: bool = False

    @property
    def words(self) -> str:
        """For people."""
        words = _SENTENCES[self.kind].format(**self.values)
        return f"{words} ({CUT_NOTE}; --replan-cut plans on them anyway)" if self.cut else words

    @property
    def words_without_numbers(self) -> str:
        """For counts in reports."""
        return self.words.translate(_WITHOUT_NUMBERS)

    @property
    def same_as(self) -> tuple[HaltKind, bool, object]:
        """Equal for halts that differ in their numbers alone."""
        if self.finding is not None:
            return self.kind, self.cut, self.finding.same_as
        texts = tuple(value for value in self.values.values() if isinstance(value, str))
        return self.kind, self.cut, texts
