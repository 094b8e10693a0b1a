"""Where fits start: search for the organ in all poses that the case allows, and turned over.

A rigid body is fitted to few points from starts all around, in compiled calls on two threads. The
best fits, so far apart that each may end in another minimum, are where ``gauss_newton`` starts;
then poses turned beside its best fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from tumortrack.core.geometry import Points, rotation_onto, triangles_of, turned_by, unit
from tumortrack.core.process import parallel_for
from tumortrack.native import F32, F64, kernel
from tumortrack.organ.rest_shape import DISTANCES, RestShape
from tumortrack.registration.in_distribution import RIVAL_COST
from tumortrack.registration.motion import POSE, ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud

Rotations = Float64[np.ndarray, "*n 3 3"]
Centres = Float64[np.ndarray, "s 3"]  # of the organ, camera frame, mm
_TOWARDS_CAMERA = np.array([0.0, 0.0, -1.0])
# What these numbers rest on: docs/decisions/034-limits.md.
# Points of all views, the robust kernel's widths step by step, and the share of the starts that go
# on: first all of them on few points, then the better ones on more.
_STAGES = (
    (100, 15.0 * 0.8 ** np.arange(4), 1 / 4),
    (250, 6.0 * 0.8 ** np.arange(7), 1.0),
)
# Of their mean cost, beside evidence: as if some 30 points were independent of each other, and a
# rigid body missed each by 2 mm.
_POINTS_COST = 70.0
_COMPARED_MM = 3.0  # the width by which starts are compared: a rigid body errs by that
_DAMPING = np.repeat([0.02**2, 1.0], 3)  # of a shift (1/mm^2) and a turn
_TURN_DEGREES = 15.0  # between starts, about the line of sight
_TILT_DEGREES = 20.0  # of starts beside the one that faces the camera, where tilts are limited
_SIDES = 32  # of the organ that starts face the camera with, where all rotations are allowed
_ALONG = 0.0, 0.25, -0.25  # of the organ's length, along what is longest in the picture
APART_MM = 10.0  # starts nearer to each other mostly end in one minimum
_KEPT_AGAIN = 4  # while the organ is followed
_KEPT, _KEPT_BEYOND = 8, 2  # of those that the prior allows, and that it excludes
_AT_ONCE = 16  # starts: a thread's part
_NEARER_HALF, _REACH = (2, 50), 3.0  # per cent of the points; a domed side reaches thrice as deep
_VERTICES = 500  # that tell which part of the organ a camera sees
_SOFT_DEGREES = 8.0  # one standard deviation of a tilt beyond those that are allowed
_TURNED_STDS = 4.5  # standard deviations to both sides


# The organ at rest, points, the robust kernel's width in each step and the one to compare by,
# damping; as ``gauss_newton`` minimises, without an elastic state and a prior. In C:
# native/fast/search.c.
_descend_rigidly = kernel(
    "descend_rigidly", (DISTANCES, F64[3], F32["n", 3], F64["steps"], float, F64[POSE]),
    F32[POSE + 1, "n"].out, F64["s", 3, 3].out, F64["s", 3].out, F64["s"].out, result=int,
)  # fmt: skip


class Start(NamedTuple):
    """Where a fit starts. ``pose_offset``: shift (mm) and turn (rad) from where the prior has the
    pose; None: it has it here."""

    motion: ElasticMotion
    pose_offset: Float64[np.ndarray, " 6"] | None = None


@dataclass(frozen=True, eq=False)
class PosePrior:
    """How the organ may lie: ``up_ct`` faces the camera, tilted by up to ``tilt_degrees``; 180: it
    may lie in any way. ``allow_flip``: it may also have been turned over."""

    up_ct: Float64[np.ndarray, " 3"]
    tilt_degrees: float = 30.0
    allow_flip: bool = False

    @property
    def unconstrained(self) -> bool:
        """Whether every rotation is allowed."""
        return self.tilt_degrees >= 180

    def tilt_degrees_of(self, rotations: Rotations) -> Float64[np.ndarray, "*n"]:
        """Between the line of sight and what should face the camera."""
        cosines = np.clip((rotations @ self.up_ct) @ _TOWARDS_CAMERA, -1, 1)
        return np.asarray(np.degrees(np.arccos(cosines)))

    def cost(self, rotations: Rotations) -> Float64[np.ndarray, "*n"]:
        """-2 log of their probability, up to a constant: 0 where they are allowed."""
        tilt = self.tilt_degrees_of(rotations)
        tilt = np.minimum(tilt, 180 - tilt) if self.allow_flip else tilt
        # Tilts about two axes, up to tilt_degrees each, add up to sqrt(2) times that.
        beyond = tilt - np.sqrt(2) * self.tilt_degrees
        return np.asarray(np.maximum(0.0, beyond / _SOFT_DEGREES) ** 2)

    def excludes(self, rotations: Rotations) -> Bool[np.ndarray, "*n"]:
        """Whether they are as unlikely as an alternative that is given up."""
        return np.asarray(self.cost(rotations) > RIVAL_COST)

    @property
    def as_stated(self) -> PosePrior:
        """Without the chance that it was turned over."""
        return replace(self, allow_flip=False)

    @cached_property
    def sides_ct(self) -> Float64[np.ndarray, "k 3"]:
        """Directions of the CT that starts turn towards the camera."""
        up = unit(self.up_ct)
        if self.unconstrained:
            n = np.arange(_SIDES) + 0.5  # Fibonacci's sphere
            z, turn = 1 - 2 * n / _SIDES, np.pi * (1 + 5**0.5) * n
            flat = np.sqrt(1 - z**2)
            return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
        level = rotation_onto(_TOWARDS_CAMERA, up)
        away = np.radians(_TILT_DEGREES)
        tilted = [[0, 0], [away, 0], [-away, 0], [0, away], [0, -away]]
        near = [[np.sin(x), np.sin(y), -np.cos(max(abs(x), abs(y)))] for x, y in tilted]
        one_side = np.array(near) @ level.T
        return np.concatenate([one_side, -one_side])  # and the other side up


@dataclass(frozen=True, eq=False)
class Search:
    """Of one organ, in all poses of a prior and, to know of them, with the other side up."""

    rest: RestShape
    prior: PosePrior

    def starts(self, views: MultiViewCloud, again: bool = False) -> list[ElasticMotion]:
        """Undeformed organs where a rigid one fits best, the best first, at least ``APART_MM``
        apart; the best beyond the prior last. ``again``: of an organ that is being followed, from
        half as many turns, as if nothing were hidden: a sixth of the time, once a second."""
        every = np.array(views.points_mm, np.float32, order="C")
        rotations, along = self._rotations, list(_ALONG)
        if again:
            rotations, along = rotations[::2], along[:1]
        centres = self._centres(views, rotations, along)
        rotations = np.repeat(rotations, len(along), axis=0)
        beyond = self.prior.as_stated.excludes(rotations)
        for count, widths_mm, share in _STAGES:
            points_mm = every[:: max(1, len(every) // count)][:count].copy()
            costs = _POINTS_COST * self.descend(points_mm, widths_mm, rotations, centres)
            if views.evidence is not None:
                costs += views.evidence.rigid_costs(self.rest, rotations, centres)
            best = np.concatenate([_least(costs, group, share) for group in (~beyond, beyond)])
            rotations, centres, beyond = rotations[best], centres[best], beyond[best]
        most, others = (_KEPT_AGAIN, 1) if again else (_KEPT, _KEPT_BEYOND)
        others = most if self.prior.allow_flip else others
        return [
            *self._apart(rotations[~beyond], centres[~beyond], most),
            *self._apart(rotations[beyond], centres[beyond], others),
        ]

    def _apart(self, rotations: Rotations, centres: Centres, most: int) -> list[ElasticMotion]:
        """The first ones that lie apart, at most so many."""
        motions: list[ElasticMotion] = []
        for rotation, centre_mm in zip(rotations, centres, strict=True):
            motion = ElasticMotion(self.rest, rotation, centre_mm, self.rest.body.mean)
            if len(motions) < most and far_from(motion, motions):
                motions.append(motion)
        return motions

    def descend(
        self,
        points_mm: Points,
        widths_mm: Float64[np.ndarray, " w"],
        rotations: Rotations,
        centres: Centres,
    ) -> Float64[np.ndarray, " s"]:
        """Refine poses in place, with a robust kernel of these widths in turn; their costs then:
        the mean ``rho`` of the points' distances, by ``_COMPARED_MM``."""
        rest, costs = self.rest, np.empty(len(rotations))
        of_rest = rest.distances[0], rest.body.center_ct
        problem = (*of_rest, points_mm, widths_mm, _COMPARED_MM, _DAMPING)

        def descend_some(part: slice) -> None:
            columns = np.empty((POSE + 1, len(points_mm)), np.float32)
            some = rotations[part], centres[part], costs[part]
            if _descend_rigidly(problem, columns, *some) < len(some[0]):
                raise np.linalg.LinAlgError("the search's curvature is not positive definite")

        parallel_for(descend_some, len(rotations), _AT_ONCE)
        return costs

    @cached_property
    def _rotations(self) -> Float64[np.ndarray, "s 3 3"]:
        """From the CT to the camera: each side turned towards it, then about the line of sight."""
        facing = [rotation_onto(side, _TOWARDS_CAMERA) for side in self.prior.sides_ct]
        angles = np.radians(np.arange(0, 360, _TURN_DEGREES))
        turns = np.array([turned_by(angle * np.array([0.0, 0.0, 1.0])) for angle in angles])
        return (turns[None] @ np.array(facing)[:, None]).reshape(-1, 3, 3)

    @cached_property
    def _surface(self) -> tuple[Float64[np.ndarray, "v 3"], Float64[np.ndarray, "v 3"]]:
        """Middles of some of the organ's triangles, about its centre, and their normals."""
        organ = self.rest.anatomy_ct.organ
        middles, normals = triangles_of(organ.vertices_mm, organ.faces)
        area = np.linalg.norm(normals, axis=1)
        drawn = np.random.default_rng(0).choice(len(area), _VERTICES, p=area / area.sum())
        return middles[drawn] - self.rest.body.center_ct, normals[drawn] / area[drawn, None]

    def _centres(
        self, views: MultiViewCloud, rotations: Rotations, shares: Sequence[float]
    ) -> Float64[np.ndarray, "t 3"]:
        """Where the organ's centre is if the middle of what a camera sees of it lies in the middle
        of the points; and shifted along the organ: a part of it may be hidden."""
        middle_mm = np.median(views.points_mm, axis=0).astype(float)
        places, normals = self._surface
        weights = np.zeros((len(rotations), len(places)))
        for number, pose in enumerate(views.camera_from_view):
            ray = unit(middle_mm - pose[:3, 3])
            towards = rotations.transpose(0, 2, 1) @ ray
            depth_mm, shown_mm = towards @ places.T, views.points_mm[views.view == number] @ ray
            # The deeper part of an organ that reaches farther than the points do is not shown. By
            # their nearer half, since what lies behind them may be background.
            reach_mm = _REACH * np.ptp(np.percentile(shown_mm, _NEARER_HALF))
            near = depth_mm <= depth_mm.min(axis=1, keepdims=True) + reach_mm
            # Pixels are as many as an area is wide as they see it.
            weights += near * np.maximum(-towards @ normals.T, 0)
        weights /= weights.sum(axis=1, keepdims=True)
        shown = np.einsum("sij,sj->si", rotations, weights @ places)
        along = rotations @ self.rest.long_axis_mm * [1, 1, 0]
        centres = (middle_mm - shown)[:, None] + np.array(shares)[:, None] * along[:, None]
        return np.ascontiguousarray(centres.reshape(-1, 3))


def _least(
    costs: Float64[np.ndarray, " s"], group: Bool[np.ndarray, " s"], share: float
) -> Int64[np.ndarray, " k"]:
    """The numbers of the least costs of a group, so large a share of it."""
    mine = np.flatnonzero(group)
    return mine[np.argsort(costs[mine])[: max(1, round(share * len(mine)))]]


def distance_mm(other: ElasticMotion, motion: ElasticMotion) -> float:
    """About how far the poses have the centre, or a point 50 mm from it, apart."""
    turned = 50 * np.abs(other.rotation - motion.rotation).max()
    return float(max(turned, np.abs(other.centre_mm - motion.centre_mm).max()))


def far_from(motion: ElasticMotion, others: Iterable[ElasticMotion]) -> bool:
    """Whether a fit from there may end in another minimum than fits from each of the others."""
    return all(distance_mm(motion, other) > APART_MM for other in others)


def turned_starts(fitted: ElasticMotion, pose_offset: Float64[np.ndarray, " 6"]) -> list[Start]:
    """Turned both ways about each principal axis of the turn's covariance; shift and coefficients
    follow as they are correlated with the turn. ``pose_offset``: as in ``Start``, of the fit."""
    covariance = fitted.covariance
    assert covariance is not None
    variances, axes = np.linalg.eigh(covariance[3:6, 3:6])
    starts = []
    for variance, axis in zip(variances, axes.T, strict=True):
        for stds in (_TURNED_STDS, -_TURNED_STDS):
            # The conditional mean, given a turn by so many deviations about this axis.
            off = covariance[:, 3:6] @ axis * stds / math.sqrt(variance)
            motion = replace(
                fitted,
                rotation=fitted.rotation @ turned_by(off[3:6]),
                centre_mm=fitted.centre_mm + fitted.rotation @ off[:3],
                coefficients=fitted.coefficients + off[6:],
            )
            starts.append(Start(motion, pose_offset + off[:6]))
    return starts
