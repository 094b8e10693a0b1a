"""Solids that printed parts are built of: ``manifold3d.Manifold``, mm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.solids import solid_of
from tumortrack.core.types import Mesh

_SIDES = 48  # of a circle: a cone is then out of round by 0.006 mm where a bead touches it
Corner = Sequence[float] | np.ndarray


def box(low: Corner, high: Corner) -> Any:
    """From its lower to its upper corner."""
    from manifold3d import Manifold

    return Manifold.cube(np.subtract(high, low)).translate(low)


def cone(foot: Corner, height: float, radius: float, top: float | None = None) -> Any:
    """Upright, from its foot's middle; ``top``: its radius there (a cylinder without)."""
    from manifold3d import Manifold

    above = radius if top is None else top
    return Manifold.cylinder(height, radius, above, _SIDES).translate(foot)


def ball(center: Corner, radius: float) -> Any:
    from manifold3d import Manifold

    return Manifold.sphere(radius, _SIDES).translate(center)


def rounded_plate(half: tuple[float, float], low: float, high: float, radius: float) -> Any:
    """A plate about x = y = 0 with rounded corners."""
    from manifold3d import CrossSection

    inner = [2 * (side - radius) for side in half]
    return (
        CrossSection.square(inner, True).offset(radius).extrude(high - low).translate((0, 0, low))
    )


def written(text: str, at: Corner, size: float, height: float) -> Any:
    """A line of text, upright from a plane, about its middle."""
    from manifold3d import CrossSection, FillRule
    from matplotlib.textpath import TextPath

    path = TextPath((0, 0), text, size=size)
    middle = path.get_extents().get_points().mean(0)
    outlines = [np.asarray(ring)[:-1] - middle for ring in path.to_polygons()]
    return CrossSection(outlines, FillRule.EvenOdd).extrude(height).translate(at)


def height_field(
    x: Float[np.ndarray, " w"],
    y: Float[np.ndarray, " h"],
    z: Float[np.ndarray, "h w"],
    floor: float,
) -> Any:
    """What lies between a floor and heights over a grid."""
    top = np.stack([*np.meshgrid(x, y), z], -1).reshape(-1, 3)
    n, at = len(top), np.arange(len(top)).reshape(z.shape)
    a, b, c, d = (side.ravel() for side in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    cover = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([at[0], at[1:, -1], at[-1, -2::-1], at[-2:0:-1, 0]])
    ahead = np.roll(rim, -1)
    walls = [np.stack([rim, rim + n, ahead], 1), np.stack([ahead, rim + n, ahead + n], 1)]
    vertices = np.concatenate([top, top * [1, 1, 0] + [0, 0, floor]])
    faces = np.concatenate([cover, cover[:, ::-1] + n, *walls]).astype(np.int32)
    return solid_of(Mesh(vertices, faces), "the cradle")
