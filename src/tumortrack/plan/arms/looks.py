"""Surfaces of the cell for the eye, made once."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from jaxtyping import Float64

from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.live.values import RigidShape
from tumortrack.plan.arms.body import YELLOW, Part

_SIDES = 28
_BEAD_MM = 1.5


class Looks:
    """The visible parts, each with its surface in its link's frame."""

    def __init__(self, parts: tuple[Part, ...]) -> None:
        self._parts = tuple(part for part in parts if part.use != "collision")
        self._meshes = tuple(_surface(part) for part in self._parts)
        self.links = tuple(dict.fromkeys(part.link for part in self._parts))

    def shapes(self, places: Mapping[str, Float64[np.ndarray, "4 4"]]) -> tuple[RigidShape, ...]:
        """All of them where ``places`` (``table_from_link``, mm) puts their links."""
        return tuple(
            RigidShape(part.whose, mesh, places[part.link], part.colour)
            for part, mesh in zip(self._parts, self._meshes, strict=True)
        )


def tip(arm: str, table_from_tip: Float64[np.ndarray, "4 4"]) -> RigidShape:
    """A bead where a tool ends, by the name that sinks know tips by: ``cutter/tip``."""
    return RigidShape(f"{arm}/tip", _bead(), table_from_tip, YELLOW)


@cache
def _bead() -> Mesh:
    import trimesh

    ball = trimesh.creation.icosphere(1, _BEAD_MM)
    return Mesh(np.array(ball.vertices), ball.faces)


def _surface(part: Part) -> Mesh:
    """A box, or a cylinder with its rims rounded off."""
    import trimesh

    if part.kind == "box":
        solid = trimesh.creation.box(part.size_mm)
    else:
        radius, length = part.size_mm
        round_mm = min(0.25 * radius, 0.25 * length, 12.0)
        angle = np.linspace(0, np.pi / 2, 5)
        sin, cos = round_mm * np.sin(angle), round_mm * np.cos(angle)
        lower = np.stack([radius - round_mm + sin, round_mm - cos - length / 2], 1)
        upper = np.stack([radius - round_mm + cos, length / 2 - round_mm + sin], 1)
        outline = np.concatenate([[[0.0, -length / 2]], lower, upper, [[0.0, length / 2]]])
        solid = trimesh.creation.revolve(outline, sections=_SIDES)
    return Mesh(transform_points(part.link_from_part, np.array(solid.vertices)), solid.faces)
