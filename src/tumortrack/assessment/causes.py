"""Likely causes of a poor estimate, or of none, the most likely first, and what to do about them.

Each cause needs evidence. Points that fit as well as usual once a cause is undone (turned to the
camera, mirrored, in another unit, scaled in x and y) have that cause; the others follow from how
much of the organ the points show, how far from it they lie, and how flat or round they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.assessment.advice import Advisor, least_sure
from tumortrack.core.cloud import thin_cloud
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Points, rotation_onto, transform_points, triangles_of
from tumortrack.core.report import Cause, Check, Likely
from tumortrack.core.tables import read_table
from tumortrack.core.types import Mesh, SensorCloud, View
from tumortrack.core.units import Unit, likely_unit
from tumortrack.registration.base_model import Model
from tumortrack.registration.gauss_newton import refine
from tumortrack.registration.in_distribution import spread_mm
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion
from tumortrack.registration.multi_view import MultiViewCloud

# By cause: what it is called, and what to do about it.
_WORDS = read_table("tumortrack.assessment", "causes.toml", dict[str, tuple[str, str]])
_POINTS = 400  # of a trial fit
# What these limits rest on: docs/decisions/034-limits.md.
# A trial must cost less than so many times the usual and the present cost.
_FITS, _BETTER = 1.0, 0.6
_XY_SCALES = 0.5, 0.75, 1.33, 2.0  # of a wrong focal length
_STARTS = 2  # of the search that are refined
_BEYOND_D405, _BEYOND_CAMERAS = 0.64, 0.5  # cosine to z: outside a D405's view, any usual camera's
_FACING = 0.5  # cosine between the bulging side and the camera
_TURNED_MM = 170.0  # from the camera, about where training has organs
_FLAT, _ROUND = 0.04, 0.02  # thickness, and distance from the best sphere, per spread
# Background: distance from the surface, share of the points, and times the usual cost without them.
_BACKGROUND_MM, _BACKGROUND_SHARE, _FITS_WITHOUT = 10.0, 0.03, 0.85
_NOT_THIS = "fit", "seen_through"  # checks that speak against this organ in this place
_NEARLY = 0.9  # of the usual cost: nine tenths of the right fits cost less
_GUESSED = (Cause.ANOTHER_PATIENT,)
# Noise may be the cause of all else, and then tells no patient from another.
_NOISY_MM, _OF_BAD_FITS = 1.0, (Cause.ANOTHER_PATIENT, Cause.DEFORMED)
_OF_CAMERAS = Cause.HIDDEN, Cause.NOISE
_HELPED_BY_A_VIEW = Cause.HIDDEN, Cause.ANOTHER_PATIENT, Cause.VIEW
# Hidden shares of the near side, and the points' spread relative to the near side's.
_HIDDEN, _MOSTLY_HIDDEN, _SMALL_SPREAD = 0.15, 0.3, 0.8

_OF_POSES = "none", "poses", "fit", "outliers", "seen_through"  # checks that wrong poses fail
_NOTHING_HIDES = 0.9  # of the organ's image is in sight; the rest has no return, as at its edges
TOUCH_MORE = "touch more places, all over what can be reached of it"
_MAX_SAMPLES = 2000  # faces of the organ that are looked at
_MIN_COSINE = 0.3  # to the line of sight: surfaces at a flatter angle return little
_SEEN_WITHIN_MM = 8.0  # of an observed point
_MAX_HIDDEN = 0.1  # share of the side that faces the camera
_MIN_SINE = 0.3  # to the line of sight: below it, a direction is along the view
KnownCauses = Mapping[str, tuple[Likely, ...]]


def explained(
    model: Model, views: Sequence[View], estimate: Estimate, known: KnownCauses
) -> tuple[tuple[Likely, ...], str]:
    """Causes of a poor estimate, and what probably happened and what to do, in words. ``known``:
    recent causes by failed check, which are not searched for again."""
    causes = causes_of(model, views, estimate, known)
    alone = views[0].of_no_camera
    # Touches hide nothing and have no noise in depths, and no camera can look elsewhere.
    in_sight = estimate.report.in_sight
    hides = not alone and (in_sight is None or in_sight < _NOTHING_HIDES)
    never = _OF_CAMERAS if alone else () if hides else (Cause.HIDDEN,)
    causes = tuple(c for c in causes if c.cause not in never) or (Likely(Cause.VIEW),)
    probes = estimate.report.probes if check_of(estimate) == "place" else ()
    if any(probe.undetermined and probe.shift_std_mm for probe in probes):
        causes = (Likely(Cause.PROBE), *(c for c in causes if c.cause is not Cause.VIEW))
    view = TOUCH_MORE if alone else where_to_look(estimate, views, hides)
    return causes, words(causes, view)


def causes_of(
    model: Model, views: Sequence[View], estimate: Estimate | None, known: KnownCauses
) -> tuple[Likely, ...]:
    """With those that views, evidence and frames before tell; None: there is no estimate."""
    check = check_of(estimate)
    if len(views) > 1 and check in _OF_POSES:
        return (Likely(Cause.POSES),)
    pieces = () if estimate is None else estimate.report.evidence
    # The piece that lies the farthest from where the rest has it.
    out = [(each.off_mm, number) for number, each in enumerate(pieces, 1) if each.rejected]
    wrong = (Likely(Cause.EVIDENCE, max(out)[1]),) if out else ()
    before = tuple(c for c in known.get(check, ()) if c.cause is not Cause.EVIDENCE)
    return *wrong, *(before or likely_causes(model, views[0].cloud, estimate))


def check_of(estimate: Estimate | None) -> str:
    """The check that it failed; ``none`` without an estimate."""
    if estimate is None:
        return "none"
    return "" if estimate.finding is None else estimate.finding.check


def likely_causes(
    model: Model, cloud: SensorCloud, estimate: Estimate | None
) -> tuple[Likely, ...]:
    """The causes with evidence, the most likely first; at least one.

    Args:
        cloud: the organ's points, camera frame, in which it was located.
        estimate: the poor one, if there is one.
    """
    points = thin_cloud(cloud, _POINTS, np.random.default_rng(0)).points_mm.astype(float)
    fit = _fit(model, points) if estimate is None else _fit_of(estimate)
    suspicious = fit.check in ("size", "outliers", "seen_through") or fit.cost > _FITS
    causes = [Likely(Cause.OBJECT)] if suspicious and _flat_or_round(points) else []
    if not causes and (suspicious or _off_axis(points, _BEYOND_CAMERAS)):
        causes = _by_trials(model, points, fit.cost)
    if estimate is not None and estimate.report.size and fit.check == "size" and not causes:
        causes.append(Likely(Cause.SCALE, 1 / estimate.report.size.times))
    if not causes:
        causes = _by_coverage(model, points, fit)
        if cloud.noise is not None and cloud.noise.measured_mm > _NOISY_MM:
            causes = [cause for cause in causes if cause.cause not in _OF_BAD_FITS]
            causes.insert(0, Likely(Cause.NOISE, cloud.noise.measured_mm))
    return tuple(causes) or (Likely(Cause.VIEW),)


def words(causes: tuple[Likely, ...], view: str) -> str:
    """The two most likely causes, and what to do about the first. ``view``: from where to look,
    given for causes that another view may resolve."""
    parts = []
    for cause, number in ((likely.cause, likely.number or 0.0) for likely in causes[:2]):
        unit = Unit(number).of_cloud if cause is Cause.UNIT else ""
        values = {"number": number, "percent": 100 * number, "unit": unit}
        parts.append([text.format(**values) for text in _WORDS[cause.name]])
    # The only evidence for another patient is a bad fit, which the right organ has if bent far.
    sure, link = ("perhaps", ", or ") if causes[0].cause in _GUESSED else ("most likely", ", else ")
    what = link.join(what for what, _ in parts if what)
    looking = view if causes[0].cause in _HELPED_BY_A_VIEW else ""
    do = ", or ".join(text for text in (parts[0][1], looking) if text)
    return f"{f': {sure} ' if what else ''}{what}{'; ' * bool(do)}{do}"


class _Fit(NamedTuple):
    """The organ on the points: its surface, the check that failed, and the cost relative to the
    usual one, with and without outliers. Without a surface nothing was fitted: the points are too
    small or large for an organ."""

    organ: Mesh | None = None
    check: Check = "fit"
    cost: float = math.inf
    without_outliers: float = math.inf


def _fit_of(estimate: Estimate) -> _Fit:
    check = "other" if estimate.finding is None else estimate.finding.check
    if (cost := estimate.report.fit_cost) is None:
        return _Fit(estimate.organ_mesh, check, 0.0, 0.0)
    costs = cost.now / cost.usual, cost.without_outliers / cost.usual
    return _Fit(estimate.organ_mesh, check, *costs)


def _fit(model: Model, points: Points) -> _Fit:
    """By a search and a few refinements, on few points."""
    least, most = model.in_distribution.spread_mm
    if not isinstance(model, RegistrationModel) or not least <= spread_mm(points) <= most:
        return _Fit()
    views = MultiViewCloud.from_points([points])
    starts = model.registration.search.starts(views)[:_STARTS]
    fits = [refine(model.shape, views, start, model.config.refine) for start in starts]
    best, usual = min(fits, key=lambda fit: fit.cost), model.calibration.usual_cost
    organ = model.shape.anatomy_ct.organ
    fitted = organ.with_vertices(best.motion.forward(organ.vertices_mm))
    return _Fit(fitted, "fit", best.cost / usual, best.cost_without_strays / usual)


def _by_trials(model: Model, points: Points, cost_now: float) -> list[Likely]:
    """Causes without which the points fit: turned, mirrored, in another unit, scaled in x and y."""
    causes, (turned, facing) = [], _turned_to_camera(points)
    off_axis = _off_axis(points, _BEYOND_D405)
    if off_axis or facing < _FACING:
        cost = _fit(model, turned).cost
        better = cost < _FITS and (cost < _BETTER * cost_now or off_axis)
        if better or _off_axis(points, _BEYOND_CAMERAS):
            causes.append(Likely(Cause.FRAME, fit=cost if math.isfinite(cost) else None))
            points, cost_now = turned, min(cost_now, cost)
    trials = [(Likely(Cause.MIRRORED), points * [-1, 1, 1])]
    trials += [(Likely(Cause.UNIT, unit.value), points * unit.value) for unit in Unit]
    trials += [(Likely(Cause.SCALE, times), points * [times, times, 1]) for times in _XY_SCALES]
    costs = sorted(((_fit(model, undone).cost, n) for n, (_, undone) in enumerate(trials)))
    limit = min(_FITS, _BETTER * cost_now)
    return causes + [replace(trials[n][0], fit=cost) for cost, n in costs if cost < limit]


def _by_coverage(model: Model, points: Points, fit: _Fit) -> list[Likely]:
    """By what the points show of the organ, and of its surroundings."""
    organ, check, causes = fit.organ, fit.check, list[Likely]()
    if organ is None:
        (least, most), spread = model.in_distribution.spread_mm, spread_mm(points)
        if unit := likely_unit(np.array([spread]), (least, most)):
            return [Likely(Cause.UNIT, unit.value)]
        far = np.linalg.norm(points - np.median(points, 0), axis=1) > most
        large = Likely(Cause.BACKGROUND, float(far.mean()))
        small = Likely(Cause.ANOTHER_PATIENT if spread >= least else Cause.OBJECT)
        return [large if spread > most else small]
    near = _near_side(organ)
    background = float((_nearest_mm(points, organ.vertices_mm) > _BACKGROUND_MM).mean())
    hidden = float(_unseen(near, points).mean()) if len(near) else 0.0
    mostly = hidden > _MOSTLY_HIDDEN and spread_mm(points) < _SMALL_SPREAD * spread_mm(near)
    fits_without = background > _BACKGROUND_SHARE and fit.without_outliers < _FITS_WITHOUT
    if check == "outliers" or fits_without:
        causes.append(Likely(Cause.BACKGROUND, background))
    if check == "unseen" or (hidden > _HIDDEN and check not in _NOT_THIS) or mostly:
        causes.append(Likely(Cause.HIDDEN, hidden))
    if check in _NOT_THIS or fit.cost > _NEARLY:
        other = Cause.OBJECT if check == "seen_through" else Cause.DEFORMED
        causes += [Likely(Cause.ANOTHER_PATIENT), Likely(other)]
    return causes


def _turned_to_camera(points: Points) -> tuple[Points, float]:
    """The points with their bulging side turned to the camera, and the cosine between that side
    and the camera before the turn."""
    middle = np.median(points, 0)
    axes = np.linalg.eigh(np.cov(points.T))[1]  # the thinnest first
    height, u, v = ((points - points.mean(0)) @ axes).T
    paraboloid = np.stack([u**2, u * v, v**2, u, v, np.ones(len(u))], 1)
    (a, _, c, *_) = np.linalg.lstsq(paraboloid, height)[0]
    outwards = -np.sign(a * u.var() + c * v.var()) * axes[:, 0]
    turn = rotation_onto(outwards, np.array([0.0, 0.0, -1.0]))
    facing = -float(outwards @ middle / np.linalg.norm(middle))
    return (points - middle) @ turn.T + [0, 0, _TURNED_MM], facing


def _flat_or_round(points: Points) -> bool:
    spread, centred = spread_mm(points), points - points.mean(0)
    sphere = np.linalg.lstsq(np.c_[2 * centred, np.ones(len(points))], (centred**2).sum(1))[0]
    radius = math.sqrt(sphere[3] + sphere[:3] @ sphere[:3])
    residual_mm = np.abs(np.linalg.norm(centred - sphere[:3], axis=1) - radius)
    thickness = math.sqrt(max(np.linalg.eigvalsh(np.cov(points.T))[0], 0.0))
    return thickness < _FLAT * spread or float(np.percentile(residual_mm, 80)) < _ROUND * spread


def _off_axis(points: Points, cosine: float) -> bool:
    """Whether they lie farther from the camera's axis than this."""
    middle = np.median(points, 0)
    return bool(middle[2] < cosine * np.linalg.norm(middle))


def where_to_look(estimate: Estimate, views: Sequence[View], hides: bool = True) -> str:
    """The side of the organ that the camera should look at, in words. ``hides``: something may hide
    a part of it.

    If so, and if no view has points on more than a tenth of the side that faces the camera: that
    part. Otherwise from where a view would tell most of the least sure tumor. Sides are those of
    the first view's image.
    """
    organ = estimate.organ_mesh
    facing, centre = _near_side(organ), organ.vertices_mm.mean(0)
    points_mm = np.concatenate(
        [transform_points(view.camera_from_view, view.cloud.points_mm) for view in views]
    )
    camera = "the first camera's" if len(views) > 1 else "the camera's"
    if hides and len(facing) and len(points_mm):
        hidden = _unseen(facing, points_mm)
        direction = facing[hidden].mean(0) - centre if hidden.mean() > _MAX_HIDDEN else np.zeros(3)
        if side := _side_in_words(direction, centre, camera):
            return f"free the view of the organ's side towards {side}, or look from there"
    motion, report, best_mm = estimate.motion, estimate.report, np.zeros(3)  # the camera's own
    if isinstance(motion, ElasticMotion) and motion.covariance is not None and report.tumors:
        advised = Advisor(motion, least_sure(report)).views()
        best_mm = np.array(min(advised, key=lambda view: view.then_std_mm).place_mm)
    side = _side_in_words(best_mm - centre, centre, camera)
    return f"look more from {side or 'another side'}, by about 30 degrees"


def _near_side(organ: Mesh) -> Float[np.ndarray, "n 3"]:
    """Centroids of triangles that face the camera, of evenly chosen ones."""
    faces = organ.faces[:: len(organ.faces) // _MAX_SAMPLES + 1]
    centroids, normals = triangles_of(organ.vertices_mm, faces)
    sight = centroids / np.linalg.norm(centroids, axis=1, keepdims=True)
    return centroids[-(normals * sight).sum(1) > _MIN_COSINE * np.linalg.norm(normals, axis=1)]


def _unseen(surface_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Bool[np.ndarray, " n"]:
    """Which places on a surface have no observed point near them."""
    return _nearest_mm(surface_mm, points_mm) > _SEEN_WITHIN_MM


def _nearest_mm(from_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, " n"]:
    """Distance from each place to the nearest point."""
    from scipy.spatial import cKDTree  # slow to import

    return np.asarray(cKDTree(points_mm).query(from_mm)[0])


def _side_in_words(
    direction: Float[np.ndarray, " 3"], centre: Float[np.ndarray, " 3"], camera: str
) -> str:
    """A direction as the camera's image shows it; empty if it is along the view."""
    sight, length = centre / np.linalg.norm(centre), float(np.linalg.norm(direction))
    x, y, _ = direction - (direction @ sight) * sight
    if np.hypot(x, y) <= _MIN_SINE * length:
        return ""
    words = {"x": ("left", "right"), "y": ("top", "bottom")}
    larger = max(abs(x), abs(y))
    shown = {axis: value for axis, value in (("y", y), ("x", x)) if abs(value) > larger / 2}
    names = " ".join(words[axis][int(value > 0)] for axis, value in shown.items())
    axes = ", ".join(f"{'+' if value > 0 else '-'}{axis}" for axis, value in shown.items())
    return f"the {names} ({camera} {axes})"
