"""Pictures of bodies that move, many a second and without a display.

A z-buffer in perspective or parallel, normals that are smooth but for creases, one light with
shadows, and see-through bodies over the opaque ones. ``shade`` is for stills in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.report.painter_kernels import crease, light, nearest, shrunk

_SHARPER = 2  # pixels drawn per pixel shown, each way: smooth edges
_CREASE = np.cos(np.radians(40.0))  # faces that meet at a sharper angle keep their edge
_LIGHT = np.array([-0.42, -0.5, 1.0]) / np.linalg.norm([-0.42, -0.5, 1.0])  # towards it
_SHADOW_PIXELS = 1024
_SAME_MM = 0.6  # a see-through surface that close over an opaque one is the same one

Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class PaintedBody:
    """A surface somewhere in the world; colour in 0..255.

    ``opacity``: where seen face on; edges are denser. ``shaded``: whether other bodies cast
    shadows on it.
    """

    mesh: Mesh
    colour: Colour
    world_from_mesh: Float[np.ndarray, "4 4"] | None = None
    opacity: float = 1.0
    shaded: bool = True


@dataclass(frozen=True, eq=False)
class Eye:
    """From where one looks; world frame, mm, z up.

    Attributes:
        width_mm: what the picture's width spans at the target's distance.
        parallel: without perspective.
        before_mm: what is nearer to the eye than the target by more is not shown.
    """

    place_mm: Float[np.ndarray, " 3"]
    target_mm: Float[np.ndarray, " 3"]
    width_mm: float
    parallel: bool = False
    before_mm: float = np.inf

    @property
    def distance_mm(self) -> float:
        return float(np.linalg.norm(self.target_mm - self.place_mm))

    def project(
        self, points_mm: Float[np.ndarray, "*n 3"], size: tuple[int, int]
    ) -> Float[np.ndarray, "*n 3"]:
        """Column, row and nearness (greater is nearer, linear in the picture) of points.

        Nearness is 1/distance along the axis in perspective, not above 0 behind the eye; minus the
        distance in parallel.
        """
        forward = (self.target_mm - self.place_mm) / self.distance_mm
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        x, y, z = np.moveaxis(
            (points_mm - self.place_mm) @ np.stack([right, np.cross(forward, right), forward], 1),
            -1,
            0,
        )
        width, height = size
        near = -z if self.parallel else 1 / np.where(np.abs(z) < 1e-6, 1e-6, z)
        scale = width / self.width_mm * (1.0 if self.parallel else self.distance_mm * near)
        middle = (width - 1) / 2, (height - 1) / 2
        return np.stack([scale * x + middle[0], scale * y + middle[1], near], axis=-1)

    @property
    def limit(self) -> float:
        """The greatest nearness shown."""
        distance = max(self.distance_mm - self.before_mm, 1.0)
        return -distance if self.parallel else 1 / distance


class _Triangles(NamedTuple):
    """Many bodies as one, world frame: vertices, and per triangle its corners, their normals, its
    colour."""

    places: Float32[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "t 3"]
    normals: Float32[np.ndarray, "t 3 3"]
    colours: Float32[np.ndarray, "t 3"]
    shaded: Bool[np.ndarray, " t"]


class _Shadow(NamedTuple):
    """What the light sees: ``near`` is how far up towards it each pixel's first surface lies."""

    near: Float32[np.ndarray, "s s"]
    axes: Float32[np.ndarray, "3 3"]  # rows: across, down, towards the light
    corner: Float32[np.ndarray, " 2"]  # of its first pixel, mm along across and down
    pixel_mm: float


def paint(
    bodies: list[PaintedBody], eye: Eye, size: tuple[int, int], backdrop: Colour = (238, 241, 244)
) -> UInt8[np.ndarray, "h w 3"]:
    """The bodies as the eye sees them; ``size`` is width and height in pixels."""
    width, height = (_SHARPER * n for n in size)
    solid = _join([body for body in bodies if body.opacity >= 1])
    shadow = _shadow(solid if solid.shaded.any() else _join([]), eye)
    picture = np.empty((height, width, 3), np.float32)
    picture[:] = np.array(backdrop) / 255
    near = np.full((height, width), -np.inf, np.float32)
    near = _lay(picture, near, solid, eye, shadow, 1.0)
    for body in _far_first([body for body in bodies if body.opacity < 1], eye):
        _lay(picture, near, _join([body]), eye, shadow, body.opacity)
    return shrunk(picture, _SHARPER)


def _far_first(bodies: list[PaintedBody], eye: Eye) -> list[PaintedBody]:
    def distance(body: PaintedBody) -> float:
        middle = body.mesh.box_mm.mean(0)[None]
        if body.world_from_mesh is not None:
            middle = transform_points(body.world_from_mesh, middle)
        return -float(np.linalg.norm(middle[0] - eye.place_mm))

    return sorted(bodies, key=distance)


def _join(bodies: list[PaintedBody]) -> _Triangles:
    places, faces, normals, count = [np.zeros((0, 3))], [np.zeros((0, 3), int)], [], 0
    for body in bodies:
        vertices, normal = body.mesh.vertices_mm, corner_normals(body.mesh)
        if (way := body.world_from_mesh) is not None:
            vertices = transform_points(way, vertices)
            normal = (normal.reshape(-1, 3) @ way[:3, :3].T.astype(np.float32)).reshape(-1, 3, 3)
        places.append(vertices)
        faces.append(body.mesh.faces + count)
        normals.append(normal)
        count += len(vertices)
    each = [len(body.mesh.faces) for body in bodies]
    colours = np.array([body.colour for body in bodies], np.float32).reshape(-1, 3) / 255
    return _Triangles(
        np.concatenate(places).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([np.zeros((0, 3, 3), np.float32), *normals]),
        np.repeat(colours, each, axis=0),
        np.repeat(np.array([body.shaded for body in bodies], bool), each),
    )


_NORMALS: WeakKeyDictionary[Mesh, np.ndarray] = WeakKeyDictionary()  # a link's never change


def corner_normals(mesh: Mesh) -> Float32[np.ndarray, "f 3 3"]:
    """Unit normal at each face's corners: the mean of the faces about the same place that make no
    crease with this one, weighted by their areas."""
    if (known := _NORMALS.get(mesh)) is not None:
        return known
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    _, place = np.unique(mesh.vertices_mm, axis=0, return_inverse=True)
    corner = place.reshape(-1)[mesh.faces].reshape(-1)
    order = np.argsort(corner, kind="stable")
    first = np.searchsorted(corner[order], np.arange(corner.max(initial=-1) + 2))
    normals = crease(area, unit, corner, order // 3, first, _CREASE)
    _NORMALS[mesh] = normals.reshape(-1, 3, 3).astype(np.float32)
    return _NORMALS[mesh]


def _shadow(triangles: _Triangles, eye: Eye) -> _Shadow:
    across = np.cross([0.0, 1.0, 0.0], _LIGHT)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(_LIGHT, across), _LIGHT]).astype(np.float32)
    pixel_mm = 1.6 * eye.width_mm / _SHADOW_PIXELS
    middle = axes[:2] @ eye.target_mm.astype(np.float32)
    corner = (middle - pixel_mm * _SHADOW_PIXELS / 2).astype(np.float32)
    seen = triangles.places @ axes.T
    seen[:, :2] = (seen[:, :2] - corner) / pixel_mm
    near, _ = nearest(seen, triangles.faces, _SHADOW_PIXELS, _SHADOW_PIXELS, np.inf, False)
    return _Shadow(near, axes, corner, pixel_mm)


def _lay(
    picture: Float32[np.ndarray, "h w 3"],
    below: Float32[np.ndarray, "h w"],
    triangles: _Triangles,
    eye: Eye,
    shadow: _Shadow,
    opacity: float,
) -> Float32[np.ndarray, "h w"]:
    """Paint them where nothing in ``below`` is nearer; returns their nearness (-inf: nothing)."""
    size = picture.shape[1], picture.shape[0]
    seen = eye.project(triangles.places.astype(float), size).astype(np.float32)
    near, winner = nearest(seen, triangles.faces, *size, eye.limit, not eye.parallel)
    one_mm = np.float32(1.0) if eye.parallel else near**2  # of nearness
    winner[near - _SAME_MM * one_mm <= below] = -1
    place = eye.place_mm.astype(np.float32)
    light(picture, winner, seen, not eye.parallel, place, opacity, triangles, shadow)
    return near


def tube(points_mm: Float[np.ndarray, "n 3"], radius_mm: float, sides: int = 6) -> Mesh:
    """A polyline as a thin closed tube; its joints are mitred."""
    step = np.diff(points_mm, axis=0)
    step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
    along = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    least = np.eye(3)[np.abs(along).argmin(1)]  # the axis most across
    a = np.cross(along, least)
    for one, two in pairwise(range(len(a))):  # carried along, so that the tube does not twist
        a[two] = a[one] - along[two] * (a[one] @ along[two])
        a[two] /= max(float(np.linalg.norm(a[two])), 1e-9)
    a[0] /= np.linalg.norm(a[0])
    b = np.cross(along, a)
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = np.cos(turn)[None, :, None] * a[:, None] + np.sin(turn)[None, :, None] * b[:, None]
    vertices = (points_mm[:, None] + radius_mm * ring).reshape(-1, 3)
    n = len(points_mm)
    first = sides * np.arange(n - 1)[:, None] + np.arange(sides)
    next_ = sides * np.arange(n - 1)[:, None] + (np.arange(sides) + 1) % sides
    low = np.stack([first, next_, next_ + sides], -1).reshape(-1, 3)
    high = np.stack([first, next_ + sides, first + sides], -1).reshape(-1, 3)
    fan = np.stack([np.zeros(sides - 2), np.arange(1, sides - 1), np.arange(2, sides)], -1)
    ends = [fan[:, ::-1], fan + sides * (n - 1)]
    return Mesh(vertices, np.concatenate([low, high, *ends]).astype(np.int32))
