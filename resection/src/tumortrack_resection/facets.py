"""Our method: the electrode is a line, not a point. A plane that touches the convex hull of the
tumor, grown by the margin, keeps the margin for every line in it, however long the electrode is.
So the piece is the organ on the inner side of a few such planes, and each facet is swept by an
electrode that lies in it, its tip on the lower edge. All open towards one side, so that the
electrode cuts nothing but the facet, and the piece can be taken out there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.types import ORGAN
from tumortrack_resection.values import Located, ResectionConfig, name_of

Vector = Float64[np.ndarray, " 3"]
Planes = Float64[np.ndarray, "k 4"]  # unit normals n, which point out of the piece; offsets, mm
Chosen = tuple[int, ...]  # numbers of normals, anticlockwise as seen from where the piece opens

UP = np.array([0.0, 0.0, 1.0])
EDGE_MM = 1.0  # the tip goes so far beyond the edge to the next facet
SLACK_MM = 0.1  # by which the planes are farther off than the margin: arms follow them to 0.05 mm
_NORMALS = 1000  # all over the sphere, 6 degrees apart
_OPENINGS = 64  # directions in which a piece may open, over the upper hemisphere
_LOWEST_OPENING = -0.15  # its z: the cup comes from there, and lifts the piece
_FIRST, _BEST = 3, 8  # facets by which openings are compared, and how many openings go on
_POINTS = 2048  # of healthy tissue, by which normals are chosen
_OPEN = np.sin(np.radians(8.0))  # least sine between facet and opening: the piece comes free
_CONVEX = np.sin(np.radians(25.0))  # least turn at a corner of the normals' outline
_ROUNDS = 2  # of choosing each normal again
# Points of healthy tissue that one too near to the electrode outweighs: of another tumor, and of
# what carries the organ, which is not always in the way.
_TOO_NEAR, _AT_STAND = 50.0, 0.5
_SAVES = 0.03  # a further facet must save so much of the healthy tissue
_UPRIGHT = 0.3  # tissue that an opening straight up is worth, against a level one, as a share
_ALIKE_DEG = 10.0  # normals so near to one that can't be cut are not tried
_KEEP_MM = 1.5  # between points of what the electrode keeps away from


class Tools(NamedTuple):
    """What the planner has to know of tools and stand, mm."""

    electrode_mm: float = 70.0
    radius_mm: float = 1.2  # of the electrode
    cup_radius_mm: float = 8.0
    stand: tuple[float, float, float, float] | None = None  # its top's middle (table), its radius
    stand_room_mm: float = 3.0  # of the electrode's surface from it


TOOLS = Tools()  # the default cell's


@dataclass(frozen=True, eq=False)
class Piece:
    """One choice of facets, and the share of healthy tissue that it takes, kerfs included.
    ``with_it``: labels of further tumors that come away."""

    chosen: Chosen
    planes: Planes
    opening: Vector
    healthy: float
    with_it: tuple[int, ...]

    @property
    def worth(self) -> float:
        """By which pieces are compared; less is better."""
        return self.healthy * (1 + _UPRIGHT * (1 - float(self.opening[2])))


class FacetSearch:
    """Choices of facets round a tumor, the least healthy tissue first. ``targets``: labels of
    the tumors that are to come away. ``keep_mm``: what else the electrode keeps away from, with
    distances. ``like``: outward normals of an earlier plan; None: they are searched for."""

    def __init__(
        self, located: Located, targets: tuple[int, ...], keep_mm: Mapping[str, float],
        config: ResectionConfig, tools: Tools, like: Float64[np.ndarray, "k 3"] | None = None,
    ) -> None:  # fmt: skip
        self._located, self._targets, self.keep_mm = located, targets, keep_mm
        self._config, self._tools = config, tools
        self._like = None if like is None else np.asarray(like, float)
        self._normals = sphere(_NORMALS) if self._like is None else self._like
        points = np.concatenate([located.meshes[name_of(n)].vertices_mm for n in targets])
        kerf_mm = tools.radius_mm
        room_mm = config.margin_mm + kerf_mm + SLACK_MM
        self._offsets = (self._normals @ points.T).max(1) + room_mm
        healthy = located.points_of(ORGAN)
        healthy = healthy[:: 1 + len(healthy) // _POINTS].astype(float)
        beyond = self._normals @ healthy.T > self._offsets[:, None] + kerf_mm
        self._choice = _Choice(self._normals, beyond, self._near(self._offsets))

    def pieces(self, left_out: Sequence[int] = (), lowest: float = -1.0) -> list[Piece]:
        """The best choices, one for each opening and number of facets, the best first.
        ``left_out``: normals that are not chosen, nor those near to them. ``lowest``: z of where
        an electrode comes from."""
        choice = self._choice
        if self._like is not None:
            ways = sphere(_NORMALS)  # away from all planes, as steeply as one can
            opening = ways[(-(ways @ self._like.T)).min(1).argmax()]
            found = [(tuple(range(len(self._like))), opening)]
        else:
            alike = self._normals @ self._normals[list(left_out)].T
            choice.barred = (alike > np.cos(np.radians(_ALIKE_DEG))).any(1)
            choice.lowest = lowest
            openings = choice.best_openings(sphere(_OPENINGS, _LOWEST_OPENING))
            most = self._config.most_facets
            found = [(chosen, d) for d in openings for chosen in choice.choices(d, most)]
        pieces = []
        for chosen, opening in found:
            at = list(chosen)
            planes = np.column_stack([self._normals[at], self._offsets[at]])
            with_it = tuple(
                n for n in self._located.tumors if n != self._targets[0]
                and inside(planes, self._located.meshes[name_of(n)].vertices_mm).mean() > 0.5
            )  # fmt: skip
            share = 1 - choice.cut_off(chosen) / choice.points
            pieces.append(Piece(chosen, planes, opening, share, with_it))
        return sorted(pieces, key=lambda piece: piece.worth)

    def _near(self, offsets: np.ndarray) -> list[_Near]:
        """Of each thing to keep away from."""
        surfaces, tools = self._located.surfaces, self._tools
        things = [
            (surfaces[name].spread_mm(_KEEP_MM), mm, _TOO_NEAR) for name, mm in self.keep_mm.items()
        ]
        if tools.stand is not None:
            things.append((_disc(*tools.stand), tools.stand_room_mm, _AT_STAND))
        rows = []
        for points, mm, weight in things:
            room = mm + tools.radius_mm + SLACK_MM
            off = self._normals @ points.T - offsets[:, None]
            rows.append(_Near(_packed(np.abs(off) < room), _packed(off < room + EDGE_MM), weight))
        return rows


class _Near(NamedTuple):
    """Of every normal, which points of a thing the electrode comes too near to somewhere in its
    plane, and which lie on its inner side, or so near; packed. ``weight``: points of healthy
    tissue that one of them outweighs."""

    near: np.ndarray
    inner: np.ndarray
    weight: float


class _Choice:
    """Sets of normals for one opening at a time, by what they cut off: bits of points, packed."""

    def __init__(self, normals: np.ndarray, beyond: np.ndarray, near: list[_Near]) -> None:
        self._normals, self._all_near = normals, near
        self._all_beyond, self.points = _packed(beyond), beyond.shape[1]
        self.barred, self.lowest = np.zeros(len(normals), bool), -1.0

    def cut_off(self, chosen: Chosen) -> int:
        """How many points of healthy tissue stay."""
        return int(np.bitwise_count(np.bitwise_or.reduce(self._all_beyond[list(chosen)])).sum())

    def best_openings(self, openings: np.ndarray) -> list[Vector]:
        """Those for which few facets, chosen one after the other, are worth most."""
        worth = []
        for opening in openings:
            self._face(opening)
            chosen: Chosen = ()
            most = -np.inf
            for _ in range(_FIRST):
                chosen, most = self._with_one_more(chosen) or (chosen, most)
            upright = 1 + _UPRIGHT * (1 - float(opening[2]))
            worth.append(-(self.points - most) * upright)
        order = np.argsort(worth, kind="stable")[::-1][:_BEST]
        return [openings[n] for n in order if np.isfinite(worth[n])]

    def choices(self, opening: Vector, most: int) -> Iterator[Chosen]:
        """The best found with 1, 2, ... facets that keep away from everything, each only if it is
        worth the further facet."""
        self._face(opening)
        chosen: Chosen = ()
        worth = -np.inf
        for _ in range(most):
            if (more := self._with_one_more(chosen)) is None:
                return
            better, gain = self._refined(*more)
            if gain < worth + _SAVES * (self.points - worth):
                return
            chosen, worth = better, gain
            if not self._hits(list(chosen[1:]), _TOO_NEAR)[chosen[0]]:
                yield tuple(self._numbers[list(chosen)].tolist())

    def _face(self, opening: Vector) -> None:
        """Choose for this opening from now on, among the normals that it allows."""
        sines = -self._normals @ opening
        good = (sines >= _OPEN) & ~self.barred
        back = opening + sines[:, None] * self._normals  # where the electrode comes from, about
        good &= back[:, 2] >= self.lowest * np.linalg.norm(back, axis=1)
        self._numbers = np.flatnonzero(good)
        aside = across(opening)
        # Facets open to the opening's side if these points are the corners of a convex outline.
        self._outline = self._normals[good] @ aside.T / sines[good, None]
        self._beyond = self._all_beyond[good]
        self._near = [_Near(n.near[good], n.inner[good], n.weight) for n in self._all_near]

    def _with_one_more(self, chosen: Chosen) -> tuple[Chosen, float] | None:
        return self._best([chosen[:n] + (-1,) + chosen[n:] for n in range(max(len(chosen), 1))])

    def _refined(self, chosen: Chosen, worth: float) -> tuple[Chosen, float]:
        """Each normal chosen again, the others as they are."""
        for _ in range(_ROUNDS):
            before = chosen
            for n in range(len(chosen)):
                again = self._best([chosen[:n] + (-1,) + chosen[n + 1 :]])
                chosen, worth = again or (chosen, worth)
            if chosen == before:
                break
        return chosen, worth

    def _best(self, open_places: Sequence[Chosen]) -> tuple[Chosen, float] | None:
        """The best of these sets with any normal in the place of -1, and what it is worth: points
        of healthy tissue that stay, less a penalty for all that the electrode comes too near to."""
        fixed = [n for n in open_places[0] if n >= 0]
        union = np.bitwise_or.reduce(self._beyond[fixed], axis=0)  # of none: zeros
        worth = np.bitwise_count(self._beyond & ~union).sum(1, dtype=float)
        worth += float(np.bitwise_count(union).sum()) - self._hits(fixed)
        best, most = None, -np.inf
        for places in open_places:
            at = places.index(-1)
            here = np.where(self._convex(places, at), worth, -np.inf)
            if len(here) and here[winner := int(here.argmax())] > most:
                best, most = places[:at] + (winner,) + places[at + 1 :], float(here[winner])
        return None if best is None else (best, most)

    def _convex(self, places: Chosen, at: int) -> Bool[np.ndarray, " n"]:
        """With which normals in the open place the outline stays convex."""
        k, outline = len(places), self._outline
        good = np.ones(len(outline), bool)
        if k < 3:
            return good
        corners = [outline if n < 0 else outline[n] for n in places]
        for first in (at - 2, at - 1, at) if k > 3 else (at - 1,):
            a, b, c = (corners[(first + step) % k] for step in range(3))
            one, two = b - a, c - b
            turn = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
            sizes = np.hypot(one[..., 0], one[..., 1]) * np.hypot(two[..., 0], two[..., 1])
            good &= turn > _CONVEX * np.maximum(sizes, 1e-12)
        return good

    def _hits(self, fixed: list[int], least: float = 0.0) -> Float64[np.ndarray, " n"]:
        """With each further normal, the weight of the points that the electrode comes too near to
        in a facet; of things of this weight or more."""
        hits = np.zeros(len(self._beyond))
        for near, inner, weight in self._near:
            if weight < least:
                continue
            within = np.bitwise_and.reduce(inner[fixed], axis=0)  # of none: ones
            count = np.bitwise_count(near & within).sum(1, dtype=float)  # in the new facet
            for n in fixed:  # in the others, cut short by it
                rest = near[n] & within
                if rest.any():
                    count += np.bitwise_count(rest & inner).sum(1, dtype=float)
            hits += weight * count
        return hits


def keep_mm(
    located: Located, targets: tuple[int, ...], config: ResectionConfig, room: float
) -> dict[str, float]:
    """Beside its targets, with distances in mm: other tumors, by this share of the margin, and
    what is named."""
    others = {name_of(n): room * config.margin_mm for n in located.tumors}
    kept = {**others, **config.keep_away}
    return {name: mm for name, mm in kept.items() if name not in map(name_of, targets)}


def _disc(x: float, y: float, z: float, radius: float) -> Float64[np.ndarray, "n 3"]:
    """Points all over a level disc."""
    n = np.arange(max(8, int((radius / _KEEP_MM) ** 2 * np.pi)))
    far, turn = radius * np.sqrt((n + 0.5) / len(n)), n * np.pi * (3 - np.sqrt(5))
    return np.column_stack([x + far * np.cos(turn), y + far * np.sin(turn), np.full(len(n), z)])


def inside(planes: Planes, points_mm: np.ndarray, by_mm: float = 0.0) -> Bool[np.ndarray, " n"]:
    return (points_mm @ planes[:, :3].T <= planes[:, 3] - by_mm).all(1)


def _packed(bits: Bool[np.ndarray, "n m"]) -> np.ndarray:
    """Bits in words of 64, filled up with zeros."""
    filled = np.zeros((len(bits), -(-bits.shape[1] // 64) * 64), bool)
    filled[:, : bits.shape[1]] = bits
    return np.packbits(filled, axis=1).view(np.uint64)


def sphere(count: int, lowest: float = -1.0) -> Float64[np.ndarray, "n 3"]:
    """Directions evenly over the part of a sphere with z above ``lowest`` (Fibonacci's spiral)."""
    n = np.arange(count)
    z = 1 - (1 - lowest) * (n + 0.5) / count
    turn, ring = n * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def across(direction: Vector) -> Float64[np.ndarray, "2 3"]:
    """Two unit vectors that make a right-handed frame with a third."""
    pair = np.linalg.svd(direction[None])[2][1:]
    return pair if np.linalg.det([*pair, direction]) > 0 else pair[::-1]
