"""Where an electrode goes and how far that is from surfaces: slow, plain, and not the planner's."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.types import Mesh
from tumortrack_resection.values import Cut

Ends = Float64[np.ndarray, "m 2 3"]  # tip and rear end of an electrode's axis
_AT_ONCE = 400_000  # pairs of points and axes


def swept(cut: Cut, electrode_mm: float = 70.0, step_mm: float = 0.4) -> Ends:
    """Along a cut, and between its points."""
    assert cut.axis is not None
    path = cut.path_mm
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    at = np.unique(np.append(way, np.arange(0.0, way[-1], step_mm)))
    tips = np.column_stack([np.interp(at, way, axis) for axis in path.T])
    return np.stack([tips, tips - electrode_mm * cut.axis], axis=1)


def on_axes(ends_mm: Ends, step_mm: float = 1.0) -> Float64[np.ndarray, "m k 3"]:
    """Points along each axis, tips first."""
    length = float(np.linalg.norm(ends_mm[0, 0] - ends_mm[0, 1]))
    shares = np.linspace(0, 1, int(np.ceil(length / step_mm)) + 1)[:, None]
    return ends_mm[:, :1] + shares * (ends_mm[:, 1:] - ends_mm[:, :1])


def to_axes(points_mm: Float64[np.ndarray, "n 3"], ends_mm: Ends) -> Float64[np.ndarray, " n"]:
    """Of each point, the distance to the nearest axis, to 1e-5 mm."""
    middle = ends_mm[0, 0]  # near to all of them, so that squares are small
    tips, along = ends_mm[:, 0] - middle, ends_mm[:, 1] - ends_mm[:, 0]
    squares, offsets = (along**2).sum(1), (tips * along).sum(1)
    nearest = np.empty(len(points_mm))
    count = max(1, _AT_ONCE // len(ends_mm))
    for first in range(0, len(points_mm), count):
        points = points_mm[first : first + count] - middle
        ahead = points @ along.T - offsets
        share = np.clip(ahead / squares, 0, 1)
        to_tips = (points**2).sum(1)[:, None] - 2 * points @ tips.T + (tips**2).sum(1)
        gaps = to_tips - 2 * share * ahead + share**2 * squares
        nearest[first : first + count] = np.sqrt(np.maximum(gaps.min(1), 0))
    return nearest


def beyond(planes: Float64[np.ndarray, "k 4"], points_mm: np.ndarray) -> np.ndarray:
    """How far each point is outside of each plane, mm (..., k)."""
    return points_mm @ planes[:, :3].T - planes[:, 3]


def in_plane(
    plane: Float64[np.ndarray, " 4"], mesh: Mesh, step_mm: float = 0.8
) -> Float64[np.ndarray, "n 3"]:
    """A lattice in a plane, all over a surface's box."""
    normal = plane[:3]
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    middle = mesh.box_mm.mean(0)
    middle = middle - (normal @ middle - plane[3]) * normal
    far = float(np.linalg.norm(np.ptp(mesh.box_mm, axis=0))) / 2 + 1
    ticks = np.arange(-far, far, step_mm)
    a, b = np.meshgrid(ticks, ticks)
    return middle + a.reshape(-1, 1) * u + b.reshape(-1, 1) * np.cross(normal, u)


def in_box(mesh: Mesh, points_mm: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    return ((points_mm >= mesh.box_mm[0]) & (points_mm <= mesh.box_mm[1])).all(1)
