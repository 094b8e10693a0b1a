"""Pictures of bodies that move, many a second and without a display.

A z-buffer in perspective or parallel, normals that are smooth but for creases, one light with
shadows, and see-through bodies over the opaque ones. ``shade`` is for stills in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.evaluate.painter_kernels import crease, light, nearest, shrunk

_SHARPER = 2  # pixels drawn per pixel shown, each way: smooth edges
_CREASE = np.cos(np.radians(40.0))  # faces that meet at a sharper angle keep their edge
_LIGHT = np.array([-0.42, -0.5, 1.0]) / np.linalg.norm([-0.42, -0.5, 1.0])  # towards it
_SHADOW_PIXELS = 1024
_SAME_MM = 0.6  # a see-through surface that close over an opaque one is the same one

Colour = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Body:
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
    """Many bodies as one: per corner its place and normal (t, 3, 3), world frame."""

    places: Float32[np.ndarray, "t 3 3"]
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
    bodies: list[Body], eye: Eye, size: tuple[int, int], backdrop: Colour = (238, 241, 244)
) -> UInt8[np.ndarray, "h w 3"]:
    """The bodies as the eye sees them; ``size`` is width and height in pixels."""
    width, height = (_SHARPER * n for n in size)
    solid = _join([body for body in bodies if body.opacity >= 1])
    shadow = _shadow(solid.places, eye)
    picture = np.empty((height, width, 3), np.float32)
    picture[:] = np.array(backdrop) / 255
    near = np.full((height, width), -np.inf, np.float32)
    near = _lay(picture, near, solid, eye, shadow, 1.0)
    for body in _far_first([body for body in bodies if body.opacity < 1], eye):
        _lay(picture, near, _join([body]), eye, shadow, body.opacity)
    return shrunk(picture, _SHARPER)


def _far_first(bodies: list[Body], eye: Eye) -> list[Body]:
    def distance(body: Body) -> float:
        middle = body.mesh.box_mm.mean(0)[None]
        if body.world_from_mesh is not None:
            middle = transform_points(body.world_from_mesh, middle)
        return -float(np.linalg.norm(middle[0] - eye.place_mm))

    return sorted(bodies, key=distance)


def _join(bodies: list[Body]) -> _Triangles:
    places, normals, colours, shaded = [], [], [], []
    for body in bodies:
        corners, normal = body.mesh.vertices_mm[body.mesh.faces], corner_normals(body.mesh)
        if body.world_from_mesh is not None:
            turn = body.world_from_mesh[:3, :3].T
            corners, normal = corners @ turn + body.world_from_mesh[:3, 3], normal @ turn
        places.append(corners)
        normals.append(normal)
        colours.append(np.tile(np.array(body.colour) / 255, (len(corners), 1)))
        shaded.append(np.full(len(corners), body.shaded))
    if not places:
        empty = np.zeros((0, 3, 3), np.float32)
        return _Triangles(empty, empty, empty[:, 0], np.zeros(0, bool))
    return _Triangles(
        np.concatenate(places).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(colours).astype(np.float32),
        np.concatenate(shaded),
    )


_NORMALS: WeakKeyDictionary[Mesh, np.ndarray] = WeakKeyDictionary()  # a link's never change


def corner_normals(mesh: Mesh) -> Float[np.ndarray, "f 3 3"]:
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
    _NORMALS[mesh] = normals.reshape(-1, 3, 3)
    return _NORMALS[mesh]


def _shadow(places: Float32[np.ndarray, "t 3 3"], eye: Eye) -> _Shadow:
    across = np.cross([0.0, 1.0, 0.0], _LIGHT)
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(_LIGHT, across), _LIGHT]).astype(np.float32)
    pixel_mm = 1.6 * eye.width_mm / _SHADOW_PIXELS
    middle = axes[:2] @ eye.target_mm.astype(np.float32)
    corner = (middle - pixel_mm * _SHADOW_PIXELS / 2).astype(np.float32)
    seen = places @ axes.T
    seen[..., :2] = (seen[..., :2] - corner) / pixel_mm
    near, _ = nearest(np.ascontiguousarray(seen), _SHADOW_PIXELS, _SHADOW_PIXELS, np.inf)
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
    corners = eye.project(triangles.places.astype(float), size)
    if not eye.parallel:  # a triangle that reaches behind the eye is left out
        behind = (corners[..., 2] <= 0).any(1)
        triangles = _Triangles(*(array[~behind] for array in triangles))
        corners = corners[~behind]
    corners = corners.astype(np.float32)
    near, winner = nearest(corners, *size, eye.limit)
    one_mm = np.float32(1.0) if eye.parallel else near**2  # of nearness
    winner[near - _SAME_MM * one_mm <= below] = -1
    place = eye.place_mm.astype(np.float32)
    light(picture, winner, corners, not eye.parallel, place, opacity, triangles, shadow)
    return near
