"""What stands and lies about the organ: the table's plane, a drape, an instrument's shaft.

Surfaces are cut into small triangles, for the renderer leaves out one that reaches behind the
camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from tumortrack.core.types import Intrinsics, Mesh

_REACH_MM = 400.0  # of a sheet to every side
_CELLS = 40  # of a sheet along each edge
_RING_MM = 4.0
_SECTIONS = 24
_WAVES = 5
_FARTHEST_MM = 500.0  # that the sensor sees of a table


@dataclass(frozen=True, eq=False)
class Table:
    """The plane under an organ, and how the organ rises over it; CT frame."""

    origin: Float64[np.ndarray, " 3"]  # under the organ's middle
    up: Float64[np.ndarray, " 3"]
    organ_height_mm: float
    organ_radius_mm: float

    @classmethod
    def under(cls, organ: Mesh, up: Float64[np.ndarray, " 3"]) -> Table:
        """The plane on which an organ lies; ``up`` is a unit vector."""
        heights = organ.vertices_mm @ up
        middle = organ.box_mm.mean(0)
        offset = organ.vertices_mm - middle
        beside = offset - np.outer(offset @ up, up)
        return cls(
            middle - up * (middle @ up - heights.min()),
            up,
            float(np.ptp(heights)),
            float(np.linalg.norm(beside, axis=1).mean()),
        )

    def depth_mm(
        self, camera_from_room: Float64[np.ndarray, "4 4"], intrinsics: Intrinsics
    ) -> Float32[np.ndarray, "h w"]:
        """Depth of the bare plane, NaN where the camera looks past it: 1/z is linear in the
        image."""
        normal = camera_from_room[:3, :3] @ self.up
        origin = camera_from_room[:3, :3] @ self.origin + camera_from_room[:3, 3]
        across = normal[0] * (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
        downward = normal[1] * (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
        rows = ((downward + normal[2]) / (normal @ origin)).astype(np.float32)
        columns = (across / (normal @ origin)).astype(np.float32)
        nearness = rows[:, None] + columns
        nearness[nearness < 1 / _FARTHEST_MM] = np.nan
        return np.float32(1) / nearness


def drape(table: Table, rng: np.random.Generator) -> Mesh:
    """A cloth with folds, seen from above only: about the organ it lies nearly half as high as it,
    farther off it falls to the table."""
    steps = np.linspace(-_REACH_MM, _REACH_MM, _CELLS + 1)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    beyond = np.clip(np.hypot(x, y) - table.organ_radius_mm, 0, None)
    height = 0.45 * table.organ_height_mm * np.exp(-0.5 * (beyond / 60) ** 2) + 4.0
    for _ in range(_WAVES):
        angle, phase = rng.uniform(0, 2 * np.pi, 2)
        length_mm = rng.uniform(25, 70)
        along = np.cos(angle) * x + np.sin(angle) * y
        height += rng.uniform(0.3, 1.2) * np.sin(2 * np.pi * along / length_mm + phase)
    one = np.cross(table.up, np.eye(3)[np.argmin(np.abs(table.up))])
    one /= np.linalg.norm(one)
    places = np.stack([x, y, np.maximum(height, 0.5)], -1)
    places = places @ np.stack([one, np.cross(table.up, one), table.up])
    number = np.arange(x.size).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.stack([a, b, c, a, c, d], -1).reshape(-1, 3)
    return Mesh(table.origin + places.reshape(-1, 3), faces)


def rod(radius_mm: float, length_mm: float) -> Mesh:
    """A shaft along +z whose round tip touches the origin."""
    angle = np.linspace(0, np.pi / 2, 7)[1:]
    rings = np.ceil(length_mm / _RING_MM)
    along = np.linspace(radius_mm, length_mm, int(rings) + 1)[1:]
    radius = np.concatenate([radius_mm * np.sin(angle), np.full(len(along), radius_mm)])
    height = np.concatenate([radius_mm * (1 - np.cos(angle)), along])
    turn = np.arange(_SECTIONS) * 2 * np.pi / _SECTIONS
    circles = np.empty((len(radius), _SECTIONS, 3))
    circles[..., 0] = radius[:, None] * np.cos(turn)
    circles[..., 1] = radius[:, None] * np.sin(turn)
    circles[..., 2] = height[:, None]
    ends = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, length_mm]])
    vertices = np.concatenate([circles.reshape(-1, 3), ends])
    number = np.arange(len(radius) * _SECTIONS).reshape(len(radius), _SECTIONS)
    following = np.roll(number, -1, axis=1)
    low, high = number[:-1], number[1:]
    low_next, high_next = following[:-1], following[1:]
    side = [np.stack([low, low_next, high], -1), np.stack([low_next, high_next, high], -1)]
    tip, end = np.full(_SECTIONS, len(vertices) - 2), np.full(_SECTIONS, len(vertices) - 1)
    caps = [
        np.stack([tip, following[0], number[0]], -1),
        np.stack([end, number[-1], following[-1]], -1),
    ]
    return Mesh(vertices, np.concatenate([part.reshape(-1, 3) for part in (*side, *caps)]))
