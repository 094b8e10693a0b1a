"""Which of the located tumors to cut out, and how far they stick out of the organ."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from tumortrack.core.errors import InputError, NoPlan
from tumortrack.core.organ import organ_name
from tumortrack.core.types import ORGAN
from tumortrack_resection.facets import sphere
from tumortrack_resection.values import Located, ResectionConfig, name_of

_DIRECTIONS, _MOST = 192, 12_000  # of the hull, points it is made of: off by 0.5 mm
_FEWEST = 30  # points that define a tumor's shape


def chosen_tumor(located: Located, config: ResectionConfig) -> tuple[int, float]:
    """Label of the tumor to cut out, and its share outside the organ's hull."""
    if len(located.of(ORGAN)) < _FEWEST:
        raise NoPlan("no organ was located, so nothing can be planned. Locate it first.")
    if not located.tumors:
        raise NoPlan("no tumor was located, so there is nothing to cut out.")
    names = {name_of(label): label for label in located.tumors}
    if config.tumor and config.tumor not in names:
        raise InputError(f"there is no {config.tumor!r}; located were {', '.join(names)}.")
    candidates = [names[config.tumor]] if config.tumor else list(names.values())
    shares = exophytic_shares(located, candidates)
    label = max(shares, key=lambda tumor: shares[tumor])
    name, n = name_of(label), len(located.of(label))
    if n < _FEWEST:
        raise NoPlan(f"{name} has only {n} points; {_FEWEST} are needed. Locate with more points.")
    if shares[label] < config.least_exophytic:
        inside = f"{name} lies" if len(candidates) == 1 else "all tumors lie"
        raise NoPlan(
            f"{inside} wholly inside the organ ({shares[label]:.0%} outside its hull, "
            f"{config.least_exophytic:.0%} are needed; least_exophytic in --config allows less)."
        )
    needed = (organ_name(located.meshes), *names)
    if lacking := [part for part in needed if part not in located.meshes]:
        raise NoPlan(
            f"{lacking[0] or 'the organ'} has no surface to keep a margin from. Locate it again."
        )
    return label, shares[label]


def exophytic_shares(located: Located, labels: list[int]) -> dict[int, float]:
    """How much of each tumor lies outside the convex hull of the organ without tumors.

    Of a dense cloud the hull needs only the farthest point in each of many directions.
    """
    organ = located.of(ORGAN)
    organ = organ[:: 1 + len(organ) // _MOST]
    farthest = (sphere(_DIRECTIONS).astype(np.float32) @ organ.T.astype(np.float32)).argmax(axis=1)
    try:
        hull = ConvexHull(organ[np.unique(farthest)].astype(np.float64))
    except QhullError as error:
        raise NoPlan("the organ's points lie in a plane; locate it again.") from error
    normals, offsets = np.split(hull.equations.astype(np.float32), [3], axis=1)
    shares = {}
    for label in labels:
        points = located.of(label).astype(np.float32)
        outside = (normals @ points.T + offsets).max(axis=0) > 0
        shares[label] = float(outside.mean()) if len(points) else 0.0
    return shares
