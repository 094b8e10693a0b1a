"""Evidence beside the points, as terms of the fit: residuals, derivatives by the motion, weights.

A place on or off a part's surface has one residual, its signed distance to the surface; a point of
the CT at a known place has three. Each counts by its own deviation, with the points' robust kernel:
what lies far off counts little, and is named afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Evidence, Free, Held, Landmark, Outline, Touch
from tumortrack.core.report import EvidenceReport
from tumortrack.registration.kernels import POSE
from tumortrack.registration.motion import ElasticMotion

_WIDTHS = 4.0  # of the robust kernel, in standard deviations
_LEAST_WIDTH_MM = 4.0  # so that fits from starts some millimetres off are drawn


@dataclass(frozen=True, eq=False)
class Terms:
    """Residuals at a motion, one a row, and how much each counts in the cost."""

    residuals_mm: Float64[np.ndarray, " t"]
    by_motion: Float64[np.ndarray, "t p"]
    weights: Float64[np.ndarray, " t"]
    cost: float
    width_mm: Float64[np.ndarray, " t"]  # of the robust kernel
    piece: Int64[np.ndarray, " t"]  # the number of the evidence that each belongs to

    @property
    def contradicting(self) -> Int64[np.ndarray, " k"]:
        """Numbers of the evidence that lies beyond the robust kernel's width."""
        return np.unique(self.piece[np.abs(self.residuals_mm) > self.width_mm])

    def add_to(self, curvature: Float64[np.ndarray, "p p"], gradient: np.ndarray) -> float:
        """Into a Gauss-Newton step's equations; the terms' cost."""
        weighted = self.by_motion.T * self.weights
        curvature += weighted @ self.by_motion
        gradient += weighted @ self.residuals_mm
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

    @classmethod
    def of(cls, evidence: Sequence[Evidence], parts: Sequence[str]) -> EvidenceTerms | None:
        """``parts``: names of the organ's. None: there is none. Raises InputError: of a part that
        the organ lacks."""
        surfaces, points = list[tuple[Any, ...]](), list[tuple[Any, ...]]()
        for number, each in enumerate(evidence):
            if isinstance(each, Landmark | Held):
                which_mm = each.point_std_mm if isinstance(each, Held) else 0.0
                std_mm = math.hypot(each.std_mm, which_mm)
                points.append((each.point_ct, each.place_mm, std_mm, number))
                continue
            name = each.part if isinstance(each, Touch | Outline) and each.part else parts[0]
            if name not in parts:
                raise InputError(
                    f"{each.name} {number + 1} is of {name!r}; this organ has {', '.join(parts)}."
                )
            away_mm = 0.0 if isinstance(each, Outline) else each.tip_mm
            about = parts.index(name), away_mm, isinstance(each, Free), each.std_mm, number
            surfaces += [(place, *about) for place in each.places]
        if not surfaces and not points:
            return None
        places, part, offset_mm, free, std_mm, piece = _columns(surfaces, 6)
        points_ct, points_mm, point_std_mm, point_piece = _columns(points, 4)
        return cls(
            np.array(places, float).reshape(-1, 3), np.array(part, int),
            np.array(offset_mm, float), np.array(free, bool),
            np.array(points_ct, float).reshape(-1, 3), np.array(points_mm, float).reshape(-1, 3),
            np.array([*std_mm, *point_std_mm], float), np.array([*piece, *point_piece], int),
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
            away_mm = (motion.carry(self.points_ct) - self.points_mm) @ motion.rotation
            residuals_mm.append(away_mm.ravel())
            by_motion.append(motion.effects(self.points_ct).reshape(-1, unknowns))
        times = np.repeat([1, 3], [len(self.places_mm), len(self.points_ct)])
        std_mm, piece = np.repeat(self.std_mm, times), np.repeat(self.piece, times)
        together = np.concatenate(residuals_mm)
        width_mm = np.maximum(_WIDTHS * std_mm, _LEAST_WIDTH_MM)
        squares = (together / width_mm) ** 2
        cost = float(((width_mm / std_mm) ** 2 * squares / (1 + squares)).sum())
        weights = 1 / (std_mm * (1 + squares)) ** 2
        return Terms(together, np.concatenate(by_motion), weights, cost, width_mm, piece)

    def without(self, pieces: Int64[np.ndarray, " k"]) -> EvidenceTerms:
        """The rest."""
        kept = ~np.isin(self.piece, pieces)
        places, points = np.split(kept, [len(self.places_mm)])
        return EvidenceTerms(
            self.places_mm[places], self.part[places], self.offset_mm[places], self.free[places],
            self.points_ct[points], self.points_mm[points], self.std_mm[kept], self.piece[kept],
        )  # fmt: skip

    def described(
        self, evidence: Sequence[Evidence], motion: ElasticMotion
    ) -> tuple[EvidenceReport, ...]:
        """For a report: all ``evidence``, of which these terms are what was not left out."""
        assert motion.covariance is not None
        every = EvidenceTerms.of(evidence, motion.shape.anatomy_ct.names)
        assert every is not None
        terms = every.at(motion)
        known = np.einsum("tp,pq,tq->t", terms.by_motion, motion.covariance, terms.by_motion)
        told = []
        for number, each in enumerate(evidence):
            mine, kept = terms.piece == number, number in self.piece
            share = float((terms.weights[mine] * known[mine]).mean())
            off_mm = float(np.abs(terms.residuals_mm[mine]).max())
            news = min(share, 1.0) if kept else 0.0
            told.append(EvidenceReport(name=each.name, off_mm=off_mm, news=news, left_out=not kept))
        return tuple(told)


def _columns(rows: list[tuple[Any, ...]], count: int) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True)) if rows else [()] * count
