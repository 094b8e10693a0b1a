"""Depth images of a mesh (z-buffer), and which points of it are visible."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.camera import pinhole_of
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh
from tumortrack.native import BOOL, F32, F64, I32, I64, kernel

_TOLERANCE_MM = 0.05  # a ray to a vertex hits that vertex's triangles at about its own length

# The greatest 1/z in each pixel, from 0 (nothing is hit) on. Vertices that are no number are not
# drawn; the last but one is a work array.
_DRAWN = F32["v", 3].any_value, I32["f", 3]
_z_buffer = kernel("z_buffer", *_DRAWN, (float,) * 4, F32["v", 3].out, F32["h", "w"].out)
# Whether a triangle lies before the end of each ray, by more than the tolerance. Rays and vertices
# come with their image coordinates, the rays sorted by the first: in columns, of which there are
# their first rays, the lowest coordinate and the width.
_PLACES = F64["n", 3], F64["n", 2].any_value, F64["v", 3], F64["v", 2].any_value
_COLUMNS = I64[258], float, float
_hidden = kernel("hidden", *_PLACES, I32["f", 3], _COLUMNS, float, BOOL["n"].out)


def render_depth(
    vertices_camera_mm: Float[np.ndarray, "v 3"],
    faces: np.ndarray,
    intrinsics: Intrinsics,
    stamp_ns: int = 0,
) -> DepthFrame:
    """Depth image (mm along z, NaN where nothing is hit) of a closed mesh seen from outside, with
    faces (f, 3) turned outward. Only triangles that face the camera and lie wholly in front of it
    are drawn."""
    vertices = np.ascontiguousarray(vertices_camera_mm, np.float32)
    faces = np.ascontiguousarray(faces, np.int32)
    if len(faces) and faces.view(np.uint32).max() >= len(vertices):  # -1 is a large one
        raise ValueError(f"faces name vertices that are not among the {len(vertices)}.")
    shape = (intrinsics.height, intrinsics.width)
    nearest = np.zeros(shape, np.float32)
    _z_buffer(vertices, faces, pinhole_of(intrinsics), np.empty_like(vertices), nearest)
    depth_mm = np.full(shape, np.nan, np.float32)
    return DepthFrame(np.divide(1, nearest, depth_mm, where=nearest > 0), intrinsics, stamp_ns)


class Visibility:
    """Which points on a fixed mesh are visible from an eye, by exact ray casting.

    All rays leave one eye, so a triangle can hide only points within its bounds in the eye's image:
    these are found by bisection, and no tree is needed.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._centre = mesh.vertices_mm.mean(0)
        self._vertices = np.ascontiguousarray(mesh.vertices_mm - self._centre, np.float64)
        self._faces = np.ascontiguousarray(mesh.faces, np.int32)

    def __call__(
        self, points_mm: Float[np.ndarray, "n 3"], eye_mm: Float[np.ndarray, " 3"]
    ) -> Bool[np.ndarray, " n"]:
        """True where no part of the mesh lies between eye and point (mesh's frame)."""
        eye = np.asarray(eye_mm, np.float64) - self._centre
        axes = np.linalg.svd(eye[None])[2]  # rows: along the line of sight, and two across it
        axes = np.stack([axes[1], axes[2], -axes[0] * np.sign(axes[0] @ eye)])
        rays = (np.asarray(points_mm, np.float64) - self._centre - eye) @ axes.T
        vertices = (self._vertices - eye) @ axes.T
        order = np.argsort(_across(rays)[:, 0], kind="stable")
        uv = _across(rays)[order]
        ahead = uv[np.isfinite(uv[:, 0]), 0]  # other rays point away from the mesh
        lowest, width = (ahead[0], np.ptp(ahead) / 256 + 1e-12) if len(ahead) else (0.0, 1.0)
        starts = np.searchsorted(ahead, lowest + width * np.arange(258))  # of columns of rays
        found = np.zeros(len(rays), np.bool_)
        sides = rays[order], uv, vertices, _across(vertices), self._faces
        _hidden(*sides, (starts, lowest, width), _TOLERANCE_MM, found)
        hidden = np.empty_like(found)
        hidden[order] = found
        return ~hidden


def _across(points: np.ndarray) -> np.ndarray:
    """x / z and y / z of points (n, 3); infinite where they are not in front of the eye."""
    ahead = points[:, 2:] > 1e-6
    return np.divide(points[:, :2], points[:, 2:], np.full((len(points), 2), np.inf), where=ahead)
