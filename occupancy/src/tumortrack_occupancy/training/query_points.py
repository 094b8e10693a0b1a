"""Query points of training and their labels: SortSample.

Source: LOOC (IEEE Access 2025, doi 10.1109/ACCESS.2025.3543736), the improved form: per part, draw
uniformly in its box x 1.5 until at least k points lie inside and k outside, drop those closer to
the surface than a threshold, and keep the k nearest on each side; add 15 % far points. Points are
drawn in the undeformed CT frame, where labels are known, and carried along by the deformation.
Distances are those before the deformation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import contains, labels_of, surface_distance
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulation.scene import OccupancyConfig

Points = Float[np.ndarray, "n 3"]
Labels = UInt8[np.ndarray, " n"]
_POOL_SEED = 0x5047


@dataclass(frozen=True, eq=False)
class PartPool:
    """Points around one part, CT frame: distance to its surface, whether inside it, label. They are
    in random order, so that consecutive ones are a random draw at no cost."""

    points_ct: Points
    distance_mm: Float[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    labels: Labels

    def draw_evenly(self, rng: np.random.Generator, count: int) -> tuple[Points, Labels]:
        """Points uniform in the part's enlarged box, so that fractions of them measure volumes."""
        chosen = _consecutive(int(rng.integers(len(self.labels))), count, len(self.labels))
        return self.points_ct[chosen], self.labels[chosen]

    def nearest(self, k: int, rng: np.random.Generator) -> Int64[np.ndarray, " m"]:
        """Of consecutive points, at least ``k`` on each side of the surface: the ``k`` nearest to
        it inside, then the ``k`` nearest outside, each in any order."""
        drawn, chosen = _consecutive(*self._window(k, rng), len(self.labels)), []
        inside = self.inside[drawn]
        for side in (drawn[inside], drawn[~inside]):
            if len(side) > k:
                side = side[np.argpartition(self.distance_mm[side], k)[:k]]
            chosen.append(side)
        return np.concatenate(chosen)

    def _window(self, k: int, rng: np.random.Generator) -> tuple[int, int]:
        """A random first point and a count, such that ``k`` points lie on each side."""
        before, rarer = self._counts
        count = int(k / rarer * 1.1)
        while True:
            first = int(rng.integers(len(self.inside)))
            rounds, last = divmod(first + count, len(self.labels))
            inside = int(rounds * before[-1] + before[last] - before[first])
            if min(inside, count - inside) >= k:
                return first, count
            count = min(2 * count, len(self.inside))

    @cached_property
    def _counts(self) -> tuple[Int64[np.ndarray, " m"], float]:
        """How many points before each one lie inside; the fraction on the rarer side."""
        inside = float(self.inside.mean())
        return np.concatenate([[0], np.cumsum(self.inside)]), min(inside, 1 - inside)


class OccupancyPool:
    """Labelled points of an undeformed anatomy, computed once; every scene draws from them."""

    def __init__(self, anatomy_ct: Anatomy, config: OccupancyConfig, seed: int) -> None:
        rng = np.random.default_rng([seed, _POOL_SEED])
        self.config = config
        self.parts = tuple(_part_pool(anatomy_ct, part, config, rng) for part in anatomy_ct.parts)
        lower, upper = anatomy_ct.organ.box_mm
        centre, half = (lower + upper) / 2, (upper - lower) / 2
        reach = np.full(3, config.far_reach * np.linalg.norm(upper - lower) / 2)
        n = config.pool // 2
        near = centre + rng.uniform(-1, 1, (n, 3)) * half * config.box_factor
        far = centre + rng.uniform(-1, 1, (n, 3)) * reach
        points = rng.permutation(np.concatenate([near, far])).astype(np.float32)
        self.far_points_ct, self.far_labels = points, labels_of(anatomy_ct, points)

    def draw(self, rng: np.random.Generator) -> tuple[Points, Labels]:
        """One scene's points (CT frame, undeformed) and labels; the same number every time."""
        k, share = self.config.per_side, self.config.far_share
        chosen = [(part, part.nearest(k, rng)) for part in self.parts]
        count = round(2 * k * len(self.parts) * share / (1 - share))
        far = _consecutive(int(rng.integers(len(self.far_labels))), count, len(self.far_labels))
        return (
            np.concatenate([*(p.points_ct[c] for p, c in chosen), self.far_points_ct[far]]),
            np.concatenate([*(p.labels[c] for p, c in chosen), self.far_labels[far]]),
        )


def _consecutive(first: int, count: int, n: int) -> Int64[np.ndarray, " count"]:
    """Indices of ``count`` of ``n`` points from ``first`` on, cyclically."""
    return (first + np.arange(count)) % n


def _part_pool(
    anatomy_ct: Anatomy, part: Mesh, config: OccupancyConfig, rng: np.random.Generator
) -> PartPool:
    lower, upper = part.box_mm
    centre, half = (lower + upper) / 2, (upper - lower) / 2 * config.box_factor
    points = (centre + rng.uniform(-1, 1, (config.pool, 3)) * half).astype(np.float32)
    distance = surface_distance(part, points)
    keep = distance > config.wall_mm
    points, distance = points[keep], distance[keep]
    inside = contains(part, points)
    fewest = min(inside.sum(), (~inside).sum())
    if fewest < config.per_side:
        raise InputError(
            f"of a pool of {config.pool} points only {fewest} lie on one side of a part (box "
            f"{np.ptp(part.box_mm, axis=0).round(1).tolist()} mm); {config.per_side} are needed. "
            "Enlarge occupancy.pool, or leave out a part that small."
        )
    return PartPool(points, distance, inside, labels_of(anatomy_ct, points))
