"""How far off a part may be, learned from organs whose truth is known.

The logarithm of the bound is a sum of hinges of an answer's figures, with weights of 0 or more: no
figure that gets worse makes an answer look better. They are the 95 % quantile of the largest miss
of a part's points, fitted as such (pinball loss; Koenker and Bassett 1978, doi 10.2307/1913643), on
simulated organs, physics, cameras and evidence (``benchmarks/scripts/bounds.py``); none is a
patient's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

from tumortrack.core.assessment import ErrorBound
from tumortrack.core.config import Config, from_builtins
from tumortrack.core.report import FitReport

_NAME = "bounds.json"
# An answer is poor from this bound on. docs/trust.md has what that is worth for organs, families
# of physics and kinds of evidence left out.
POOR_MM = 6.0
CONFIDENCE = 0.95
_MOST_OUTLIERS, _FARTHEST_ALTERNATIVE_MM = 0.3, 10.0  # more say no more
_LEAST_HELD_MM = 0.05  # nor does less
_WITHIN = 1.96  # standard deviations: 95 % of a normal distribution
Hinges = dict[str, tuple[tuple[float, float], ...]]


class Quantile(Config, frozen=True):
    """Of the largest miss. ``constant``: logarithm of the bound, mm, where all figures are small;
    ``hinges``: by figure, from which value on it counts, and by how much."""

    constant: float
    hinges: Hinges

    def bound_mm(self, figures: dict[str, float]) -> float:
        more = (
            weight * max(figures[name] - knot, 0.0)
            for name, hinges in self.hinges.items()
            for knot, weight in hinges
        )
        return math.exp(self.constant + sum(more))


class BoundModel(Config, frozen=True):
    """``fingerprint``: of the method that it was learned with; ``advice``: by kind of evidence, how
    much a bound fell over what was foreseen, in scenes left out; ``about``: on what."""

    fingerprint: str
    tumor: Quantile
    organ: Quantile
    advice: Mapping[str, float]
    about: dict[str, Any]


@cache
def shipped() -> BoundModel:
    """What comes with this version."""
    text = files("tumortrack.assessment").joinpath(_NAME).read_text()
    return from_builtins(json.loads(text), BoundModel, _NAME)


def figures(report: FitReport, name: str) -> dict[str, float] | None:
    """Of a part; larger is worse. None: the method does not know them."""
    part, cost, motion = report.parts[name], report.fit_cost, report.motion
    if cost is None or motion is None or part.fit_std_mm is None:
        return None
    if part.nearest_mm is None or part.prior_pull_mm is None:
        return None
    distance_mm = max((alternative.distance_mm[name] for alternative in cost.others), default=0.0)
    return {
        "center_std": math.log(part.fit_std_mm[0]),
        "surface_std": math.log(part.fit_std_mm[1]),
        "nearest": math.log(max(part.nearest_mm, 1.0)),
        "prior": math.log(max(part.prior_pull_mm, _LEAST_HELD_MM)),
        "cost": math.log(max(cost.now / cost.usual, 0.1)),
        "outliers": min(cost.outliers, _MOST_OUTLIERS),
        "normalized_mahalanobis": math.log1p(motion.normalized_mahalanobis),
        "compliance": math.log(motion.compliance_std_mm or 1.0),
        "misfit": math.log(max(motion.misfit_mm, _LEAST_HELD_MM)),
        "alternative": min(distance_mm, _FARTHEST_ALTERNATIVE_MM),
        "size": math.log1p(max(report.size.gain, 0.0)) if report.size is not None else 0.0,
        "unseen": report.unseen or 0.0,
    }


def depths_within_mm(report: FitReport, name: str) -> float:
    """How far off a part's centre is at most (95 %) by what all depths of the camera err alike."""
    center_mm = report.parts[name].center_mm
    if report.motion is None or center_mm is None:
        return 0.0
    return _WITHIN * report.motion.depth_share * math.hypot(*center_mm)


def probes_within_mm(report: FitReport) -> float:
    """How far off all parts are at most (95 %) by what recordings of probes leave open."""
    return _WITHIN * math.hypot(*(probe.shift_std_mm for probe in report.probes))


def bound_mm(report: FitReport, name: str, share: float = 1.0) -> float | None:
    """How far off a part is at most (95 %), without a factor: what was learned, and beside that
    what the camera's depths err by and probes leave open; at least how far off it is in fits that
    are as likely.

    Args:
        share: by which its standard deviations are multiplied; the other figures stay.
    """
    if (known := figures(report, name)) is None:
        return None
    for std in ("center_std", "surface_std"):
        known[std] += math.log(share)
    quantile = shipped().tumor if name in report.tumors else shipped().organ
    learned_mm = quantile.bound_mm(known)
    beside_mm = depths_within_mm(report, name), probes_within_mm(report)
    return max(math.hypot(learned_mm, *beside_mm), alternatives_mm(report, name))


def alternatives_mm(report: FitReport, name: str) -> float:
    """How far off a part's centre is at most (95 %) by other fits that are as likely."""
    alternatives = () if report.fit_cost is None else report.fit_cost.others
    left = 1 - CONFIDENCE
    for alternative in sorted(alternatives, key=lambda alternative: -alternative.distance_mm[name]):
        left -= alternative.share
        if left < 0:
            return alternative.distance_mm[name]
    return 0.0


def bounds_of(report: FitReport, factor: float = 1.0) -> dict[str, ErrorBound]:
    """Of each part, where the method knows enough, times a factor."""
    bounds = {}
    for name, part in report.parts.items():
        if (most_mm := bound_mm(report, name)) is not None:
            bounds[name] = ErrorBound(factor * most_mm, part.center_axes and part.center_axes[0])
    return bounds
