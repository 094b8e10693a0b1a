"""Transforms, directions and triangles. A transform from frame a to frame b is ``b_from_a``."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64, Int

from tumortrack.core.errors import InputError

Direction = tuple[float, float, float]
Points = Float[np.ndarray, "n 3"]
Affine = Float[np.ndarray, "4 4"]
Matrix = Float[np.ndarray, "3 3"]
Vector = Float[np.ndarray, " 3"]
Faces = Int[np.ndarray, "f 3"]

# Patient frame, DICOM: +x Left, +y Posterior, +z Superior (LPS).
DIRECTIONS_LPS: dict[str, Direction] = {
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
    "posterior": (0.0, 1.0, 0.0),
    "anterior": (0.0, -1.0, 0.0),
    "superior": (0.0, 0.0, 1.0),
    "inferior": (0.0, 0.0, -1.0),
}

IDENTITY = np.eye(4)  # both frames are the same
IDENTITY.flags.writeable = False
_NOT_RIGID = 1e-3  # deviation of a rotation from orthonormal: files have few digits
_FARTHEST_MM = 5000.0  # beyond any arm, tracker or camera of one room

# NIfTI is RAS+, DICOM is LPS: the first two axes change sign, and nothing else.
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def transform_points(b_from_a: Affine, points_a: Points) -> Points:
    linear, shift = b_from_a[:3, :3].T, b_from_a[:3, 3]
    return points_a @ linear.astype(points_a.dtype) + shift.astype(points_a.dtype)


def rigid(rotation: Matrix, translation_mm: Vector) -> Affine:
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = rotation
    b_from_a[:3, 3] = translation_mm
    return b_from_a


def read_rigid(rows: Sequence[Sequence[float]], unit: Literal["mm", "m"], where: str) -> Affine:
    """A transform in mm from a file's 4 x 4 rows. InputError names ``where``: it is not rigid."""
    b_from_a = np.array(rows, float) if {len(row) for row in rows} == {4} else np.zeros((0, 4))
    if len(b_from_a) != 4:
        raise InputError(f"{where} has {len(rows)} rows; it must have 4 of 4 numbers.")
    rotation, mm_per_unit = b_from_a[:3, :3], 1000.0 if unit == "m" else 1.0
    is_rigid = (
        np.isfinite(b_from_a).all()
        and np.abs(rotation).max() < 2
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < _NOT_RIGID
        and np.linalg.det(rotation) > 0
        and np.array_equal(b_from_a[3], [0, 0, 0, 1])
    )
    if not is_rigid:
        raise InputError(
            f"{where} is no rigid transform: its rotation must be orthonormal and right-handed, "
            "its last row 0 0 0 1."
        )
    b_from_a[:3, 3] *= mm_per_unit
    if not (far_mm := np.abs(b_from_a[:3, 3]).max()) <= _FARTHEST_MM:
        raise InputError(
            f"{where} shifts by {far_mm / 1000:.4g} m, with the unit {unit!r}; allowed: up to "
            f"{_FARTHEST_MM / 1000:g} m. Is it in {'mm' if unit == 'm' else 'another unit'}?"
        )
    return b_from_a


def rotation_onto(source: Vector, target: Vector) -> Matrix:
    """The smallest rotation that turns the direction ``source`` onto ``target``."""
    a, b = unit(np.asarray(source, float)), unit(np.asarray(target, float))
    middle = a + b
    if np.linalg.norm(middle) < 1e-8:  # opposite: half a turn about any perpendicular axis
        middle = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    middle /= np.linalg.norm(middle)
    # Two reflections, a -> -a -> b: exact to the last digit, also for nearly opposite directions.
    return (np.eye(3) - 2 * np.outer(middle, middle)) @ (np.eye(3) - 2 * np.outer(a, a))


def turned_by(vector_rad: Vector) -> Matrix:
    """The rotation about a vector by its length in radians (Rodrigues). A verdict would wait a
    tenth of a second for the import of SciPy's Rotation."""
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector_rad / angle
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def direction_lps(text: str) -> Direction:
    """A unit vector in LPS from a name (``anterior``) or three numbers (``0,-1,0``). Raises
    InputError: not a known name or a finite 3-vector other than 0."""
    if text.lower() in DIRECTIONS_LPS:
        return DIRECTIONS_LPS[text.lower()]
    try:
        vector = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        vector = np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not np.isfinite(length) or length == 0:
        raise InputError(
            f"direction {text!r} is not understood. Allowed: {', '.join(DIRECTIONS_LPS)}, or "
            "three numbers in LPS such as 0,-1,0."
        )
    x, y, z = (vector / length).tolist()
    return (x, y, z)


def spacing_mm(frame_from_index: Affine) -> Vector:
    """Voxel edge lengths in mm along the three array axes."""
    return np.linalg.norm(frame_from_index[:3, :3], axis=0)


def unit(vector: Vector) -> Vector:
    return vector / np.linalg.norm(vector)


def perpendicular(vector: Vector) -> Vector:
    """Some unit vector perpendicular to a vector."""
    return unit(np.cross(vector, np.eye(3)[np.argmin(np.abs(vector))]))


def triangles_of(
    vertices_mm: Points, faces: Faces
) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f 3"]]:
    """Each triangle's centroid (mm) and outward normal, whose length is twice the area (mm2)."""
    corners = vertices_mm[faces]
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(1), doubled


def spread_over(
    vertices: Float64[np.ndarray, "v k"], faces: Faces, longest_mm: float
) -> Float64[np.ndarray, "n k"]:
    """The vertices (x, y, z in mm first; further columns are interpolated), and those of a finer
    mesh without edges longer than ``longest_mm``."""
    corners = vertices[faces, :3]
    edges_mm = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    coarse = faces[(edges_mm > longest_mm).any(1)]
    if not len(coarse):
        return vertices
    from trimesh.remesh import subdivide_to_size  # slow to import

    return subdivide_to_size(vertices, coarse, longest_mm)[0]


def plane_section(
    vertices: Points, faces: Faces, normal: Vector, through: Vector
) -> Float[np.ndarray, "m 2 3"]:
    """The segments where triangles cross the plane through a point."""
    height = (vertices - through) @ normal
    above = height[faces] > 0
    faces = faces[above.any(axis=1) & ~above.all(axis=1)]
    start, end = vertices[faces], vertices[np.roll(faces, -1, axis=1)]
    start_height, end_height = height[faces], height[np.roll(faces, -1, axis=1)]
    crosses = (start_height > 0) != (end_height > 0)  # two edges of each triangle
    share = start_height[crosses] / (start_height - end_height)[crosses]
    return (start[crosses] + share[:, None] * (end - start)[crosses]).reshape(-1, 2, 3)


def swept_places(ends_mm: Float[np.ndarray, "n 2 3"], step_mm: float) -> Float[np.ndarray, "m 3"]:
    """Places, at most ``step_mm`` apart, on what a straight line sweeps whose two ends go from each
    pose to the next one; of a single pose, on the line."""
    length_mm = np.linalg.norm(ends_mm[:, 1] - ends_mm[:, 0], axis=1).max()
    along = np.linspace(0, 1, int(np.ceil(length_mm / step_mm)) + 1)[:, None]
    lines = ends_mm[:, :1] + along * (ends_mm[:, 1:] - ends_mm[:, :1])  # (n, k, 3)
    swept = [lines[:1]]
    for before, after in pairwise(lines):
        steps = int(np.ceil(np.linalg.norm(after - before, axis=1).max() / step_mm))
        shares = np.arange(1, steps + 1)[:, None, None] / max(steps, 1)
        swept.append(before + shares * (after - before))
    return np.concatenate(swept).reshape(-1, 3)


def std_of(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """One standard deviation: the root mean square of the three axes."""
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)


def largest_std_of(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """One standard deviation along the direction where it is largest."""
    return np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
