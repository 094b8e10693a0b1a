"""From where to look instead, where an estimate is poor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Points, transform_points, triangles_of
from tumortrack.core.types import Look, Mesh
from tumortrack.registration.motion import ElasticMotion

_MOST = 2000  # of the organ's faces, or vertices: they tell enough
_FACING = 0.3  # cosine to the line of sight: flatter surfaces return little
_NEAR_MM = 8.0  # of an observed point: seen
_HIDDEN = 0.1  # share of what faces the camera
_ASIDE = 0.3  # sine to the line of sight: a direction that is no more aside is none


def where_to_look(estimate: Estimate, looks: Sequence[Look]) -> str:
    """Towards which side of the organ the camera should look, and why there.

    Where a tenth of what faces the camera is among no view's points: there. Where another fit is
    nearly as likely: where its surface lies farthest from this one's. Else along the axis in which
    a tumor's centre is least certain: surfaces hold what lies along their normals.
    Sides are those of the first look's picture.
    """
    organ = estimate.organ_mesh
    facing, centre = near_side(organ), organ.vertices_mm.mean(0)
    points_mm = np.concatenate(
        [transform_points(look.camera_from_look, look.cloud.points_mm) for look in looks]
    )
    camera = "the first camera's" if len(looks) > 1 else "the camera's"
    if len(facing) and len(points_mm):
        hidden = unseen(facing, points_mm)
        towards = facing[hidden].mean(0) - centre if hidden.mean() > _HIDDEN else np.zeros(3)
        if where := _side(towards, centre, camera):
            return f"free the view of the organ's side towards {where}, or look from there"
    where = _side(_unsure(estimate, centre), centre, camera)
    return f"look more from {where or 'another side'}, by about 30 degrees"


def near_side(organ: Mesh) -> Float[np.ndarray, "n 3"]:
    """Places on the side of its surface that faces the camera, evenly over its triangles."""
    faces = organ.faces[:: len(organ.faces) // _MOST + 1]
    middles, normals = triangles_of(organ.vertices_mm, faces)
    sight = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    return middles[-(normals * sight).sum(1) > _FACING * np.linalg.norm(normals, axis=1)]


def unseen(places_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Bool[np.ndarray, " n"]:
    """Which of the places no point is near."""
    return _nearest_mm(places_mm, points_mm) > _NEAR_MM


def _nearest_mm(places_mm: Points, points_mm: Float[np.ndarray, "_ 3"]) -> Float[np.ndarray, " n"]:
    """How far each place is from the nearest point."""
    from scipy.spatial import cKDTree  # slow to import

    return np.asarray(cKDTree(points_mm).query(places_mm)[0])


def _unsure(estimate: Estimate, centre: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The direction, camera frame, from which more would be known."""
    motion = estimate.motion
    if isinstance(motion, ElasticMotion) and motion.rivals:
        places_mm = estimate.organ_mesh.vertices_mm
        places_mm = places_mm[:: len(places_mm) // _MOST + 1]
        other_mm = motion.rivals[0][0].carry(motion.shape.anatomy_ct.organ.vertices_mm)
        return places_mm[_nearest_mm(places_mm, other_mm).argmax()] - centre
    known = [
        (part.center_axes_std_mm[0], name, part.center_axes[0])
        for name, part in estimate.report.tumors.items()
        if part.center_axes_std_mm and part.center_axes
    ]
    if not known:
        return np.zeros(3)
    _, name, least_sure = max(known)
    axis = np.array(least_sure)
    return axis if (estimate.meshes[name].box_mm.mean(0) - centre) @ axis >= 0 else -axis


def _side(direction: Float[np.ndarray, " 3"], centre: Float[np.ndarray, " 3"], camera: str) -> str:
    """A direction in words, as the camera's picture shows it; empty: it lies along the view."""
    sight, length = centre / np.linalg.norm(centre), float(np.linalg.norm(direction))
    x, y, _ = direction - (direction @ sight) * sight
    if np.hypot(x, y) <= _ASIDE * length:
        return ""
    words = {"x": ("left", "right"), "y": ("top", "bottom")}
    long = max(abs(x), abs(y))
    told = {axis: value for axis, value in (("y", y), ("x", x)) if abs(value) > long / 2}
    names = " ".join(words[axis][int(value > 0)] for axis, value in told.items())
    axes = ", ".join(f"{'+' if value > 0 else '-'}{axis}" for axis, value in told.items())
    return f"the {names} ({camera} {axes})"
