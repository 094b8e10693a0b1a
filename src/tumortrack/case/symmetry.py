"""Test whether an organ looks the same after half a turn, so that a view is ambiguous."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import Points, rigid, transform_points, triangles_of
from tumortrack.core.types import Anatomy

# Mean distance below which a view may be ambiguous: at 1.2 mm for a tenth of the clouds. Real
# kidneys have 1.9 to 6 mm, the built-in phantom 2.1.
AMBIGUOUS_MM = 1.5
_SPACING_MM = 2.0  # approximate distance between points on the surface
_FITTED = 3000  # points; another sample changes the mean by 0.03 mm
_KEPT_RAD = 0.5  # a fit that changes a quarter turn by more has turned it back
_STEPS, _ENOUGH_MM = 30, 0.01  # most iterations; a smaller motion ends them


@dataclass(frozen=True, eq=False)
class HalfTurn:
    """The organ turned by 180 degrees about a principal axis and fitted to itself by ``ct_from_ct``
    (LPS, mm). ``mean_mm``, ``p90_mm``: mean and 90th percentile of the distances between the
    surfaces. ``tumors_mm``: how far the tumors' centres move. ``any_turn``: a quarter turn fits as
    well, so that any angle does, as for a body of revolution."""

    ct_from_ct: Float64[np.ndarray, "4 4"]
    mean_mm: float
    p90_mm: float
    tumors_mm: dict[str, float]
    any_turn: bool = False


def half_turns(anatomy: Anatomy) -> list[HalfTurn]:
    """Half turns about the principal axes of the organ's surface, best match first; within 1 s."""
    points, normals = triangles_of(anatomy.organ.vertices_mm, anatomy.organ.faces)
    area = np.linalg.norm(normals, axis=1) / 2
    count = max(_FITTED, round(area.sum() / _SPACING_MM**2))
    drawn = np.random.default_rng(0).choice(len(points), count, p=area / area.sum())
    normals = normals[drawn] / (2 * area[drawn])[:, None]
    points, tree = points[drawn], cKDTree(points[drawn])
    center, turns = points.mean(0), list[HalfTurn]()
    tumors = np.array([tumor.box_mm.mean(0) for tumor in anatomy.tumors]).reshape(-1, 3)
    for axis in np.linalg.svd(points - center, full_matrices=False)[2]:
        pose, distances_mm = _symmetric_pose(points, normals, tree, np.pi * axis)
        moved_mm = np.linalg.norm(transform_points(pose, tumors) - tumors, axis=1).tolist()
        mean_mm, p90_mm = float(distances_mm.mean()), float(np.quantile(distances_mm, 0.9))
        any_turn = False
        if mean_mm < AMBIGUOUS_MM:
            quarter, distances_mm = _symmetric_pose(points, normals, tree, np.pi / 2 * axis)
            # A match means nothing if the fit has turned it back.
            angle = Rotation.from_matrix(quarter[:3, :3]).magnitude()
            kept = abs(angle - np.pi / 2) < _KEPT_RAD
            any_turn = bool(kept and distances_mm.mean() < AMBIGUOUS_MM)
        tumors_mm = dict(zip(anatomy.names[1:], moved_mm, strict=True))
        turns.append(HalfTurn(pose, mean_mm, p90_mm, tumors_mm, any_turn))
    return sorted(turns, key=lambda turn: turn.mean_mm)


def _symmetric_pose(
    points: Points, normals: Points, tree: cKDTree, turn_rad: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, " m"]]:
    """Turn a surface's points about their mean by a rotation vector and fit them to the surface by
    point-to-plane ICP. Returns the motion, and the remaining distances (mm)."""
    center = points.mean(0)
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    pose = rigid(rotation, center - rotation @ center)
    moved = transform_points(pose, points[:_FITTED])
    for _ in range(_STEPS):
        distance, nearest = tree.query(moved)
        to_plane = ((points[nearest] - moved) * normals[nearest]).sum(1)
        rows = np.hstack([np.cross(moved - center, normals[nearest]), normals[nearest]])
        step = np.linalg.lstsq(rows, to_plane, rcond=1e-3)[0]  # drops undetermined rotations
        rotation = Rotation.from_rotvec(step[:3]).as_matrix()
        pose = rigid(rotation, center - rotation @ center + step[3:]) @ pose
        before, moved = moved, transform_points(pose, points[:_FITTED])
        if np.abs(moved - before).max() < _ENOUGH_MM:
            break
    return pose, np.where(distance < 2 * _SPACING_MM, np.abs(to_plane), distance)


def ambiguous(turns: list[HalfTurn]) -> list[HalfTurn]:
    """The turns after which a view may look the same."""
    return [turn for turn in turns if turn.mean_mm < AMBIGUOUS_MM]


def warning(turns: list[HalfTurn]) -> str:
    """A sentence on ``ambiguous`` turns; empty without any."""
    if not turns:
        return ""
    worst = max(turns, key=lambda turn: max(turn.tumors_mm.values(), default=0.0))
    tumors = " and ".join(f"{name} {mm:.0f} mm" for name, mm in worst.tumors_mm.items())
    turn = "any turn about an axis" if any(turn.any_turn for turn in turns) else "half a turn"
    return (
        f"the organ looks much the same after {turn} (surfaces {worst.mean_mm:.1f} mm apart "
        f"in the mean, {worst.p90_mm:.1f} mm at 90 %), which would put {tumors or 'inner points'} "
        "elsewhere: estimates are poor wherever the view does not tell the two apart"
    )
