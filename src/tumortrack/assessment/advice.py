"""Advice: what to learn next of a part's place, in closed form, from the fit's covariance.

A touch measures the surface of the organ along its normal, a landmark a point's place, an outline
the border of the part, a view from another side all of the surface that faces it. By Kalman's
update each narrows the covariance of everything that moves with what it measures, before anybody
takes it. Alternatives count as one more unknown each, with their share of the probability.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import msgspec
import numpy as np
from jaxtyping import Float64

from tumortrack.assessment.bound import bound_mm, shipped
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Points, triangles_of, turned_by, unit
from tumortrack.core.report import FitReport, NextEvidence
from tumortrack.registration.config import GaussNewtonConfig
from tumortrack.registration.motion import ElasticMotion
from tumortrack.simulation.noise import CAMERA_STD

_DEFAULTS = GaussNewtonConfig()
_PLACES = 200  # on the organ's surface
_APART_MM = 10.0  # no two touches nearer to each other
# Of each place, the model's surface included, and of what all touches of one tool share, as a
# hand-eye calibration's error.
_TOUCH_MM, _OUTLINE_MM, _LANDMARK_MM, _SHARED_MM = 1.4, 1.8, 2.0, 1.0
_IN_OUTLINE = 12  # places
_VIEW_DEGREES, _VIEWS = 30.0, 8  # all around the present line of sight
_FACING = 0.3  # cosine to the line of sight: flatter surfaces return little
_NEAR_MM = 2.0  # of an outline's plane
# Only what pays: what lowers a bound by more than this, of kinds whose foreseen gains were found in
# scenes left out (found over foreseen).
_LEAST_GAIN_MM, _FOUND = 1 / 3, (0.7, 1.3)

Place = Float64[np.ndarray, " 3"]
Kind = Literal["touch", "outline", "landmark", "view"]
# Whether a tool can touch the organ at a place, where its outward normal is this; camera frame, mm.
Reach: TypeAlias = Callable[[Place, Place], bool]


def advise(estimate: Estimate, part: str, reach: Reach | None = None) -> tuple[NextEvidence, ...]:
    """What to learn next of a part's place: the best three touches, each after those before it, and
    the best outline, landmark and look from another side.

    Args:
        reach: says whether a tool can touch a place with this outward normal (camera frame, mm);
            None: any place will do.

    Raises:
        InputError: the organ has no such part, or the model knows no motion.
    """
    motion = estimate.motion
    if not isinstance(motion, ElasticMotion) or motion.covariance is None:
        raise InputError("advice needs a model that knows a motion: give the case itself.")
    advisor = Advisor(motion, part_number(part, motion.shape.anatomy_ct.names))
    advice = *advisor.touches(reach=reach), *advisor.others()
    return _with_bounds(estimate, advice)


def worthwhile(advice: Sequence[NextEvidence]) -> tuple[NextEvidence, ...]:
    """The advice that pays."""
    kinds = shipped().advice
    return tuple(
        each
        for each in advice
        if _FOUND[0] <= kinds.get(each.kind, 0.0) <= _FOUND[1]
        and each.bound_mm is not None
        and each.then_bound_mm is not None
        and each.bound_mm - each.then_bound_mm > _LEAST_GAIN_MM
    )


def next_evidence(
    estimate: Estimate, part: int | None, config: GaussNewtonConfig, touches_only: bool
) -> tuple[NextEvidence, ...]:
    """What pays of a part (its number), or else of the tumor that is least sure."""
    motion = estimate.motion
    if not isinstance(motion, ElasticMotion) or not estimate.report.tumors:
        return ()
    advisor = Advisor(motion, least_sure(estimate.report) if part is None else part, config)
    advice = advisor.touches()
    if not touches_only:
        advice += advisor.others()
    return worthwhile(_with_bounds(estimate, advice))


def least_sure(report: FitReport) -> int:
    """The number of the tumor whose place is least sure."""
    return 1 + int(np.argmax([part.center_std_mm or 0.0 for part in report.tumors.values()]))


def part_number(part: str, parts: Sequence[str]) -> int:
    """Raises InputError: there is no such part."""
    if part not in parts:
        raise InputError(f"there is no part {part!r} to advise on; allowed: {', '.join(parts)}.")
    return parts.index(part)


def _with_bounds(estimate: Estimate, advice: Sequence[NextEvidence]) -> tuple[NextEvidence, ...]:
    """The advice on a part with the bound that each piece would lower, after those before it, as
    far as that is known."""
    now_mm, factor = max((each.std_mm for each in advice), default=0.0), estimate.assessment.factor

    def most_mm(part: str, std_mm: float) -> float | None:
        most_mm = bound_mm(estimate.report, part, std_mm / now_mm)
        return most_mm and factor * most_mm

    return tuple(
        msgspec.structs.replace(
            each,
            bound_mm=most_mm(each.part, each.std_mm),
            then_bound_mm=most_mm(each.part, each.then_std_mm),
        )
        for each in advice
    )


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of a part's middle (``middle``: how it moves with all unknowns) and of all
    unknowns together; organ's axes."""

    middle: Float64[np.ndarray, "3 p"]
    covariance: Float64[np.ndarray, "p p"]

    @property
    def std_mm(self) -> float:
        """Along the least sure axis."""
        own = self.middle @ self.covariance @ self.middle.T
        return float(np.sqrt(np.linalg.eigvalsh(own)[-1]))

    def after(self, rows: Float64[np.ndarray, "k p"], std_mm: float, shared: int = 0) -> _Known:
        """Once this is measured, each row with this deviation; the camera errs by ``CAMERA_STD``
        along the first ``shared`` unknowns (Woodbury)."""
        precision = rows.T @ rows / std_mm**2
        if shared:
            across = precision[:, :shared]
            own = np.diag(CAMERA_STD[:shared] ** -2) + precision[:shared, :shared]
            precision = precision - across @ np.linalg.solve(own, across.T)
        gained = np.eye(len(precision)) + self.covariance @ precision
        return _Known(self.middle, np.linalg.solve(gained, self.covariance))

    def with_unknowns(self, variances: Float64[np.ndarray, " u"]) -> _Known:
        """And with these, which do not move the middle."""
        p, u = len(self.covariance), len(variances)
        covariance = np.diag(np.append(np.zeros(p), variances))
        covariance[:p, :p] = self.covariance
        return _Known(np.concatenate([self.middle, np.zeros((3, u))], axis=1), covariance)

    def best(self, rows: Float64[np.ndarray, "n p"], std_mm: float) -> int:
        """Of single measurements."""
        shared = rows @ self.covariance
        with_middle = shared @ self.middle.T / np.sqrt((shared * rows).sum(1) + std_mm**2)[:, None]
        own = self.middle @ self.covariance @ self.middle.T
        left = own - with_middle[:, :, None] * with_middle[:, None, :]
        return int(np.linalg.eigvalsh(left)[:, -1].argmin())


@dataclass(frozen=True, eq=False)
class Advisor:
    """Of one part (its number) of an organ that was found."""

    motion: ElasticMotion
    part: int
    config: GaussNewtonConfig = _DEFAULTS

    def touches(self, count: int = 3, reach: Reach | None = None) -> tuple[NextEvidence, ...]:
        """The best places of the organ's surface that a tool reaches, each after those before
        it."""
        places_mm, normals = self._surface()
        rows, known, advised = self._rows(places_mm), self._known(), list[NextEvidence]()
        known = known.with_unknowns(_SHARED_MM**2 * np.ones(3))
        rows = np.concatenate([rows, rows[:, :3]], axis=1)
        free = np.ones(len(rows), bool)
        while len(advised) < count and free.any():
            best = int(np.flatnonzero(free)[known.best(rows[free], _TOUCH_MM)])
            if reach is not None and not reach(places_mm[best], normals[best]):
                free[best] = False
                continue
            then = known.after(rows[[best]], _TOUCH_MM)
            advised.append(self._entry("touch", places_mm[best], normals[best], known, then))
            known = then
            free &= np.linalg.norm(places_mm - places_mm[best], axis=1) > _APART_MM
        return tuple(advised)

    def others(self) -> tuple[NextEvidence, ...]:
        """The best outline of the part, landmark, and look from another side."""
        kinds = self._outlines(), self._landmarks(), self.views()
        best = [min(kind, key=lambda each: each.then_std_mm, default=None) for kind in kinds]
        return tuple(each for each in best if each is not None)

    def _outlines(self) -> Iterator[NextEvidence]:
        mesh = self.motion.shape.anatomy_ct.parts[self.part]
        places_mm, known = self.motion.forward(mesh.vertices_mm), self._known()
        middle_mm = places_mm.mean(0)
        for normal in np.eye(3):
            near = places_mm[np.abs((places_mm - middle_mm) @ normal) < _NEAR_MM]
            some = near[:: max(1, len(near) // _IN_OUTLINE)]
            then = known.after(self._rows(some, self.part), _OUTLINE_MM)
            yield self._entry("outline", middle_mm, normal, known, then)

    def _landmarks(self) -> Iterator[NextEvidence]:
        known = self._known()
        for name, mesh in self.motion.shape.anatomy_ct.structures.items():
            middle_ct = mesh.vertices_mm.mean(0, keepdims=True)
            then = known.after(self._moves(middle_ct)[0], _LANDMARK_MM)
            place_mm = self.motion.forward(middle_ct)[0]
            yield self._entry("landmark", place_mm, np.zeros(3), known, then, name)

    def views(self) -> Iterator[NextEvidence]:
        """From places about the camera's line of sight, at its distance."""
        places_mm, normals = self._surface()
        middle_mm, rows, known = places_mm.mean(0), self._rows(places_mm), self._known()
        across = np.cross(middle_mm, [0.0, 1.0, 0.0])
        for angle in np.linspace(0, 2 * np.pi, _VIEWS, endpoint=False):
            axis = turned_by(angle * unit(middle_mm)) @ unit(across)
            towards = turned_by(np.radians(_VIEW_DEGREES) * axis) @ -middle_mm
            mine = rows[normals @ unit(towards) > _FACING]
            std_mm = self.config.sigma_mm * np.sqrt(max(len(mine), 1) / self.config.n_effective)
            then = known.after(mine, std_mm, len(CAMERA_STD))
            yield self._entry("view", middle_mm + towards, -unit(towards), known, then)

    def _surface(self) -> tuple[Points, Points]:
        """Middles of some of the organ's triangles, and their normals."""
        organ = self.motion.shape.anatomy_ct.organ
        faces = organ.faces[:: max(1, len(organ.faces) // _PLACES)]
        used, numbers = np.unique(faces, return_inverse=True)
        vertices_mm = self.motion.forward(organ.vertices_mm[used])
        places_mm, normals = triangles_of(vertices_mm, numbers.reshape(faces.shape))
        return places_mm, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def _known(self) -> _Known:
        covariance, shares = (
            self.motion.covariance,
            [share for _, share in self.motion.alternatives],
        )
        assert covariance is not None
        middle = self._moves(self.motion.shape.middles_ct[[self.part]])[0]
        own = _Known(middle[:, : len(covariance)], self.motion.std_scale**2 * covariance)
        return replace(own.with_unknowns(np.array(shares)), middle=middle)

    def _moves(self, points_ct: Points) -> Float64[np.ndarray, "n 3 p"]:
        here = self.motion.forward(points_ct)
        away = [
            (alternative.forward(points_ct) - here) @ self.motion.rotation
            for alternative, _ in self.motion.alternatives
        ]
        return np.concatenate([self.motion.effects(points_ct), *(a[:, :, None] for a in away)], 2)

    def _rows(self, places_mm: Points, part: int = 0) -> Float64[np.ndarray, "n p"]:
        rows = self.motion.residual_rows(places_mm, part).astype(float)
        others = [
            alternative.residual_rows(places_mm, part)[:, [-1]] - rows[:, [-1]]
            for alternative, _ in self.motion.alternatives
        ]
        return np.concatenate([rows[:, :-1], *others], axis=1)

    def _entry(
        self, kind: Kind, place: Place, direction: Place, now: _Known, then: _Known, name: str = ""
    ) -> NextEvidence:
        x, y, z, i, j, k = map(float, [*place, *direction])
        return NextEvidence(
            kind=kind,
            part=self.motion.shape.anatomy_ct.names[self.part],
            place_mm=(x, y, z),
            direction=(i, j, k),
            std_mm=now.std_mm,
            then_std_mm=then.std_mm,
            name=name,
        )
