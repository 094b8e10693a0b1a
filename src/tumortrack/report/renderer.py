"""Shaded pictures of meshes without a display: stills in mm, and the frames of a film.

A z-buffer in perspective or parallel projection, normals that are smooth except at creases, one
light, and translucent bodies over opaque ones. (matplotlib's 3-D surfaces sort triangles by
centroid, which shows tumors in front of the organ that hides them.)
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8
from PIL import Image

from tumortrack.core.colours import Colour
from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.core.types import Mesh
from tumortrack.native import F32, I32, kernel

_OVERSAMPLING = 2  # pixels drawn per pixel shown, along each axis: antialiasing
_CREASE_RAD = np.radians(40.0)  # faces that meet at a sharper angle keep their edge
_WORLD_LIGHT = np.array([-0.42, -0.5, 1.0])  # towards it: from the left, the front and above
_VIEW_LIGHT = np.array([-0.35, -0.55, -1.0])  # right, down, away: over the viewer's left shoulder
_SAME_MM = 0.6  # a translucent surface this close to an opaque one counts as the same
_FAR_MM = 10_000.0  # the viewer of a parallel view

RGB = tuple[float, float, float]  # each in 0..1
WHITE: RGB = (1.0, 1.0, 1.0)


def rgb(colour: Colour) -> RGB:
    """The same in 0..1."""
    red, green, blue = (value / 255 for value in colour)
    return red, green, blue


_SEEN = F32["t", 3, 3].any_value  # may overflow at the eye
_nearest = kernel("nearest", _SEEN, float, int, F32["h", "w"].out, I32["h", "w"].out)
# Lays each pixel's triangle (``winner``, -1: none) over what is there; of its corners' colours and
# covers as much as there is of each in the pixel.
blend = kernel("blend", F32["h", "w", 3].out, I32["h", "w"], _SEEN, F32["t", 3, 4], int)


def nearest(
    seen: Float32[np.ndarray, "t 3 3"], width: int, height: int, limit: float, perspective: bool
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Greatest nearness up to the limit in each pixel (-inf: nothing) and whose it is (-1).

    Seen are the corners' column, row and nearness, linear in the picture. In perspective a triangle
    that reaches behind the eye (nearness 0 or less) is left out.
    """
    near = np.full((height, width), -np.inf, np.float32)
    winner = np.full((height, width), -1, np.int32)
    _nearest(seen, limit, perspective, near, winner)
    return near, winner


@dataclass(frozen=True, eq=False)
class Body:
    """A surface somewhere in the world. ``opacity``: where seen face on; edges are denser."""

    mesh: Mesh
    color: RGB
    opacity: float = 1.0
    world_from_mesh: Float[np.ndarray, "4 4"] | None = None


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A viewer's position and projection; world frame, mm. ``axes``: rows right, down and forward.

    The picture's width spans ``width_mm`` of the plane at ``distance_mm``; surfaces more than
    ``before_mm`` in front of that plane are not shown. ``light``: direction towards it; ``up``:
    direction of the ambient light. ``parallel``: without perspective.
    """

    place_mm: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    distance_mm: float
    width_mm: float
    light: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]
    parallel: bool = False
    before_mm: float = np.inf

    @staticmethod
    def towards(
        target_mm: Float[np.ndarray, " 3"], place_mm: Float[np.ndarray, " 3"], width_mm: float,
        parallel: bool = False, before_mm: float = np.inf,
    ) -> Viewpoint:  # fmt: skip
        """Of a viewer who stands upright in a world whose z points up."""
        distance_mm = float(np.linalg.norm(target_mm - place_mm))
        forward, up = (target_mm - place_mm) / distance_mm, np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        light = _WORLD_LIGHT / np.linalg.norm(_WORLD_LIGHT)
        return Viewpoint(place_mm, axes, distance_mm, width_mm, light, up, parallel, before_mm)

    def project(
        self, points_mm: Float[np.ndarray, "*n 3"], size: tuple[int, int]
    ) -> Float[np.ndarray, "*n 3"]:
        """Column, row and nearness (greater is nearer, linear in the picture) of points.

        Nearness is 1/distance along the axis in perspective, not above 0 behind the viewer; minus
        the distance in parallel.
        """
        x, y, z = np.moveaxis((points_mm - self.place_mm) @ self.axes.T, -1, 0)
        width, height = size
        near = -z if self.parallel else 1 / np.where(np.abs(z) < 1e-6, 1e-6, z)
        scale = width / self.width_mm * (1.0 if self.parallel else self.distance_mm * near)
        middle = (width - 1) / 2, (height - 1) / 2
        return np.stack([scale * x + middle[0], scale * y + middle[1], near], axis=-1)


@dataclass(frozen=True)
class Frame:
    """What part of a parallel view is shown: left, right, top, bottom in mm along right, down."""

    left: float
    right: float
    top: float
    bottom: float

    def size(self, pixel_mm: float) -> tuple[int, int]:
        """Width and height in pixels."""
        width, height = self.right - self.left, self.bottom - self.top
        return max(int(np.ceil(width / pixel_mm)), 1), max(int(np.ceil(height / pixel_mm)), 1)

    def pixel_centres(self, pixel_mm: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
        """Positions along right (w,) and down (h,) of the pixels of a picture of it, mm."""
        width, height = self.size(pixel_mm)
        return (
            self.left + (np.arange(width) + 0.5) * pixel_mm,
            self.top + (np.arange(height) + 0.5) * pixel_mm,
        )

    @property
    def width_mm(self) -> float:
        return self.right - self.left

    def widened(self, aspect: float, least_mm: float = 0.0) -> Frame:
        """The smallest about the same middle with width = aspect * height that holds this one and
        is ``least_mm`` wide."""
        half_height = max(self.bottom - self.top, max(self.width_mm, least_mm) / aspect) / 2
        half_width = aspect * half_height
        x, y = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        return Frame(x - half_width, x + half_width, y - half_height, y + half_height)


@dataclass(frozen=True)
class ParallelView:
    """A parallel projection: unit vectors of the picture's right and down in the data's frame."""

    name: str
    right: tuple[float, float, float]
    down: tuple[float, float, float]

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rows right, down and away from the viewer."""
        return np.stack([self.right, self.down, np.cross(self.right, self.down)]).astype(float)

    def project(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """(right, down, depth away from the viewer) of each point, mm."""
        return points_mm @ self.axes.T

    def frame_around(self, points_mm: Float[np.ndarray, "n 3"], margin_mm: float = 5.0) -> Frame:
        flat = self.project(points_mm)
        low, high = flat.min(0) - margin_mm, flat.max(0) + margin_mm
        return Frame(float(low[0]), float(high[0]), float(low[1]), float(high[1]))

    def viewpoint(self, frame: Frame, pixel_mm: float) -> Viewpoint:
        """From where ``frame.size(pixel_mm)`` pixels show the frame."""
        half = np.array(frame.size(pixel_mm)) * pixel_mm / 2
        axes = self.axes
        place_mm = np.array([frame.left + half[0], frame.top + half[1], -_FAR_MM]) @ axes
        light = _VIEW_LIGHT @ axes / np.linalg.norm(_VIEW_LIGHT)
        return Viewpoint(place_mm, axes, _FAR_MM, 2 * half[0], light, -axes[2], parallel=True)

    def depth_of(
        self, mesh: Mesh, frame: Frame, pixel_mm: float = 0.25
    ) -> Float[np.ndarray, "h w"]:
        """Depth of each pixel, mm away from the viewer as in ``project``; infinite: nothing."""
        viewpoint, size = self.viewpoint(frame, pixel_mm), frame.size(pixel_mm)
        corners = viewpoint.project(mesh.vertices_mm, size).astype(np.float32)[mesh.faces]
        near, _ = nearest(corners, *size, np.inf, False)
        return -near.astype(float) - _FAR_MM


def render(
    bodies: list[Body], viewpoint: Viewpoint, size: tuple[int, int], backdrop: RGB = WHITE
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of the bodies; ``size``: width and height in pixels.

    Opaque bodies hide each other by depth; translucent ones tint what is behind them.
    """
    width, height = (_OVERSAMPLING * n for n in size)
    picture = np.empty((height, width, 3), np.float32)
    picture[:] = np.array(backdrop)
    near = np.full((height, width), -np.inf, np.float32)
    near = _paint(picture, near, [body for body in bodies if body.opacity >= 1], viewpoint)

    def far_first(body: Body) -> float:
        middle = body.mesh.box_mm.mean(0)[None]
        if body.world_from_mesh is not None:
            middle = transform_points(body.world_from_mesh, middle)
        return -float(np.linalg.norm(middle[0] - viewpoint.place_mm))

    for body in sorted((body for body in bodies if body.opacity < 1), key=far_first):
        _paint(picture, near, [body], viewpoint)
    sharp = Image.fromarray(np.rint(255 * picture).astype(np.uint8))
    return np.asarray(sharp.reduce(_OVERSAMPLING))


_NORMALS: WeakKeyDictionary[Mesh, np.ndarray] = WeakKeyDictionary()


def corner_normals(mesh: Mesh) -> Float32[np.ndarray, "f 3 3"]:
    """Unit normal at each face's corners: the mean over the faces there, or at a crease the
    face's."""
    if (known := _NORMALS.get(mesh)) is not None:
        return known
    order = np.lexsort(mesh.vertices_mm.T)
    new = (np.diff(mesh.vertices_mm[order], axis=0) != 0).any(1)
    place = np.empty(len(order), np.int64)
    place[order] = np.append(0, np.cumsum(new))[: len(order)]
    corner = place[mesh.faces]
    weighted = triangles_of(mesh.vertices_mm, mesh.faces)[1]
    area = np.linalg.norm(weighted, axis=1)
    sums = np.stack([np.bincount(corner.ravel(), np.repeat(w, 3)) for w in weighted.T], axis=1)
    areas = np.maximum(np.bincount(corner.ravel(), np.repeat(area, 3)), 1e-12)
    length = np.linalg.norm(sums, axis=1)
    smooth = (length / areas > np.cos(_CREASE_RAD / 2))[corner]
    mean = sums / np.maximum(length, 1e-12)[:, None]
    facing = weighted / np.maximum(area, 1e-12)[:, None]
    normals = np.where(smooth[..., None], mean[corner], facing[:, None]).astype(np.float32)
    _NORMALS[mesh] = normals
    return normals


def _corners(
    body: Body, viewpoint: Viewpoint
) -> tuple[Float[np.ndarray, "f 3 3"], Float32[np.ndarray, "f 3 4"]]:
    """Each face's corners in the world, mm, and their colours in a diffuse light and a little
    gloss, with how much of what is behind them they cover."""
    vertices, normals = body.mesh.vertices_mm, corner_normals(body.mesh)
    if (way := body.world_from_mesh) is not None:
        vertices = transform_points(way, vertices)
        normals = normals @ way[:3, :3].T.astype(np.float32)
    corners = vertices[body.mesh.faces]
    view = viewpoint.place_mm - corners
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    toward = np.einsum("fkx,fkx->fk", normals, view)
    normals = np.where(toward[..., None] < 0, -normals, normals)  # of a surface seen from behind
    half = viewpoint.light + view  # half way between the light and the viewer
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-9)
    lit = np.maximum(normals @ viewpoint.light, 0)
    gloss = 0.16 * np.maximum(np.einsum("fkx,fkx->fk", normals, half), 0) ** 40 * (lit > 0)
    strength = 0.46 + 0.1 * normals @ viewpoint.up + 0.5 * lit
    color = np.minimum(np.array(body.color) * strength[..., None] + gloss[..., None], 1)
    slant = 1 - np.abs(toward)  # edges are denser
    cover = body.opacity + (1 - body.opacity) * 0.75 * slant**2
    return corners, np.concatenate([color, cover[..., None]], axis=-1).astype(np.float32)


def _paint(
    picture: Float32[np.ndarray, "h w 3"], below: Float32[np.ndarray, "h w"],
    bodies: list[Body], viewpoint: Viewpoint,
) -> Float32[np.ndarray, "h w"]:  # fmt: skip
    """Paint bodies where nothing in ``below`` is nearer; returns their nearness (-inf: none)."""
    if not bodies:
        return below
    corners, colours = map(
        np.concatenate, zip(*(_corners(body, viewpoint) for body in bodies), strict=True)
    )
    size = picture.shape[1], picture.shape[0]
    seen = viewpoint.project(corners, size).astype(np.float32)
    perspective = not viewpoint.parallel
    closest_mm = max(viewpoint.distance_mm - viewpoint.before_mm, 1.0)
    limit = 1 / closest_mm if perspective else -closest_mm
    near, winner = nearest(seen, *size, limit, perspective)
    one_mm = near**2 if perspective else np.float32(1.0)  # of nearness
    winner[near - _SAME_MM * one_mm <= below] = -1
    blend(picture, winner, seen, colours, perspective)
    return near
