"""Does an organ look the same after half a turn, or any? Then a view may not tell them apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import Points, rigid, transform_points, triangles_of
from tumortrack.core.types import Anatomy

# Mean distance below which a view may not tell. Of organs between an ellipsoid and a phantom, 40
# clouds each, the half-turned organ was nearly as likely (a hundredth at least) for 95 % at 0.15
# mm, 60 % at 0.7, 25 % at 0.9, 10 % at 1.2 mm. 74 real kidneys, as segmented, have 1.9 to 6 mm, the
# built-in phantom 2.1.
ALIKE_MM = 1.5
_SPACING_MM = 2.0  # of the surface's points, about
_MOVED = 3000  # points that are laid on it; other ones change the mean by 0.03 mm
_STILL_RAD = 0.5
_STEPS, _ENOUGH_MM = 30, 0.01  # at most; one that moves less is the last


@dataclass(frozen=True, eq=False)
class HalfTurn:
    """The organ, turned by 180 degrees about a principal axis, then laid on itself by
    ``ct_from_ct`` (LPS, mm). ``mean_mm``, ``p90_mm``: distances of the turned surface to the
    organ's, mean and what nine tenths do not exceed. ``tumors_mm``: how far the middles move.
    ``any_turn``: a quarter about this axis is as good, so that any angle is: a body of revolution.
    """

    ct_from_ct: Float64[np.ndarray, "4 4"]
    mean_mm: float
    p90_mm: float
    tumors_mm: dict[str, float]
    any_turn: bool = False


def half_turns(anatomy: Anatomy) -> list[HalfTurn]:
    """About each principal axis of the organ's surface, the best match first; a second at most."""
    points, normals = triangles_of(anatomy.organ.vertices_mm, anatomy.organ.faces)
    area = np.linalg.norm(normals, axis=1) / 2
    count = max(_MOVED, round(area.sum() / _SPACING_MM**2))
    drawn = np.random.default_rng(0).choice(len(points), count, p=area / area.sum())
    normals = normals[drawn] / (2 * area[drawn])[:, None]
    points, tree = points[drawn], cKDTree(points[drawn])
    middle, found = points.mean(0), list[HalfTurn]()
    tumors = np.array([tumor.box_mm.mean(0) for tumor in anatomy.tumors]).reshape(-1, 3)
    for axis in np.linalg.svd(points - middle, full_matrices=False)[2]:
        way, away_mm = _symmetric_pose(points, normals, tree, np.pi * axis)
        moved_mm = np.linalg.norm(transform_points(way, tumors) - tumors, axis=1).tolist()
        mean_mm, p90_mm = float(away_mm.mean()), float(np.quantile(away_mm, 0.9))
        quarter = False
        if mean_mm < ALIKE_MM:
            turned, left_mm = _symmetric_pose(points, normals, tree, np.pi / 2 * axis)
            # A quarter turn that was undone by laying it on the surface tells nothing.
            angle = Rotation.from_matrix(turned[:3, :3]).magnitude()
            quarter = abs(angle - np.pi / 2) < _STILL_RAD and left_mm.mean() < ALIKE_MM
        tumors_mm = dict(zip(anatomy.names[1:], moved_mm, strict=True))
        found.append(HalfTurn(way, mean_mm, p90_mm, tumors_mm, bool(quarter)))
    return sorted(found, key=lambda one: one.mean_mm)


def _symmetric_pose(
    points: Points, normals: Points, tree: cKDTree, turn_rad: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, " m"]]:
    """Some of a surface's points, turned about their middle by a rotation vector, then fitted to
    the surface: the motion, and how far off (mm) they are left."""
    middle = points.mean(0)
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    way = rigid(turn, middle - turn @ middle)
    there = transform_points(way, points[:_MOVED])
    for _ in range(_STEPS):  # iterated closest points, to the planes at the nearest ones
        away, near = tree.query(there)
        off = ((points[near] - there) * normals[near]).sum(1)
        rows = np.hstack([np.cross(there - middle, normals[near]), normals[near]])
        step = np.linalg.lstsq(rows, off, rcond=1e-3)[0]  # turns that stay free are left out
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        way = rigid(turn, middle - turn @ middle + step[3:]) @ way
        before, there = there, transform_points(way, points[:_MOVED])
        if np.abs(there - before).max() < _ENOUGH_MM:
            break
    return way, np.where(away < 2 * _SPACING_MM, np.abs(off), away)


def alike(turns: list[HalfTurn]) -> list[HalfTurn]:
    """Those after which a view may not tell that the organ was turned."""
    return [one for one in turns if one.mean_mm < ALIKE_MM]


def warning(turns: list[HalfTurn]) -> str:
    """What ``alike`` found, for people; empty: nothing."""
    if not turns:
        return ""
    worst = max(turns, key=lambda one: max(one.tumors_mm.values(), default=0.0))
    tumors = " and ".join(f"{name} {mm:.0f} mm" for name, mm in worst.tumors_mm.items())
    turn = "any turn about an axis" if any(one.any_turn for one in turns) else "half a turn"
    return (
        f"the organ looks much the same after {turn} (surfaces {worst.mean_mm:.1f} mm apart "
        f"in the mean, {worst.p90_mm:.1f} mm at 90 %), which would put {tumors or 'inner points'} "
        "elsewhere: estimates are poor wherever the view does not tell the two apart"
    )
