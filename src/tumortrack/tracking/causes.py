"""Why an estimate is poor, or there is none: causes, what most likely happened first.

A cause is named for its evidence. What fits as well as usual once it is freed of a cause (turned to
the camera, mirrored, in another unit, wider or narrower) has that cause; the others follow from
how much of the organ the points show, how far beside it they lie, and how flat or round they are.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tumortrack.core.causes import Cause, Likely
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Points, rotation_onto
from tumortrack.core.report import Check
from tumortrack.core.types import Mesh, SensorCloud
from tumortrack.models.in_distribution import spread_mm
from tumortrack.models.model import Model
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.looks import Looks
from tumortrack.registration.model import RegistrationModel
from tumortrack.sense.cloud import thin_cloud
from tumortrack.sense.units import Unit, likely_unit
from tumortrack.tracking.advice import near_side, unseen

_AXES = "x points right, y down and z away from the camera"
# What it is, and what to do.
_WORDS = {
    Cause.UNIT: ("another unit than mm", "{unit}"),
    Cause.FRAME: ("another frame than the camera's (a robot's, swapped axes)", f"see that {_AXES}"),
    Cause.MIRRORED: (
        "the other side's organ, or a mirrored frame (y up, two axes swapped)",
        f"check the side, and that {_AXES}",
    ),
    Cause.SCALE: (
        "a camera out of scale (the organ fits {number:.2g} times as wide)",
        "check the focal length, and calibrate it",
    ),
    Cause.OBJECT: (
        "something else than the organ (a table, a ball, a hand)",
        "make sure that this is the organ (a click, --box)",
    ),
    Cause.BACKGROUND: (
        "things round the organ left in ({percent:.0f} % of the points)",
        "remove the background (--range NEAR FAR), free the organ of what lies on it",
    ),
    Cause.HIDDEN: ("about {percent:.0f} % of the organ's near side hidden", ""),
    Cause.ANOTHER_PATIENT: ("another patient's organ, or the other side's", "check both"),
    Cause.DEFORMED: ("an organ deformed as hardly any in training", ""),
    Cause.POSES: ("wrong poses, or the organ moved between the views", "check the poses"),
    Cause.VIEW: ("", ""),
}
_POINTS = 400  # of a trial
_FITS, _BETTER = 1.0, 0.6  # times the usual cost, and the present one: right trials have 0.1 to 0.5
_WIDER = 0.5, 0.75, 1.33, 2.0  # x and y, by a wrong focal length
_TRIED = 2  # starts of the search
_ASIDE, _OUTSIDE = 0.64, 0.5  # cosine to z: farther than a D405 sees, than any usual camera
_FACING = 0.5  # cosine to the camera of the side that bulges
_TURNED_MM = 170.0  # away, about where training has organs
# Thickness, and distance from the best sphere, per spread: organs have more than 0.09 and 0.06.
_FLAT, _ROUND = 0.04, 0.02
# From the surface; share of the points; times the usual cost without them: other kidneys have 0.9.
_BESIDE_MM, _MANY, _FITS_WITHOUT = 10.0, 0.03, 0.85
_NOT_THIS = "fit", "seen_through"  # checks that speak against this organ in this place
_GUESSED = (Cause.ANOTHER_PATIENT,)
_HELPED_BY_A_VIEW = Cause.HIDDEN, Cause.ANOTHER_PATIENT, Cause.VIEW
# Shares of the near side, and spread per that of the near side. Other kidneys that are fitted wrong
# leave up to 0.3 of it without points, or spread as widely.
_HIDDEN, _MUCH, _LITTLE = 0.15, 0.3, 0.8


def likely_causes(
    model: Model, cloud: SensorCloud, estimate: Estimate | None
) -> tuple[Likely, ...]:
    """The causes that something speaks for, the likeliest first; at least one.

    Args:
        cloud: the organ's points, camera frame, in which it was located.
        estimate: the poor one; None: there is none.
    """
    points = thin_cloud(cloud, _POINTS, np.random.default_rng(0)).points_mm.astype(float)
    fitted = _fit(model, points) if estimate is None else _fitted_by(estimate)
    suspicious = fitted.check in ("size", "strays", "seen_through") or fitted.cost > _FITS
    found = [Likely(Cause.OBJECT)] if suspicious and _flat_or_round(points) else []
    if not found and (suspicious or _aside(points, _OUTSIDE)):
        found = _tried(model, points, fitted.cost)
    if estimate is not None and estimate.report.size and fitted.check == "size" and not found:
        found.append(Likely(Cause.SCALE, 1 / estimate.report.size.times))
    if not found:
        found = _shown(model, points, fitted) or [Likely(Cause.VIEW)]
    return tuple(found)


def words(causes: tuple[Likely, ...], view: str) -> str:
    """The two likeliest causes, and what to do about the first; ``view``: from where to look, which
    helps where nothing else is known to."""
    parts = []
    for cause, number in ((one.cause, one.number or 0.0) for one in causes[:2]):
        unit = Unit(number).of_cloud if cause is Cause.UNIT else ""
        given = {"number": number, "percent": 100 * number, "unit": unit}
        parts.append([text.format(**given) for text in _WORDS[cause]])
    # Nothing but a bad fit speaks for another patient: the right organ, bent far, looks the same.
    sure, link = ("perhaps", ", or ") if causes[0].cause in _GUESSED else ("most likely", ", else ")
    what = link.join(what for what, _ in parts if what)
    looking = view if causes[0].cause in _HELPED_BY_A_VIEW else ""
    do = ", or ".join(text for text in (parts[0][1], looking) if text)
    return f"{f': {sure} ' if what else ''}{what}{'; ' * bool(do)}{do}"


class _Fitted(NamedTuple):
    """The organ on the points: its surface, the check that failed, and the cost in usual ones, also
    without strays. No surface: it was not tried, since nothing so small or large is an organ."""

    organ: Mesh | None = None
    check: Check = "fit"
    cost: float = math.inf
    without_strays: float = math.inf


def _fitted_by(estimate: Estimate) -> _Fitted:
    check = "other" if estimate.finding is None else estimate.finding.check
    if (cost := estimate.report.fit_cost) is None:
        return _Fitted(estimate.organ_mesh, check, 0.0, 0.0)
    costs = cost.now / cost.usual, cost.without_strays / cost.usual
    return _Fitted(estimate.organ_mesh, check, *costs)


def _fit(model: Model, points: Points) -> _Fitted:
    """By a search and a few refinements, on few points."""
    least, most = model.in_distribution.spread_mm
    if not isinstance(model, RegistrationModel) or not least <= spread_mm(points) <= most:
        return _Fitted()
    looks = Looks.of([points])
    starts = model.registration.search.starts(looks)[:_TRIED]
    fits = [refine(model.shape, looks, start, model.config.refine) for start in starts]
    best, usual = min(fits, key=lambda fit: fit.cost), model.calibration.usual_cost
    organ = model.shape.anatomy_ct.organ
    there = organ.moved(best.motion.carry(organ.vertices_mm))
    return _Fitted(there, "fit", best.cost / usual, best.cost_without_strays / usual)


def _tried(model: Model, points: Points, now: float) -> list[Likely]:
    """What fits once it is turned, mirrored, in another unit or scaled in x and y."""
    found, (turned, facing) = [], _turned(points)
    if _aside(points, _ASIDE) or facing < _FACING:
        cost = _fit(model, turned).cost
        better = cost < _FITS and (cost < _BETTER * now or _aside(points, _ASIDE))
        if better or _aside(points, _OUTSIDE):
            found.append(Likely(Cause.FRAME, fit=cost if math.isfinite(cost) else None))
            points, now = turned, min(now, cost)
    tries = [(Likely(Cause.MIRRORED), points * [-1, 1, 1])]
    tries += [(Likely(Cause.UNIT, one.value), points * one.value) for one in Unit]
    tries += [(Likely(Cause.SCALE, times), points * [times, times, 1]) for times in _WIDER]
    costs = sorted(((_fit(model, there).cost, n) for n, (_, there) in enumerate(tries)))
    most = min(_FITS, _BETTER * now)
    return found + [replace(tries[n][0], fit=cost) for cost, n in costs if cost < most]


def _shown(model: Model, points: Points, fitted: _Fitted) -> list[Likely]:
    """By what the points show of the organ, and beside it."""
    organ, check, found = fitted.organ, fitted.check, list[Likely]()
    if organ is None:
        (least, most), spread = model.in_distribution.spread_mm, spread_mm(points)
        if unit := likely_unit(np.array([spread]), (least, most)):
            return [Likely(Cause.UNIT, unit.value)]
        far = np.linalg.norm(points - np.median(points, 0), axis=1) > most
        large = Likely(Cause.BACKGROUND, float(far.mean()))
        small = Likely(Cause.ANOTHER_PATIENT if spread >= least else Cause.OBJECT)
        return [large if spread > most else small]
    from scipy.spatial import cKDTree  # slow to import

    near = near_side(organ)
    beside = float((cKDTree(organ.vertices_mm).query(points)[0] > _BESIDE_MM).mean())
    hidden = float(unseen(near, points).mean()) if len(near) else 0.0
    much = hidden > _MUCH and spread_mm(points) < _LITTLE * spread_mm(near)
    if check == "strays" or (beside > _MANY and fitted.without_strays < _FITS_WITHOUT):
        found.append(Likely(Cause.BACKGROUND, beside))
    if check == "unseen" or (hidden > _HIDDEN and check not in _NOT_THIS) or much:
        found.append(Likely(Cause.HIDDEN, hidden))
    if check in _NOT_THIS:
        other = Cause.OBJECT if check == "seen_through" else Cause.DEFORMED
        found += [Likely(Cause.ANOTHER_PATIENT), Likely(other)]
    return found


def _turned(points: Points) -> tuple[Points, float]:
    """The points with the side that bulges turned to a camera, and the cosine of that side's
    direction to the camera as they are."""
    middle = np.median(points, 0)
    axes = np.linalg.eigh(np.cov(points.T))[1]  # the thinnest first
    thin, wide, long = ((points - points.mean(0)) @ axes).T
    paraboloid = np.stack([wide**2, wide * long, long**2, wide, long, np.ones(len(wide))], 1)
    (a, _, c, *_) = np.linalg.lstsq(paraboloid, thin)[0]
    outwards = -np.sign(a * wide.var() + c * long.var()) * axes[:, 0]
    turn = rotation_onto(outwards, np.array([0.0, 0.0, -1.0]))
    facing = -float(outwards @ middle / np.linalg.norm(middle))
    return (points - middle) @ turn.T + [0, 0, _TURNED_MM], facing


def _flat_or_round(points: Points) -> bool:
    spread, centred = spread_mm(points), points - points.mean(0)
    sphere = np.linalg.lstsq(np.c_[2 * centred, np.ones(len(points))], (centred**2).sum(1))[0]
    radius = math.sqrt(sphere[3] + sphere[:3] @ sphere[:3])
    off_mm = np.abs(np.linalg.norm(centred - sphere[:3], axis=1) - radius)
    thickness = math.sqrt(max(np.linalg.eigvalsh(np.cov(points.T))[0], 0.0))
    return thickness < _FLAT * spread or float(np.percentile(off_mm, 80)) < _ROUND * spread


def _aside(points: Points, cosine: float) -> bool:
    """Whether they lie farther from the camera's axis than this."""
    middle = np.median(points, 0)
    return bool(middle[2] < cosine * np.linalg.norm(middle))
