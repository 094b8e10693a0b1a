"""Whether a cloud looks like the organ of the training scenes, and how well the answer fits it.

A network gives an answer for any input. Two numbers tell the organ from something else: how far
the points spread, and how far they lie from the estimated surface. Both are percentiles over four
fifths of the points, so that background and outliers do not count. Of a registered surface, which
outliers do not draw aside, the second is judged by the half that lies nearest: all that outliers
can leave of anything (the median's breakdown point).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from tumortrack.core.config import Config
from tumortrack.core.errors import NotThisOrgan
from tumortrack.core.geometry import Points
from tumortrack.core.report import Finding

Distances = Float[np.ndarray, " n"]
_SHARE = 80  # per cent of the points that must fit: a tenth may be background
_PER_MEDIAN = 1.90  # of four fifths, the distance per that of half, if errors are normal

# What these limits rest on: docs/decisions/034-limits.md. Validation scenes hold noise, background
# and deformation, yet not all that occurs: so many times their fit is allowed.
FIT_FACTOR = 2.0
_SMALLEST_LIMIT_MM = 4.0  # a depth camera's own errors may exceed those of clean training scenes
_SPREAD_FACTOR = 1.5

# A fit's cost is -2 log of its probability, up to a constant: what costs so much more has a
# hundredth of the best one's.
RIVAL_COST = -2 * math.log(0.01)

# An elastic state's squared Mahalanobis distance is 1 on average over its library.
_LARGEST_MAHALANOBIS_2 = 1.25


class InDistributionRange(Config, frozen=True):
    """What the clouds of the validation scenes were like: smallest and largest ``spread_mm``, and
    the 95th percentile of ``fit_mm``."""

    spread_mm: tuple[float, float]
    fit_mm: float

    def __post_init__(self) -> None:
        self.check_between("in-distribution range", spread_mm=(0.1, 1000), fit_mm=(0, 100))


def spread_mm(points_mm: Points) -> float:
    """The distance from their median within which four fifths of the points lie."""
    middle = np.median(points_mm, axis=0)
    return float(np.percentile(np.linalg.norm(points_mm - middle, axis=1), _SHARE))


def fit_mm(distances_mm: Distances) -> float:
    """The distance within which four fifths of the points lie from the surface."""
    return float(np.percentile(distances_mm, _SHARE))


def check_in_distribution(
    known: InDistributionRange, points_mm: Points, distances_mm: Distances, registered: bool = False
) -> None:
    """NotThisOrgan for a cloud that cannot be the organ's: its points spread over much more or less
    than in any validation scene, or a fifth of them (half, where the surface was ``registered``)
    lie much farther from the estimated surface."""
    spread = spread_mm(points_mm)
    low, high = known.spread_mm[0] / _SPREAD_FACTOR, known.spread_mm[1] * _SPREAD_FACTOR
    if not low <= spread <= high:
        values: dict[str, float | str] = {"spread_mm": spread, "low_mm": low, "high_mm": high}
        raise NotThisOrgan(Finding("spread", values))
    limit = max(known.fit_mm * FIT_FACTOR, _SMALLEST_LIMIT_MM)
    which, fit = "a fifth", fit_mm(distances_mm)
    if registered:
        which, fit, limit = "half", float(np.median(distances_mm)), limit / _PER_MEDIAN
    if fit > limit:
        raise NotThisOrgan(Finding("misfit", {"share": which, "fit_mm": fit, "limit_mm": limit}))


def check_likely(mahalanobis_2: float) -> None:
    """NotThisOrgan for what only an implausible deformation explains: a state's squared Mahalanobis
    distance, in units of the library's mean, is too large."""
    if mahalanobis_2 > _LARGEST_MAHALANOBIS_2:
        values: dict[str, float | str] = {"times": mahalanobis_2, "limit": _LARGEST_MAHALANOBIS_2}
        raise NotThisOrgan(Finding("implausible", values))
