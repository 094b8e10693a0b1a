"""Shaded orthographic pictures of meshes: a z-buffer, smooth normals and a headlight.

matplotlib's own 3-D surfaces sort triangles by their middle, which shows tumors in front of the
organ that hides them; here every pixel knows its depth, and lengths stay true.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import cover

_LIGHT = np.array([-0.35, -0.55, -1.0]) / np.linalg.norm([-0.35, -0.55, -1.0])
_SAME_MM = 0.6  # a translucent surface that close over an opaque one is the same one
_SHARPER = 2  # pixels drawn per pixel shown, each way: smooth edges


@dataclass(frozen=True)
class ShadedView:
    """A parallel projection: unit vectors of the picture's right and down in the data's frame."""

    name: str
    right: tuple[float, float, float]
    down: tuple[float, float, float]

    def project(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """(right, down, depth away from the viewer) of each point, mm."""
        right, down = np.array(self.right), np.array(self.down)
        return points_mm @ np.stack([right, down, np.cross(right, down)], axis=1)


@dataclass(frozen=True)
class Frame:
    """What part of a view is shown: left, right, top, bottom in mm along right and down."""

    left: float
    right: float
    top: float
    bottom: float

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """As matplotlib's imshow wants it, down pointing down."""
        return (self.left, self.right, self.bottom, self.top)


@dataclass(frozen=True)
class ShadedLayer:
    """One mesh with its colour (0..1) and opacity where seen face on; edges are always denser."""

    mesh: Mesh
    color: tuple[float, float, float]
    opacity: float = 1.0


def frame_around(
    view: ShadedView, points_mm: Float[np.ndarray, "n 3"], margin_mm: float = 5.0
) -> Frame:
    """The frame that shows all these points."""
    flat = view.project(points_mm)
    low, high = flat.min(0) - margin_mm, flat.max(0) + margin_mm
    return Frame(float(low[0]), float(high[0]), float(low[1]), float(high[1]))


def widened(frame: Frame, aspect: float) -> Frame:
    """The smallest frame about the same middle with width = aspect * height that holds it."""
    width, height = frame.right - frame.left, frame.bottom - frame.top
    half_height = max(height, width / aspect) / 2
    x, y = (frame.left + frame.right) / 2, (frame.top + frame.bottom) / 2
    return Frame(
        x - aspect * half_height, x + aspect * half_height, y - half_height, y + half_height
    )


def shade(
    layers: list[ShadedLayer], view: ShadedView, frame: Frame, pixel_mm: float = 0.3
) -> Float[np.ndarray, "h w 3"]:
    """Paint the layers in this order, each over the ones before it (organ last).

    Opaque layers hide each other by depth; translucent ones tint what lies behind them.

    Returns:
        RGB in 0..1 on white (h, w, 3), row 0 at the frame's top, for
        ``imshow(..., extent=frame.extent)``.
    """
    height, width = (_SHARPER * n for n in _pixels(frame, pixel_mm))
    color = np.ones((height, width, 3))
    nearest = np.full((height, width), np.inf)
    for layer in layers:
        depth, normal = _trace(layer.mesh, view, frame, (height, width), pixel_mm / _SHARPER)
        seen = depth < nearest if layer.opacity >= 1 else depth < nearest - _SAME_MM
        if layer.opacity >= 1:
            nearest[seen] = depth[seen]
        slant = 1 - np.abs(normal[seen, 2])
        strength = layer.opacity + (1 - layer.opacity) * 0.75 * slant**2
        lit = _lit(np.array(layer.color), normal[seen])
        color[seen] += strength[:, None] * (lit - color[seen])
    return color.reshape(height // _SHARPER, _SHARPER, width // _SHARPER, _SHARPER, 3).mean((1, 3))


def pixel_centres(frame: Frame, pixel_mm: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """Positions along right (w,) and down (h,) of the pixels of a picture of this frame, mm."""
    height, width = _pixels(frame, pixel_mm)
    return (
        frame.left + (np.arange(width) + 0.5) * pixel_mm,
        frame.top + (np.arange(height) + 0.5) * pixel_mm,
    )


def _pixels(frame: Frame, pixel_mm: float) -> tuple[int, int]:
    height = int(np.ceil((frame.bottom - frame.top) / pixel_mm))
    width = int(np.ceil((frame.right - frame.left) / pixel_mm))
    return max(height, 1), max(width, 1)


def silhouette(mesh: Mesh, view: ShadedView, frame: Frame, pixel_mm: float = 0.25) -> np.ndarray:
    """Where the mesh covers the picture: 1.0 or 0.0 per pixel (h, w), for a contour at 0.5."""
    return np.isfinite(depth_of(mesh, view, frame, pixel_mm)).astype(float)


def depth_of(
    mesh: Mesh, view: ShadedView, frame: Frame, pixel_mm: float = 0.25
) -> Float[np.ndarray, "h w"]:
    """Of the surface that is seen, mm away from the viewer as ``ShadedView.project`` has it; where
    nothing is seen, infinite."""
    return _trace(mesh, view, frame, _pixels(frame, pixel_mm), pixel_mm)[0]


def _trace(
    mesh: Mesh, view: ShadedView, frame: Frame, shape: tuple[int, int], pixel_mm: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Depth (inf: nothing) and unit normal, turned to the viewer, of the nearest surface."""
    flat = view.project(mesh.vertices_mm)
    column = (flat[:, 0] - frame.left) / pixel_mm - 0.5
    row = (flat[:, 1] - frame.top) / pixel_mm - 0.5
    triangles = np.stack([row, column, flat[:, 2]], axis=1)[mesh.faces]
    depth = np.full(shape[0] * shape[1], np.inf)
    winner = np.full(shape[0] * shape[1], -1)
    for tri, i, j, z in cover(triangles, shape):
        pixel = i * shape[1] + j
        np.minimum.at(depth, pixel, z)
        first = z <= depth[pixel]
        winner[pixel[first]] = tri[first]
    hit = np.flatnonzero(winner >= 0)
    corners = triangles[winner[hit]]
    spot = np.stack([hit // shape[1], hit % shape[1]], axis=1)
    share = _barycentric(corners[:, :, :2], spot.astype(float))
    corner_normals = vertex_normals(flat, mesh.faces)[mesh.faces[winner[hit]]]
    normal = np.einsum("nc,ncd->nd", share, corner_normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal *= np.where(normal[:, 2:] > 0, -1, 1)
    normals = np.zeros((shape[0] * shape[1], 3))
    normals[hit] = normal
    return depth.reshape(shape), normals.reshape(*shape, 3)


def _barycentric(
    corners: Float[np.ndarray, "n 3 2"], points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    a, b, c = (corners[:, k] for k in range(3))
    to_b, to_c, to_p = b - a, c - a, points - a
    whole = to_b[:, 0] * to_c[:, 1] - to_b[:, 1] * to_c[:, 0]
    whole = np.where(whole == 0, 1, whole)
    v = (to_p[:, 0] * to_c[:, 1] - to_p[:, 1] * to_c[:, 0]) / whole
    w = (to_b[:, 0] * to_p[:, 1] - to_b[:, 1] * to_p[:, 0]) / whole
    return np.clip(np.stack([1 - v - w, v, w], axis=1), 0, 1)


def vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray
) -> Float[np.ndarray, "v 3"]:
    """Unit normals (outward where faces turn outward), each the mean of its triangles' by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _lit(
    color: Float[np.ndarray, " 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Diffuse and a little gloss from a light above the viewer's left shoulder."""
    diffuse = np.clip(normals @ _LIGHT, 0, 1)[:, None]
    halfway = _LIGHT + np.array([0, 0, -1.0])
    halfway /= np.linalg.norm(halfway)
    gloss = np.clip(normals @ halfway, 0, 1)[:, None] ** 40
    return np.clip(color * (0.38 + 0.66 * diffuse) + 0.22 * gloss, 0, 1)
