"""Advice: what to learn next, and for a poor estimate from where the camera should look."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from tumortrack.assessment.bound import bound_mm, shipped
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Points, transform_points, triangles_of
from tumortrack.core.report import FitReport, NextEvidence
from tumortrack.core.types import Look, Mesh
from tumortrack.registration.advice import Advisor, Reach, part_number
from tumortrack.registration.motion import ElasticMotion

TOUCH_MORE = "touch more places, all over what can be reached of it"
_MAX_SAMPLES = 2000  # faces or vertices of the organ that are looked at
_MIN_COSINE = 0.3  # to the line of sight: surfaces at a flatter angle return little
_SEEN_WITHIN_MM = 8.0  # of an observed point
_MAX_HIDDEN = 0.1  # share of the side that faces the camera
_LEAST_GAIN_MM, _FOUND = 1 / 3, (0.7, 1.3)  # found over foreseen
_MIN_SINE = 0.3  # to the line of sight: below it, a direction is along the view


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
    return with_bounds(estimate.report, advice, estimate.assessment.factor)


def worthwhile(advice: Sequence[NextEvidence]) -> tuple[NextEvidence, ...]:
    """The advice that pays: what lowers a bound by over a third of a millimetre, of kinds whose
    foreseen gains were found in scenes left out."""
    kinds = shipped().advice
    return tuple(
        each
        for each in advice
        if _FOUND[0] <= kinds.get(each.kind, 0.0) <= _FOUND[1]
        and each.bound_mm is not None
        and each.then_bound_mm is not None
        and each.bound_mm - each.then_bound_mm > _LEAST_GAIN_MM
    )


def with_bounds(
    report: FitReport, advice: Sequence[NextEvidence], factor: float
) -> tuple[NextEvidence, ...]:
    """The advice on a part with the bound that each piece would lower, after those before it, as
    far as that is known. ``factor``: of the bounds."""
    now_mm = max((each.std_mm for each in advice), default=0.0)

    def most_mm(part: str, std_mm: float) -> float | None:
        most_mm = bound_mm(report, part, std_mm / now_mm)
        return most_mm and factor * most_mm

    return tuple(
        msgspec.structs.replace(
            each,
            bound_mm=most_mm(each.part, each.std_mm),
            then_bound_mm=most_mm(each.part, each.then_std_mm),
        )
        for each in advice
    )


def where_to_look(estimate: Estimate, looks: Sequence[Look], hides: bool = True) -> str:
    """The side of the organ that the camera should look at, in words. ``hides``: something may hide
    a part of it.

    If so, and if no view has points on more than a tenth of the side that faces the camera: that
    part. Otherwise from where a look would tell most of the least sure tumor. Sides are those of
    the first look's image.
    """
    organ = estimate.organ_mesh
    facing, centre = near_side(organ), organ.vertices_mm.mean(0)
    points_mm = np.concatenate(
        [transform_points(look.camera_from_look, look.cloud.points_mm) for look in looks]
    )
    camera = "the first camera's" if len(looks) > 1 else "the camera's"
    if hides and len(facing) and len(points_mm):
        hidden = unseen(facing, points_mm)
        direction = facing[hidden].mean(0) - centre if hidden.mean() > _MAX_HIDDEN else np.zeros(3)
        if side := _side_in_words(direction, centre, camera):
            return f"free the view of the organ's side towards {side}, or look from there"
    side = _side_in_words(_best_place(estimate) - centre, centre, camera)
    return f"look more from {side or 'another side'}, by about 30 degrees"


def near_side(organ: Mesh) -> Float[np.ndarray, "n 3"]:
    """Centroids of triangles that face the camera, of evenly chosen ones."""
    faces = organ.faces[:: len(organ.faces) // _MAX_SAMPLES + 1]
    centroids, normals = triangles_of(organ.vertices_mm, faces)
    sight = centroids / np.linalg.norm(centroids, axis=1, keepdims=True)
    return centroids[-(normals * sight).sum(1) > _MIN_COSINE * np.linalg.norm(normals, axis=1)]


def unseen(surface_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Bool[np.ndarray, " n"]:
    """Which places on a surface have no observed point near them."""
    return _nearest_mm(surface_mm, points_mm) > _SEEN_WITHIN_MM


def _nearest_mm(from_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, " n"]:
    """Distance from each place to the nearest point."""
    from scipy.spatial import cKDTree  # slow to import

    return np.asarray(cKDTree(points_mm).query(from_mm)[0])


def _best_place(estimate: Estimate) -> Float[np.ndarray, " 3"]:
    """For one more camera; the camera's own if nothing is known."""
    motion, tumors = estimate.motion, estimate.report.tumors
    if not isinstance(motion, ElasticMotion) or motion.covariance is None or not tumors:
        return np.zeros(3)
    unsure = [part.center_std_mm or 0.0 for part in tumors.values()]
    looks = Advisor(motion, 1 + int(np.argmax(unsure))).looks()
    return np.array(min(looks, key=lambda look: look.then_std_mm).place_mm)


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
