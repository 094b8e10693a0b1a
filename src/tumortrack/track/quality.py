"""Whether a live estimate should be relied on, and if not, why."""

from __future__ import annotations

from tumortrack.track.estimate import Estimate
from tumortrack.track.live import Quality

_UNSURE_MM = 3.0  # standard deviation of a tumor's middle
_UNSURE = 0.6  # mean probability of a tumor's points


def judge(estimate: Estimate) -> tuple[Quality, str]:
    """``good``, or ``poor`` and the reason in words.

    Poor is an estimate that fits the points worse than usual in validation, that lacks a tumor, or
    that says itself that a tumor's place is unsure. Good means no more than that none holds.
    """
    cost = estimate.report.get("fit_cost")
    if cost is not None and cost["now"] > cost["usual"]:
        return "poor", "the organ's surface fits the points worse than in most validation scenes"
    for name, part in estimate.report["parts"].items():
        if not part["found"]:
            return "poor", f"{name} was not found"
        if part.get("center_std_mm", 0.0) > _UNSURE_MM:
            return "poor", f"the place of {name} is unsure by {part['center_std_mm']:.1f} mm"
        if part["probability"] is not None and part["probability"] < _UNSURE:
            return "poor", f"the points of {name} have a probability of {part['probability']:.2f}"
    return "good", ""
