"""Evidence beside the points, as terms of the fit: residuals, derivatives by the motion, weights.

A place on or off a part's surface has one residual, its signed distance to the surface; a point of
the CT at a known place has three. Each counts by its own deviation, on the way to a fit with the
points' robust kernel, then as true or false (``Terms.judged``): what is rather false is named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Cut, Evidence, FreeSpace, Grasp, Landmark, Outline, Touch
from tumortrack.core.geometry import Affine, transform_points
from tumortrack.core.mesh_query import surface_distance
from tumortrack.core.report import EvidenceReport
from tumortrack.organ.rest_shape import RestShape
from tumortrack.registration.motion import POSE, ElasticMotion, seen_from_first

_WIDTHS = 4.0  # of the robust kernel, in standard deviations
_LEAST_WIDTH_MM = 4.0  # so that fits from starts some millimetres off are drawn
SURFACE_MM = 1.0  # of the model's surfaces, segmentation included: ``sigma_mm`` of the points
# Of single places a share is of something else, and lies anywhere within a hand's breadth: assumed.
_FALSE, _WITHIN_MM = 0.05, 40.0
_RIGID_MM = 4.0  # error of the undeformed organ at best
_DRIFT = 0.1  # error along an axis of where tissue is said to go, per way that it went
_OLD_MM = 5.0  # of what it errs by having moved since; with more it tells nothing
MOST_PLACES = 1000  # with so many an answer takes a second, several where they contradict it
_MOST_KEPT = 200  # from frame to frame, the newest: a frame then takes three times as long


@dataclass(frozen=True, eq=False)
class Terms:
    """Residuals at a motion, one a row, and how much each counts. ``by_shifts``: what one standard
    deviation of each tool's shift does; the most likely ``shifts`` are left out of the equations
    (Schur complement)."""

    residuals_mm: Float64[np.ndarray, " t"]
    by_motion: Float64[np.ndarray, "t p"]
    by_shifts: Float64[np.ndarray, "t s"]
    std_mm: Float64[np.ndarray, " t"]
    width_mm: Float64[np.ndarray, " t"]  # of the robust kernel
    piece: Int64[np.ndarray, " t"]  # the number of the evidence that each belongs to
    place: Int64[np.ndarray, " t"]  # and of the place
    true: Float64[np.ndarray, " t"] | None = None  # the chance that it is, once judged

    @cached_property
    def weights(self) -> Float64[np.ndarray, " t"]:
        """Of their squares in the cost."""
        if self.true is not None:
            return self.true / self.std_mm**2
        return 1 / (self.std_mm * (1 + (self.residuals_mm / self.width_mm) ** 2)) ** 2

    @property
    def judged(self) -> Terms:
        """Each counts as likely as it is true: of those about a place together, with its tool's
        shift allowed for, a share ``_FALSE`` lies anywhere (a mixture; Aitkin and Wilson 1980, doi
        10.2307/1268316)."""
        off = (self.residuals_mm + self.by_shifts @ self.shifts) / self.std_mm
        place = self.place
        squares = np.bincount(place, off**2)
        logs = np.bincount(place, np.log(self.std_mm * np.sqrt(2 * np.pi) / _WITHIN_MM))
        odds = _FALSE / (1 - _FALSE) * np.exp(np.minimum(squares / 2, 100.0) + logs)
        return replace(self, true=(1 / (1 + odds))[place])

    @cached_property
    def cost(self) -> float:
        """As the points' cost: for small residuals their squares, in standard deviations."""
        squares = (self.residuals_mm / self.width_mm) ** 2
        alone = (self.width_mm / self.std_mm) ** 2 @ (squares / (1 + squares))
        return float(alone - self.shifts @ self._own_precision @ self.shifts)

    @cached_property
    def _own_precision(self) -> Float64[np.ndarray, "s s"]:
        return np.eye(self.by_shifts.shape[1]) + (self.by_shifts.T * self.weights) @ self.by_shifts

    @cached_property
    def shifts(self) -> Float64[np.ndarray, " s"]:
        """The most likely at this motion, in standard deviations."""
        slope = (self.by_shifts.T * self.weights) @ self.residuals_mm
        return -np.linalg.solve(self._own_precision, slope)

    @property
    def contradicting(self) -> Int64[np.ndarray, " k"]:
        """Numbers of the evidence of which two places, or half of them, are rather false."""
        true = self.judged.true
        assert true is not None
        first = np.unique(self.place, return_index=True)[1]
        of, false = self.piece[first], true[first] < 0.5
        count, wrong = np.bincount(of), np.bincount(of, false)
        return np.flatnonzero((wrong >= 2) | (2 * wrong >= np.maximum(count, 1)))

    def add_to(self, curvature: Float64[np.ndarray, "p p"], gradient: np.ndarray) -> float:
        """Into a Gauss-Newton step's equations; the terms' cost."""
        weighted = self.by_motion.T * self.weights
        across = weighted @ self.by_shifts
        curvature += weighted @ self.by_motion
        curvature -= across @ np.linalg.solve(self._own_precision, across.T)
        gradient += weighted @ (self.residuals_mm + self.by_shifts @ self.shifts)
        return self.cost


@dataclass(frozen=True, eq=False)
class EvidenceTerms:
    """Evidence in arrays. ``places_mm`` (camera frame) belong to surfaces, at a distance of
    ``offset_mm``, or, where ``free``, of at least that; ``points_ct`` to ``points_mm``."""

    places_mm: Float64[np.ndarray, "n 3"]
    part: Int64[np.ndarray, " n"]
    offset_mm: Float64[np.ndarray, " n"]
    free: Bool[np.ndarray, " n"]
    points_ct: Float64[np.ndarray, "m 3"]
    points_mm: Float64[np.ndarray, "m 3"]
    std_mm: Float64[np.ndarray, " k"]  # of places, then of points
    piece: Int64[np.ndarray, " k"]
    tool: Int64[np.ndarray, " k"]  # which share a shift
    shared_mm: Float64[np.ndarray, " tools"]  # its deviation

    @classmethod
    def from_evidence(
        cls, evidence: Sequence[Evidence], parts: Sequence[str], most: float = MOST_PLACES
    ) -> EvidenceTerms | None:
        """``parts``: names of what can be touched (``Anatomy.closed``). None: there is no evidence.
        Raises InputError: of a part that the organ lacks, or that is open; too many places."""
        if (count := sum(len(each.places) for each in evidence)) > most:
            raise InputError(f"evidence has {count} places; allowed: up to {most}. Thin it out.")
        surfaces, points = list[tuple[Any, ...]](), list[tuple[Any, ...]]()
        tools = dict[str, float]()
        for number, each in enumerate(evidence):
            assert not isinstance(each, Cut)  # it changes the shape: see ``flap``
            tool_name = (each.shared_std_mm and each.tool) or f"piece {number}"
            tools[tool_name] = max(each.shared_std_mm, tools.get(tool_name, 0.0))
            about = number, list(tools).index(tool_name)
            if isinstance(each, Landmark | Grasp):
                which_mm = each.point_std_mm if isinstance(each, Grasp) else 0.0
                whole_mm = math.hypot(each.std_mm, which_mm)
                points.append((each.point_ct, each.place_mm, whole_mm, *about))
                continue
            name = each.part if isinstance(each, Touch | Outline) and each.part else parts[0]
            if name not in parts:
                raise InputError(
                    f"{each.name} {number + 1} is of {name!r}; this organ has {', '.join(parts)}."
                )
            away_mm = 0.0 if isinstance(each, Outline) else each.tip_mm
            std_mm = math.hypot(each.std_mm, SURFACE_MM)
            kind = parts.index(name), away_mm, isinstance(each, FreeSpace), std_mm
            surfaces += [(place, *kind, *about) for place in each.places]
        if not surfaces and not points:
            return None
        places, part, offset_mm, free, *on_surfaces = _columns(surfaces, 7)
        points_ct, points_mm, *of_points = _columns(points, 5)
        stds_mm, piece, tool = (a + b for a, b in zip(on_surfaces, of_points, strict=True))
        return cls(
            np.array(places, float).reshape(-1, 3), np.array(part, int),
            np.array(offset_mm, float), np.array(free, bool),
            np.array(points_ct, float).reshape(-1, 3), np.array(points_mm, float).reshape(-1, 3),
            np.array(stds_mm, float), np.array(piece, int), np.array(tool, int),
            np.array(list(tools.values())),
        )  # fmt: skip

    def at(self, motion: ElasticMotion) -> Terms:
        """The terms at a motion; landmarks' in the organ's axes."""
        unknowns = POSE + len(motion.coefficients)
        rows = np.zeros((len(self.places_mm), unknowns + 1))
        for part in np.unique(self.part):
            mine = self.part == part
            rows[mine] = motion.residual_rows(self.places_mm[mine], part)
        off_mm = rows[:, -1] - self.offset_mm
        off_mm[self.free] = np.minimum(off_mm[self.free], 0)
        residuals_mm, by_motion = [off_mm], [rows[:, :-1] * (off_mm != 0)[:, None]]
        if len(self.points_ct):
            away_mm = (motion.forward(self.points_ct) - self.points_mm) @ motion.rotation
            residuals_mm.append(away_mm.ravel())
            by_motion.append(motion.effects(self.points_ct).reshape(-1, unknowns))
        times = np.repeat([1, 3], [len(self.places_mm), len(self.points_ct)])
        std_mm, piece = np.repeat(self.std_mm, times), np.repeat(self.piece, times)
        tool = np.repeat(self.tool, times)
        together, by_all = np.concatenate(residuals_mm), np.concatenate(by_motion)
        shifted = [n for n in np.unique(tool) if self.shared_mm[n]]
        by_shifts = [by_all[:, :3] * ((tool == n) * self.shared_mm[n])[:, None] for n in shifted]
        width_mm = np.maximum(_WIDTHS * np.hypot(std_mm, self.shared_mm[tool]), _LEAST_WIDTH_MM)
        shifts = np.concatenate([by_all[:, :0], *by_shifts], axis=1)
        place = np.repeat(np.arange(len(times)), times)
        return Terms(together, by_all, shifts, std_mm, width_mm, piece, place)

    def rigid_costs(
        self,
        rest: RestShape,
        rotations: Float64[np.ndarray, "s 3 3"],
        centres: Float64[np.ndarray, "s 3"],
    ) -> Float64[np.ndarray, " s"]:
        """Of the undeformed organ in many poses, which may err by ``_RIGID_MM``."""
        costs, center_ct = np.zeros(len(rotations)), rest.body.center_ct
        stds_mm = np.split(np.hypot(self.std_mm, _RIGID_MM), [len(self.places_mm)])
        for place, part, offset_mm, free, std_mm in zip(
            self.places_mm, self.part, self.offset_mm, self.free, stds_mm[0], strict=True
        ):
            back = np.einsum("sij,si->sj", rotations, place - centres) + center_ct
            off_mm = rest.distances_mm(back, part) - offset_mm
            squares = ((np.minimum(off_mm, 0) if free else off_mm) / std_mm / _WIDTHS) ** 2
            costs += _WIDTHS**2 * squares / (1 + squares)
        for point_ct, place, std_mm in zip(self.points_ct, self.points_mm, stds_mm[1], strict=True):
            away = rotations @ (point_ct - center_ct) + centres - place
            squares = (away**2).sum(1) / (std_mm * _WIDTHS) ** 2
            costs += _WIDTHS**2 * squares / (1 + squares)
        return costs

    @property
    def places_of_tissue_mm(self) -> Float64[np.ndarray, "n 3"]:
        """Camera frame."""
        return np.concatenate([self.places_mm[~self.free], self.points_mm])

    @property
    def on_organ(self) -> Int64[np.ndarray, " o"]:
        """Which terms are of places on the organ's surface, which err with it."""
        return np.flatnonzero((self.part == 0) & ~self.free)

    def described(
        self, evidence: Sequence[Evidence], motion: ElasticMotion, before: int, terms: Terms
    ) -> tuple[EvidenceReport, ...]:
        """For a report: ``evidence``, with its ``terms`` at the motion; the first pieces came
        ``before`` this frame."""
        assert motion.covariance is not None
        anatomy_ct, out = motion.shape.anatomy_ct, set(terms.contradicting.tolist())
        known = ((terms.by_motion @ motion.covariance) * terms.by_motion).sum(1)
        off_mm = np.zeros(len(evidence))
        np.maximum.at(off_mm, terms.piece, np.abs(terms.residuals_mm))
        shares = np.bincount(terms.piece, terms.weights * known) / np.bincount(terms.piece)
        told = []
        for number, each in enumerate(evidence):
            off = float(off_mm[number])
            if number in out and isinstance(each, Touch | Outline):  # perhaps beyond the field
                surface = anatomy_ct.closed[each.part or anatomy_ct.names[0]]
                off = float(surface_distance(surface, motion.inverse(np.array(each.places))).max())
            told.append(
                EvidenceReport(
                    name=each.name,
                    part=getattr(each, "part", ""),
                    tool=each.tool,
                    std_mm=each.std_mm,
                    off_mm=off,
                    information_gain=min(float(shares[number]), 1.0),
                    rejected=number in out,
                    before=number < before,
                    places_mm=each.places,
                )
            )
        return tuple(told)


@dataclass(frozen=True, eq=False)
class TrackedEvidence:
    """A piece of evidence, and the motion as the points alone showed it when it came."""

    piece: Evidence
    motion: ElasticMotion

    def seen_from(self, camera_from_last: Affine) -> TrackedEvidence:
        """Before a camera that has moved."""
        places_mm = transform_points(camera_from_last, np.array(self.piece.places))
        return TrackedEvidence(
            self.piece.at(places_mm, self.piece.std_mm),
            seen_from_first(self.motion, camera_from_last),
        )


def propagate(
    known: Sequence[TrackedEvidence], motion: ElasticMotion
) -> tuple[tuple[TrackedEvidence, ...], tuple[Evidence, ...]]:
    """What tells something yet at a later motion, as the points alone show that; and how it is by
    now. What lies on tissue moves with it, and is less sure the farther from where it came. What a
    tool holds, and where no tissue was, tell nothing but in their own frame; nor do the oldest of
    many."""
    lasting = [each for each in known if each.piece.lasting]
    counts = np.cumsum([len(each.piece.places) for each in reversed(lasting)])
    lasting = lasting[len(lasting) - int((counts <= _MOST_KEPT).sum()) :]
    kept, pieces = list[TrackedEvidence](), list[Evidence]()
    for before, some in groupby(lasting, key=lambda each: each.motion):
        mine = list(some)
        places_mm = np.concatenate([each.piece.places for each in mine])
        moved_mm = motion.forward(before.inverse(places_mm))
        away_mm = np.linalg.norm(moved_mm - places_mm, axis=1)
        ends = np.cumsum([len(each.piece.places) for each in mine])[:-1]
        parts = zip(mine, np.split(moved_mm, ends), np.split(away_mm, ends), strict=True)
        for each, moved, away in parts:
            drift_mm = _DRIFT * float(away.mean())
            if drift_mm <= _OLD_MM:
                kept.append(each)
                pieces.append(each.piece.at(moved, math.hypot(each.piece.std_mm, drift_mm)))
    return tuple(kept), tuple(pieces)


def _columns(rows: list[tuple[Any, ...]], count: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) if rows else [()] * count
