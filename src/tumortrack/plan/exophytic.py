"""Which tumor is to be cut out: how much of each lies outside the organ's hull."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.types import ORGAN, part_names
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.values import Located

_DIRECTIONS, _MOST = 192, 12_000  # of the hull, points it is made of: a kidney's is off by 0.5 mm
_FEWEST = 30  # points that say what a tumor's form is


def chosen_tumor(located: Located, config: ResectionConfig) -> tuple[int, float]:
    """Label of the tumor to cut out, and its share outside the organ's hull.

    Raises:
        InputError: no such tumor.
        NoPlan: nothing was located; the tumor lies wholly inside; too few points.
    """
    if len(located.of(ORGAN)) < _FEWEST:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    if not located.tumors:
        raise NoPlan("no tumor was located, so there is nothing to cut out.")
    names = {name_of(label): label for label in located.tumors}
    if config.tumor and config.tumor not in names:
        raise InputError(f"there is no {config.tumor!r}; located were {', '.join(names)}.")
    asked = [names[config.tumor]] if config.tumor else list(names.values())
    shares = exophytic_shares(located, asked)
    label = max(shares, key=lambda one: shares[one])
    if len(located.of(label)) < _FEWEST:
        raise NoPlan(
            f"{name_of(label)} has only {len(located.of(label))} points; {_FEWEST} are needed. "
            "Locate with more points."
        )
    if shares[label] < config.least_exophytic:
        inside = f"{name_of(label)} lies" if len(asked) == 1 else "all tumors lie"
        raise NoPlan(
            f"{inside} wholly inside the organ ({shares[label]:.0%} outside its hull, "
            f"{config.least_exophytic:.0%} are needed): there is no contour to cut along."
        )
    return label, shares[label]


def name_of(label: int) -> str:
    """The part's name: 1 is kidney, 2 is tumor_1."""
    return part_names(label)[label - 1]


def exophytic_shares(located: Located, labels: list[int]) -> dict[int, float]:
    """How much of each tumor lies outside the convex hull of the organ without tumors."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        organ = located.of(ORGAN)
        hull = ConvexHull(_outermost(organ[:: 1 + len(organ) // _MOST]))
    except QhullError as error:
        raise NoPlan("the organ's points lie in a plane; locate it anew.") from error
    normals, offsets = np.split(hull.equations.astype(np.float32), [3], axis=1)
    shares = {}
    for label in labels:
        points = located.of(label).astype(np.float32)
        shares[label] = float(((normals @ points.T + offsets).max(axis=0) > 0).mean())
    return shares


def _outermost(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The farthest point in each of many directions: what a hull needs of a dense cloud."""
    n = np.arange(_DIRECTIONS)
    z = 1 - (2 * n + 1) / _DIRECTIONS  # a Fibonacci sphere
    turn = n * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    farthest = (directions.astype(np.float32) @ points.T.astype(np.float32)).argmax(axis=1)
    return points[np.unique(farthest)].astype(np.float64)
