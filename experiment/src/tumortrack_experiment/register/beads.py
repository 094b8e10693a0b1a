"""Beads without names to those of a kit by their distances, and two frames by their beads.

The error of a registration is Fitzpatrick, West and Maurer's (1998, doi 10.1109/42.736021): from
what is left at the beads (FRE) how far each is usually off where it was found (FLE), and from that
and how the beads lie, how far any other point is off (TRE).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import t

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, Points, rigid, transform_points
from tumortrack_experiment.kit_file import LEAST_BEADS, Kit

Targets = Float[np.ndarray, "m 3"]

_LEAST_SPREAD_MM = 5.0  # rms across the line through the beads; on a line a turn stays free
_MOVED_MM = 12.0  # a bead that fell out of its dimple lies no farther away, or is lost
_MOST_CANDIDATES = 60
_AS_GOOD = 2.0  # another arrangement whose rms is within this ratio fits as well
_OUTLIER = 3.0  # times the usual error of a bead
_CERTAIN = 0.95


@dataclass(frozen=True)
class Device:
    """What found beads. ``error_mm``: the usual distance of a bead from where it is found, three
    axes together; ``tolerance_mm``: the farthest from the kit's drawing, which a print misses by
    some tenths, at which a bead is still in its place."""

    name: str
    error_mm: float
    tolerance_mm: float


CT = Device("CT", 0.15, 1.0)
CAMERA = Device("camera", 0.5, 1.6)
ROBOT = Device("robot", 0.4, 1.5)  # of a tip that is brought to a bead by hand; repeats better


@dataclass(frozen=True, eq=False)
class NamedBeads:
    """A kit's beads where a device found them: ``points_mm``, its frame, a row for each of the kit,
    NaN where it has none; ``notes``: which are missing or moved. ``device_from_base``: the kit's
    drawing laid on them."""

    device: Device
    points_mm: Float64[np.ndarray, "n 3"]
    device_from_base: Float64[np.ndarray, "4 4"]
    notes: tuple[str, ...] = ()

    @property
    def found(self) -> Bool[np.ndarray, " n"]:
        return np.isfinite(self.points_mm[:, 0])


def fit_rigid(from_mm: Points, to_mm: Points) -> tuple[Affine, Float[np.ndarray, " n"]]:
    """The rigid transform that lays points (n, 3) on others by least squares, and the distances
    that are left."""
    middles = from_mm.mean(0), to_mm.mean(0)
    turn = Rotation.align_vectors(to_mm - middles[1], from_mm - middles[0])[0].as_matrix()
    to_from = rigid(turn, middles[1] - turn @ middles[0])
    return to_from, np.linalg.norm(transform_points(to_from, from_mm) - to_mm, axis=1)


def name_beads(kit: Kit, points_mm: Points, device: Device, above_mm: float = 0.0) -> NamedBeads:
    """Which of the points are which of the kit's beads, by the largest arrangement that agrees with
    the drawing; points may be missing, moved or too many, and all lie so far above the middles.

    Raises:
        InputError: fewer than 4 agree, they lie on a line, two arrangements fit as well, or the
            mirror image fits better.
    """
    what = f"{device.name}: {len(points_mm)} places that may be beads"
    if len(points_mm) > _MOST_CANDIDATES:
        raise InputError(f"{what}; at most {_MOST_CANDIDATES} are allowed. Clear the base.")
    drawn_mm = kit.beads_mm + [0, 0, above_mm]
    best, other = _arrangements(drawn_mm, points_mm, device.tolerance_mm)
    mirrored, _ = _arrangements(drawn_mm * [1, 1, -1], points_mm, device.tolerance_mm)
    if mirrored.count >= LEAST_BEADS and mirrored.rank < (-best.count, best.rms_mm / _AS_GOOD):
        raise InputError(
            f"{what}; {mirrored.count} of them are the kit's mirror image. Left and right are "
            "exchanged in these data, or it is another kit."
        )
    names = [bead.name for bead in kit.beads]
    notes = _left_out(kit, drawn_mm, points_mm, best, device)
    if best.count < LEAST_BEADS:
        agree = ", ".join(names[n] for n in np.flatnonzero(best.which >= 0)) or "none"
        raise InputError(
            f"{what}; only {best.count} of the kit's {len(names)} beads agree with its drawing "
            f"within {device.tolerance_mm:g} mm ({agree}); {LEAST_BEADS} are needed. "
            + "; ".join(notes if best.count else ["Check that it is this kit"])
            + "."
        )
    if other.count == best.count and other.rms_mm < _AS_GOOD * best.rms_mm + 0.1:
        raise InputError(
            f"{what}; {best.count} of them can be named in two ways that fit as well "
            f"({best.rms_mm:.2f} and {other.rms_mm:.2f} mm). Bring more of the beads into view."
        )
    named = np.full((len(names), 3), np.nan)
    there = best.which >= 0
    named[there] = points_mm[best.which[there]] - above_mm * best.device_from_base[:3, 2]
    return NamedBeads(device, named, best.device_from_base, tuple(notes))


@dataclass(frozen=True, eq=False)
class _Arrangement:
    """``which``: of each of the kit's beads the number of its point, -1 without one."""

    which: np.ndarray
    device_from_base: np.ndarray
    rms_mm: float

    @property
    def count(self) -> int:
        return int((self.which >= 0).sum())

    @property
    def rank(self) -> tuple[int, float]:
        """The least is the best."""
        return -self.count, self.rms_mm


def _arrangements(
    beads_mm: np.ndarray, points_mm: np.ndarray, tolerance_mm: float
) -> tuple[_Arrangement, _Arrangement]:
    """The best one, and the next best that names some bead otherwise."""
    none = _Arrangement(np.full(len(beads_mm), -1), np.eye(4), np.inf)
    found: dict[bytes, _Arrangement] = {}
    for triple, which in _triples(beads_mm, points_mm, 2 * tolerance_mm):
        one = _grown(beads_mm, points_mm, (triple, which), tolerance_mm)
        found |= {one.which.tobytes(): one} if one is not None else {}
    ranked = sorted(found.values(), key=lambda one: one.rank)
    best = ranked[0] if ranked else none

    def differs(one: _Arrangement) -> bool:
        both = (one.which >= 0) & (best.which >= 0)
        return bool((one.which != best.which)[both].any()) or not both.any()

    return best, next(filter(differs, ranked[1:]), none)


def _triples(
    beads_mm: np.ndarray, points_mm: np.ndarray, tolerance_mm: float
) -> Iterator[tuple[list[int], np.ndarray]]:
    """Three beads and three points with the same distances between them."""
    bead_mm, point_mm = cdist(beads_mm, beads_mm), cdist(points_mm, points_mm)
    for i, j, k in combinations(range(len(beads_mm)), 3):
        like = {n: np.abs(point_mm - bead_mm[n]) < tolerance_mm for n in ((i, j), (i, k), (j, k))}
        firsts, seconds = np.nonzero(like[i, j])
        thirds = like[i, k][firsts] & like[j, k][seconds]
        for pair, third in zip(*np.nonzero(thirds), strict=True):
            yield [i, j, k], np.array([firsts[pair], seconds[pair], third])


def _grown(
    beads_mm: np.ndarray,
    points_mm: np.ndarray,
    start: tuple[list[int], np.ndarray],
    tolerance_mm: float,
) -> _Arrangement | None:
    """Three pairs and whatever else then lies in its place; None: they were no arrangement."""
    triple, points = start
    which = np.full(len(beads_mm), -1)
    which[triple] = points
    for reach in (2.0, 1.0, 1.0):  # three alone turn by more than all of them do
        there = which >= 0
        if there.sum() < 3 or _across_mm(beads_mm[there]) < _LEAST_SPREAD_MM:
            return None
        device_from_base, left_mm = fit_rigid(beads_mm[there], points_mm[which[there]])
        away_mm = cdist(transform_points(device_from_base, beads_mm), points_mm)
        nearest = away_mm.argmin(1)
        alone = away_mm.argmin(0)[nearest] == np.arange(len(beads_mm))
        near = away_mm[np.arange(len(beads_mm)), nearest] < reach * tolerance_mm
        which = np.where(alone & near, nearest, -1)
    there = which >= 0
    if there.sum() < 3 or _across_mm(beads_mm[there]) < _LEAST_SPREAD_MM:
        return None
    device_from_base, left_mm = fit_rigid(beads_mm[there], points_mm[which[there]])
    return _Arrangement(which, device_from_base, float(np.sqrt((left_mm**2).mean())))


def _left_out(
    kit: Kit, drawn_mm: np.ndarray, points_mm: np.ndarray, best: _Arrangement, device: Device
) -> list[str]:
    """A line for each bead that is not where the drawing has it."""
    free = np.setdiff1d(np.arange(len(points_mm)), best.which)
    places = transform_points(best.device_from_base, drawn_mm)
    notes = []
    for n in np.flatnonzero(best.which < 0):
        away_mm = np.linalg.norm(points_mm[free] - places[n], axis=1)
        name = f"{device.name}: bead {kit.beads[n].name}"
        if len(away_mm) and away_mm.min() < _MOVED_MM:
            notes.append(f"{name} has moved, by {away_mm.min():.1f} mm; left out")
        else:
            notes.append(f"{name} was not found")
    return notes


def _across_mm(points_mm: np.ndarray) -> float:
    """Rms distance of points from the line that lies nearest to all of them."""
    spreads = np.linalg.svd(points_mm - points_mm.mean(0), compute_uv=False)
    return float(np.sqrt((spreads[1:] ** 2).sum() / len(points_mm)))


@dataclass(frozen=True, eq=False)
class Registration:
    """``to_from``: one device's frame to another's, mm. ``beads``: names of those that it rests on;
    ``left_mm``: what is left at each, ``without_mm``: at each, where the others alone decide;
    ``fle_mm``: how far a bead is usually off in both frames together, from ``fre_mm`` and never
    less than the devices are known for; ``notes``: beads left out, and why."""

    to_from: Float64[np.ndarray, "4 4"]
    beads: tuple[str, ...]
    from_mm: Float64[np.ndarray, "n 3"]
    left_mm: Float64[np.ndarray, " n"]
    without_mm: Float64[np.ndarray, " n"]
    fre_mm: float
    fle_mm: float
    notes: tuple[str, ...] = ()

    def tre_mm(self, points_mm: Targets) -> Float64[np.ndarray, " m"]:
        """The rms error to expect at points (m, 3) of the first frame."""
        return expected_tre_mm(self.from_mm, points_mm, self.fle_mm)

    def bound_mm(self, points_mm: Targets) -> float:
        """What the error at any of the points stays below with 95 %, all of it along one axis at
        worst; by Student's t, as few beads tell little of their own error."""
        free = 3 * len(self.beads) - 6
        return float(t.ppf(0.5 + _CERTAIN / 2, free) * self.tre_mm(points_mm).max())

    def report(self, targets: dict[str, Targets]) -> dict[str, Any]:
        """Plain JSON; ``targets``: points of the first frame by name, of which each gets the
        largest error to expect."""
        return {
            "rows": self.to_from.tolist(),
            "unit": "mm",
            "fre_mm": self.fre_mm,
            "fle_mm": self.fle_mm,
            "tre_mm": {name: float(self.tre_mm(at).max()) for name, at in targets.items()},
            "beads": list(self.beads),
            "left_mm": self.left_mm.tolist(),
            "without_it_mm": self.without_mm.tolist(),
            "notes": list(self.notes),
        }


def expected_tre_mm(
    beads_mm: Float[np.ndarray, "*k n 3"], points_mm: Targets, fle_mm: float
) -> Float64[np.ndarray, "*k m"]:
    """The rms error expected at points of a registration by beads that are each off by ``fle_mm``
    (rms, three axes together, the same in all directions): Fitzpatrick and others, equation 46; of
    several arrangements at once."""
    middle, n = beads_mm.mean(-2, keepdims=True), beads_mm.shape[-2]
    _, spread, axes = np.linalg.svd(beads_mm - middle, full_matrices=False)
    squares = ((points_mm - middle) @ np.swapaxes(axes, -1, -2)) ** 2  # along principal axes
    off_axis = squares.sum(-1, keepdims=True) - squares
    from_axis = ((spread**2).sum(-1, keepdims=True) - spread**2) / n  # of the beads, mean square
    return np.asarray(fle_mm * np.sqrt((1 + (off_axis / from_axis[..., None, :]).sum(-1) / 3) / n))


def register(kit: Kit, first: NamedBeads, second: NamedBeads) -> Registration:
    """The first device's frame to the second's by the beads that both have, as they are found: what
    the print is off cancels out. A bead that lies elsewhere for one of them than for the other is
    left out and named.

    Raises:
        InputError: fewer than 4 are left, or they lie on a line.
    """
    both = np.flatnonzero(first.found & second.found)
    pair = f"{first.device.name} and {second.device.name}"
    usual_mm = float(np.hypot(first.device.error_mm, second.device.error_mm))
    notes = list(dict.fromkeys((*first.notes, *second.notes)))
    while len(both) >= LEAST_BEADS:
        from_mm, to_mm = first.points_mm[both], second.points_mm[both]
        if (across_mm := _across_mm(from_mm)) < _LEAST_SPREAD_MM:
            raise InputError(
                f"{pair}: the {len(both)} beads lie on a line, but for {across_mm:.1f} mm, about "
                "which a turn stays unknown. Bring one beside it into view."
            )
        to_from, left_mm = fit_rigid(from_mm, to_mm)
        without_mm, growth = np.array([_without(from_mm, to_mm, n) for n in range(len(both))]).T
        fre2 = float((left_mm**2).mean())
        fle_mm = max(float(np.sqrt(fre2 / (1 - 2 / len(both)))), usual_mm)
        limits_mm = _OUTLIER * usual_mm * growth
        worst = int((without_mm / limits_mm).argmax())
        if without_mm[worst] <= limits_mm[worst]:
            names = tuple(kit.beads[n].name for n in both)
            fre_mm = float(np.sqrt(fre2))
            what = to_from, names, from_mm, left_mm, without_mm, fre_mm, fle_mm
            return Registration(*what, tuple(notes))
        name = kit.beads[both[worst]].name
        notes.append(
            f"{pair}: bead {name} lies {without_mm[worst]:.1f} mm from where the others have it; "
            "left out"
        )
        both = np.delete(both, worst)
    raise InputError(
        f"{pair} have {len(both)} beads in common that agree; {LEAST_BEADS} are needed. "
        + "; ".join(notes)
        + "."
    )


def _without(from_mm: np.ndarray, to_mm: np.ndarray, n: int) -> tuple[float, float]:
    """How far a bead is from where the others have it, and how far it would be if each were off by
    1 mm."""
    others = np.arange(len(from_mm)) != n
    to_from, _ = fit_rigid(from_mm[others], to_mm[others])
    off_mm = np.linalg.norm(transform_points(to_from, from_mm[[n]])[0] - to_mm[n])
    return float(off_mm), float(np.hypot(1, expected_tre_mm(from_mm[others], from_mm[[n]], 1.0)[0]))
