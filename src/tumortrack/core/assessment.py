"""What is made of an answer, once: how far off its parts may be, whether it is good, and what to do
about it if it is not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import msgspec

from tumortrack.core.organ import is_tumor
from tumortrack.core.report import Finding, Likely, NextEvidence, Point
from tumortrack.core.wording import for_caller

Quality = Literal["good", "poor", "none"]  # none: there is no estimate
NOT_JUDGED = Finding("not_judged")


class ErrorBound(msgspec.Struct, frozen=True):
    """With 95 % no point of this part, as drawn in the CT, lies farther than ``error_bound95_mm``
    from where it is shown; ``least_sure``: the direction that is least sure (unit vector, camera
    frame), if the method knows one."""

    error_bound95_mm: float
    least_sure: Point | None = None

    @property
    def message(self) -> str:
        return f"off by at most {self.error_bound95_mm:.1f} mm (95 %)"


class Assessment(msgspec.Struct, frozen=True, kw_only=True):
    """What an answer's figures amount to.

    Attributes:
        bounds: by part; absent: not known.
        factor: by which they were multiplied, as found on scenes of known truth (``tumortrack
            margins``).
        finding: why it is poor (see ``assessment.verdict.judged``); None: it is good.
        causes: of a poor one, the most likely first: see ``assessment.causes``.
        advice: sentences after the finding's: what probably happened and what to do.
        next_evidence: what to learn next, the best first.
    """

    bounds: Mapping[str, ErrorBound] = {}
    factor: float = 1.0
    finding: Finding | None = NOT_JUDGED
    causes: tuple[Likely, ...] = ()
    advice: str = ""
    next_evidence: tuple[NextEvidence, ...] = ()

    @property
    def quality(self) -> Quality:
        return "good" if self.finding is None else "poor"

    @property
    def reason(self) -> str:
        """Why it is poor and what to do; empty: it is good."""
        return "" if self.finding is None else self.finding.message + for_caller(self.advice)

    @property
    def factor_words(self) -> str:
        return f"bounds are multiplied by {self.factor:.2f}, as found on scenes of known truth"

    @property
    def shown(self) -> Mapping[str, ErrorBound]:
        """The bounds to be shown: a poor answer has none."""
        return self.bounds if self.finding is None else {}

    def bound_words(self, part: str) -> str:
        """How far off a part is at most; empty: not known, or the answer is poor."""
        return self.shown[part].message if part in self.shown else ""


def deciding(bounds: Mapping[str, ErrorBound]) -> Mapping[str, ErrorBound]:
    """Those of the tumors, or else of the organ."""
    return {name: bound for name, bound in bounds.items() if is_tumor(name)} or bounds


def bound_words(bounds: Mapping[str, ErrorBound]) -> str:
    """How far off the tumors are at most, or else the organ; empty: not known."""
    return ", ".join(f"{name} {bound.message}" for name, bound in deciding(bounds).items())


def centre_label(name: str, bounds: Mapping[str, ErrorBound], poor: bool) -> str:
    """A tumor's name, and how far off it is at most as far as that is known."""
    if poor:
        return f"{name} POOR"
    return f"{name}, {bounds[name].message}" if name in bounds else name
