"""Causes of a poor estimate, or of none."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

Cause = Enum(
    "Cause",
    "UNIT FRAME MIRRORED SCALE OBJECT BACKGROUND HIDDEN ANOTHER_PATIENT DEFORMED POSES VIEW",
)


@dataclass(frozen=True)
class Likely:
    """A likely cause. ``number``: the factor of UNIT and SCALE, the share of BACKGROUND and HIDDEN.
    ``fit``: cost of the fit without this cause, relative to the model's usual cost; None: not
    tried."""

    cause: Cause
    number: float | None = None
    fit: float | None = None

    def entry(self) -> dict[str, Any]:
        """JSON, for a report."""
        return {"cause": self.cause.name.lower(), "number": self.number, "fit": self.fit}
