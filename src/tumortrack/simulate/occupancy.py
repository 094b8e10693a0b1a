"""Where the network is asked during training, and the right answers: SortSample.

Source: LOOC (IEEE Access 2025, doi 10.1109/ACCESS.2025.3543736), the improved form: per part
draw uniformly in its box x 1.5 until at least k points lie inside and k outside, drop those in
a thin wall about the surface, keep the k nearest of each; add 15 % far points. Points are drawn
in the undeformed CT frame, where labels are known, and *pushed* through the deformation, which
carries labels along exactly. Distances are those before the deformation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, Mesh


class OccupancyConfig(Config, frozen=True):
    """SortSample's numbers."""

    per_side: int = 256  # k: points kept inside and outside of each part
    box_factor: float = 1.5
    wall_mm: float = 0.2
    far_share: float = 0.15
    far_reach: float = 1.2  # half of the far points: a cube of +- this times the organ's diagonal
    pool: int = 100_000  # points per part whose labels are worked out once


class PointSource(Protocol):
    """Where the points of scenes come from."""

    def draw(
        self, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
        """One scene's points (CT frame, undeformed) and labels; the same number every time."""
        ...


@dataclass(frozen=True, eq=False)
class FixedPoints:
    """The same points in every scene: where each of them goes is what is learnt."""

    points_ct: Float32[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]

    def draw(
        self, rng: np.random.Generator
    ) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
        return self.points_ct, self.labels


@dataclass(frozen=True, eq=False)
class PartPool:
    """Points about one part: CT frame, distance to its surface, inside it or not, label."""

    points_ct: Float[np.ndarray, "n 3"]
    distance_mm: Float[np.ndarray, " n"]
    inside: Bool[np.ndarray, " n"]
    labels: UInt8[np.ndarray, " n"]

    def draw_evenly(
        self, rng: np.random.Generator, count: int
    ) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
        """Points spread evenly over the part's enlarged box: shares of them are volumes."""
        chosen = _window(len(self.labels), count, rng)
        return self.points_ct[chosen], self.labels[chosen]


class OccupancyPool:
    """Labelled points of one undeformed anatomy, worked out once; every scene draws from them."""

    def __init__(self, anatomy_ct: Anatomy, config: OccupancyConfig, seed: int) -> None:
        rng = _pool_generator(seed)
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

    def draw(
        self, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
        """One scene's points (CT frame, undeformed) and labels; the same number every time."""
        points, labels = [], []
        for part in self.parts:
            chosen = self._sort_sample(part, rng)
            points.append(part.points_ct[chosen])
            labels.append(part.labels[chosen])
        near = sum(map(len, labels))
        n_far = round(near * self.config.far_share / (1 - self.config.far_share))
        chosen = _window(len(self.far_labels), n_far, rng)
        return (
            np.concatenate([*points, self.far_points_ct[chosen]]),
            np.concatenate([*labels, self.far_labels[chosen]]),
        )

    def _sort_sample(self, part: PartPool, rng: np.random.Generator) -> np.ndarray:
        k = self.config.per_side
        share = part.inside.mean()
        count = int(k / min(share, 1 - share) * 1.1)
        while True:
            drawn = _window(len(part.inside), count, rng)
            inside = part.inside[drawn]
            if min(inside.sum(), (~inside).sum()) >= k:
                break
            count = min(2 * count, len(part.inside))
        return np.concatenate([_nearest(part, drawn[side], k) for side in (inside, ~inside)])


def _nearest(part: PartPool, drawn: np.ndarray, k: int) -> np.ndarray:
    if len(drawn) == k:
        return drawn
    return drawn[np.argpartition(part.distance_mm[drawn], k)[:k]]


def _window(n: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` neighbours of a pool that is in random order: a random draw, without its cost."""
    return (int(rng.integers(n)) + np.arange(count)) % n


def organ_pool(anatomy_ct: Anatomy, config: OccupancyConfig, seed: int) -> PartPool:
    """The first part of an ``OccupancyPool``, for those who need no other."""
    return _part_pool(anatomy_ct, anatomy_ct.organ, config, _pool_generator(seed))


def _pool_generator(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, 0x5047])


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


def contains(mesh: Mesh, points_mm: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """True for points inside a closed mesh (ray parity by Embree, two directions)."""
    import trimesh

    return trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).contains(points_mm)


def labels_of(anatomy: Anatomy, points_mm: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """Labels of points in the anatomy's frame: a tumor wins over the organ, a later tumor over
    an earlier one."""
    labels = np.zeros(len(points_mm), np.uint8)
    for label, part in enumerate(anatomy.parts, start=1):
        labels[contains(part, points_mm)] = label
    return labels


def surface_distance(mesh: Mesh, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance to the surface in mm, by the nearest of dense surface points (within 0.1 mm or
    so at a distance: it orders points and thins a wall, it is no metric)."""
    from scipy.spatial import cKDTree

    corners = mesh.vertices_mm[mesh.faces]
    weights = [(1, 1, 1), (4, 1, 1), (1, 4, 1), (1, 1, 4), (1, 1, 0), (0, 1, 1), (1, 0, 1)]
    dense = [np.einsum("fkx,k->fx", corners, np.array(w) / sum(w)) for w in weights]
    # Points far from a surface have many almost nearest ones: large, loose leaves are six times
    # faster here than scipy's usual tree, with the same distances.
    dense_mm = np.concatenate([mesh.vertices_mm, *dense])
    tree = cKDTree(dense_mm, leafsize=100, balanced_tree=False, compact_nodes=False)
    return tree.query(points_mm, workers=-1)[0].astype(np.float32)
