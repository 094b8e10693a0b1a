"""How far off a tumor's centre may be, learned from kidneys whose truth is known.

The logarithm of the radius within which 95 % of the misses lie is a sum of an answer's figures,
with weights of 0 or more: no figure that gets worse makes an answer look better. Kidneys, tumors,
physics and camera are simulated (``lab/scripts/misses.py``); none is a patient's. Source of
quantiles of scaled residuals: Papadopoulos et al. 2011 (doi 10.1613/jair.3198).
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib.resources import files
from typing import Any

from tumortrack.core.assessment import ErrorBound
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.report import FitReport

_NAME = "misses.json"
# An answer is poor from this radius on. docs/trust.md has what that is worth for kidneys and
# families of physics left out.
POOR_MM = 6.0
_MOST_STRAYS, _FARTHEST_RIVAL_MM = 0.3, 10.0  # more say no more
_LEAST_HELD_MM = 0.05  # nor does less
_WITHIN = 1.96  # standard deviations: 95 % of a normal distribution


class MissModel(Config, frozen=True):
    """``constant``: logarithm of the radius, mm, if all figures are 0; ``fingerprint``: of the
    method that it was learned with; ``about``: on what."""

    fingerprint: str
    constant: float
    weights: dict[str, float]
    about: dict[str, Any]

    def radius_mm(self, figures: dict[str, float]) -> float:
        """Of the misses' 95 %."""
        return math.exp(self.constant + sum(w * figures[name] for name, w in self.weights.items()))


@cache
def shipped() -> MissModel:
    """What comes with this version."""
    text = files("tumortrack.assessment").joinpath(_NAME).read_text()
    return from_builtins(json.loads(text), MissModel, _NAME)


def figures(report: FitReport, name: str) -> dict[str, float] | None:
    """Of a tumor; larger is worse. None: the method does not know them."""
    part, cost, motion = report.parts[name], report.fit_cost, report.motion
    if cost is None or motion is None or part.fit_std_mm is None:
        return None
    if part.nearest_mm is None or part.held_by_prior_mm is None:
        return None
    apart_mm = max((rival.apart_mm[name] for rival in cost.others), default=0.0)
    return {
        "center_std": math.log(part.fit_std_mm[0]),
        "surface_std": math.log(part.fit_std_mm[1]),
        "nearest": math.log(max(part.nearest_mm, 1.0)),
        "prior": math.log(max(part.held_by_prior_mm, _LEAST_HELD_MM)),
        "cost": math.log(max(cost.now / cost.usual, 0.1)),
        "strays": min(cost.strays, _MOST_STRAYS),
        "rarity": math.log1p(motion.rarity),
        "compliance": math.log(motion.compliance_std_mm or 1.0),
        "rival": min(apart_mm, _FARTHEST_RIVAL_MM),
        "size": math.log1p(max(report.size.gain, 0.0)) if report.size is not None else 0.0,
        "unseen": report.unseen or 0.0,
    }


def depths_within_mm(report: FitReport, name: str) -> float:
    """How far off a part's centre is at most (95 %) by what all depths of the camera err alike."""
    center_mm = report.parts[name].center_mm
    if report.motion is None or center_mm is None:
        return 0.0
    return _WITHIN * report.motion.depth_share * math.hypot(*center_mm)


def bounds_of(report: FitReport) -> dict[str, ErrorBound]:
    """Of each tumor, where the method knows enough: what was learned, and what the camera's depths
    err by beside that."""
    bounds = {}
    for name, part in report.tumors.items():
        if (known := figures(report, name)) is not None:
            bound_mm = math.hypot(shipped().radius_mm(known), depths_within_mm(report, name))
            bounds[name] = ErrorBound(bound_mm, part.center_axes and part.center_axes[0])
    return bounds
