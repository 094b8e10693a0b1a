"""What hides a chosen share of the organ: a shaft, a lump of fat, the edge of a drape.

Solid things before the camera, drawn with it, one after another: each is pushed in or grows until
it hides its part of the share. As with the twin's other instruments, they are taken to be segmented
out: no return where they hide the organ, and none of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, Mesh
from tumortrack.sense.camera import deproject
from tumortrack.sense.render import render_depth
from tumortrack_lab.twin.props import rod_mesh, shaft_over

LARGEST_SHARE = 0.9
_PARTS = (1 / 3, 2 / 3, 1.0)  # of the share: up to which the shaft, the lump, the drape hide
_PULLED_BACK_MM = 140.0  # a shaft that hides nothing yet
_LUMP_MM = (1.0, 100.0)  # longest half axis
_DRAPE_MM = (-160.0, 160.0)  # place of its edge along its way, from the organ's middle
_DRAPE_ABOVE_MM = 3.0  # before the organ's nearest point
_HALVINGS = 14

Solid = Callable[[float], Mesh]  # a mesh (camera frame) that hides more the higher its number


def cover(
    frame: DepthFrame, share: float, shaft_radius_mm: float, rng: np.random.Generator
) -> tuple[DepthFrame, float]:
    """The frame with that share of its returns hidden, and the share that it has become.

    The things keep their places and directions from one share to another with the same generator;
    only how far they reach differs. They add up: what one hides the next need not.

    Raises:
        InputError: a share outside 0..0.9, or a frame without returns.
    """
    if not 0 <= share <= LARGEST_SHARE:
        raise InputError(f"a share of {share:g} cannot be hidden; allowed: 0 to {LARGEST_SHARE:g}.")
    if not np.isfinite(frame.depth_mm).any():
        raise InputError("the depth image has no return, so nothing of it can be hidden.")
    things = (_shaft(frame, shaft_radius_mm, rng), _lump(frame, rng), _drape(frame, rng))
    depth_mm = frame.depth_mm.copy()
    total = int(np.isfinite(depth_mm).sum())
    for solid, part in zip(things, _PARTS, strict=True):
        depth_mm = _hide(frame, depth_mm, solid, round(part * share * total), total)
    return (
        DepthFrame(depth_mm, frame.intrinsics, frame.stamp_ns),
        1 - float(np.isfinite(depth_mm).sum()) / total,
    )


def _hide(
    frame: DepthFrame, depth_mm: np.ndarray, solid: Solid, count: int, total: int
) -> np.ndarray:
    """The depths with up to ``count`` of all ``total`` returns hidden, by bisection."""

    def without(number: float) -> np.ndarray:
        mesh = solid(number)
        front = render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics).depth_mm
        with np.errstate(invalid="ignore"):
            return np.where(front < depth_mm, np.float32(np.nan), depth_mm)

    best, low, high = depth_mm, 0.0, 1.0
    for number in (1.0, *[np.nan] * _HALVINGS):
        number = (low + high) / 2 if np.isnan(number) else number
        tried = without(number)
        if total - int(np.isfinite(tried).sum()) > count:
            high = number
            continue
        best, low = tried, number
        if number == 1.0:  # hides less even where it reaches farthest
            break
    return best


def _shaft(frame: DepthFrame, radius_mm: float, rng: np.random.Generator) -> Solid:
    """The twin's shaft, drawn back along itself."""
    rod = shaft_over(frame, radius_mm, rng)

    def solid(number: float) -> Mesh:
        tip = np.array(rod.tip_mm) + (1 - number) * _PULLED_BACK_MM * np.array(rod.axis)
        x, y, z = tip.tolist()
        return rod_mesh(replace(rod, tip_mm=(x, y, z)))

    return solid


def _lump(frame: DepthFrame, rng: np.random.Generator) -> Solid:
    """A lump of fat with hills that grows over the organ from a place on its outline."""
    import trimesh

    ball = trimesh.creation.icosphere(4, 1.0)
    directions, phases = rng.standard_normal((5, 3)), rng.uniform(0, 2 * np.pi, 5)
    hills = 0.09 * np.sin(2.5 * ball.vertices @ directions.T + phases).sum(1)
    unit = ball.vertices * (1 + hills)[:, None]
    angle = rng.uniform(0, 2 * np.pi)
    spin = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = deproject(frame).astype(float)
    outwards = points[:, :2] @ _unit(rng.uniform(0, 2 * np.pi))
    place = points[int(np.argmax(outwards))]
    rim_mm = float(place[2])

    def solid(number: float) -> Mesh:
        size = _LUMP_MM[0] + number * (_LUMP_MM[1] - _LUMP_MM[0])
        vertices = unit * np.array([size, 0.7 * size, 0.4 * size])
        vertices[:, :2] = vertices[:, :2] @ spin.T
        middle = np.array([place[0], place[1], rim_mm - 0.25 * size])
        return Mesh(vertices + middle, ball.faces)

    return solid


def _drape(frame: DepthFrame, rng: np.random.Generator) -> Solid:
    """A creased sheet before the organ whose wavy edge comes in from any side."""
    points = deproject(frame).astype(float)
    middle, nearest_mm = points.mean(0), float(points[:, 2].min())
    way = _unit(rng.uniform(0, 2 * np.pi))
    across = np.array([-way[1], way[0]])
    waves, phases = rng.uniform(0.02, 0.12, 4), rng.uniform(0, 2 * np.pi, 4)
    steps = np.linspace(0, 1, 41)
    side, back = np.meshgrid(400 * (steps - 0.5), 500 * steps**2, indexing="ij")
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + 41, corner + 1], 1),
            np.stack([corner + 1, corner + 41, corner + 42], 1),
        ]
    )
    edge = 4.0 * np.sin(side[..., None] * waves + phases).sum(-1)

    def solid(number: float) -> Mesh:
        along = _DRAPE_MM[0] + number * (_DRAPE_MM[1] - _DRAPE_MM[0]) + edge - back
        flat = middle[:2] + along[..., None] * way + side[..., None] * across
        creases = 1.0 + np.sin(0.15 * along + phases[0]) * np.sin(0.2 * side + phases[1])
        depth = nearest_mm - _DRAPE_ABOVE_MM - creases
        vertices = np.concatenate([flat, depth[..., None]], axis=-1).reshape(-1, 3)
        return Mesh(vertices, _towards_camera(vertices, faces))

    return solid


def _towards_camera(vertices: Float64[np.ndarray, "v 3"], faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return faces if np.cross(b - a, c - a)[:, 2].sum() < 0 else faces[:, ::-1]


def _unit(angle: float) -> Float64[np.ndarray, " 2"]:
    return np.array([np.cos(angle), np.sin(angle)])
