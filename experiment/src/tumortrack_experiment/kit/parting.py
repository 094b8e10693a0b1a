"""How a mold comes off: the pull of least undercut, and a parting surface that follows the organ.

Along the pull every point of the surface that is seen from above or below comes free; the rest is
undercut. Between the halves lies a membrane: heights over the plane across the pull with the least
sum of squared slopes (harmonic, flat far away) that pass between the organ's lowest and highest
point in every column. At the silhouette these two meet, so the membrane meets the organ where
visibility changes sides, however rough the organ is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Real
from scipy import ndimage

from tumortrack.core.geometry import perpendicular, triangles_of, unit
from tumortrack.core.raster import voxelise
from tumortrack.core.render import Visibility
from tumortrack.core.types import Mesh

_FAR_MM = 50_000.0  # an eye from where the organ is seen as good as in parallel
_GRAZED_MM = 0.05  # a wall along the pull is seen past itself
_SEARCHED = 3000  # faces that stand for all in the search, drawn by their area
_COARSE = 200  # pulls tried first, 10 degrees apart; then rings round the best:
_RINGS = np.radians([7.0, 3.5, 1.7])
_FLATTER = 0.01  # share of the surface that a pull along the shortest side is worth
_STEEP = np.sin(np.radians(25.0))  # between a pin and the parting surface
_INSIDE_MM = 0.3  # that the membrane keeps from the organ's surface where it can
_CROSS = ndimage.generate_binary_structure(2, 1)


def directions(n: int) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors evenly over the sphere (a Fibonacci lattice), those with z > 0 first."""
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + np.sqrt(5)) * i
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def undercut(
    mesh: Mesh, pull: Float[np.ndarray, " 3"], sight: Visibility
) -> Bool[np.ndarray, " f"]:
    """Which faces of a surface (or a part of it) the ``sight`` of the whole finds laid open neither
    by ``pull`` nor against it."""
    middle, area = triangles_of(mesh.vertices_mm, mesh.faces)
    outward = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    middle += _GRAZED_MM * outward
    hidden, up = np.zeros(len(middle), bool), area @ pull > 0
    for side, way in ((up, pull), (~up, -pull)):
        hidden[side] = ~sight(middle[side], mesh.box_mm.mean(0) + _FAR_MM * way)
    return hidden


def best_pull(
    mesh: Mesh, pins: Float[np.ndarray, "p 3"] | None = None
) -> Float64[np.ndarray, " 3"]:
    """The direction of least undercut; of nearly equal ones that along which it is shortest. The
    ``pins`` are unit vectors that should not lie in the plane across it."""
    sight, rng = Visibility(mesh), np.random.default_rng(0)
    area = np.linalg.norm(triangles_of(mesh.vertices_mm, mesh.faces)[1], axis=1)
    drawn = rng.choice(len(area), min(_SEARCHED, 4 * len(area)), p=area / area.sum())
    some = Mesh(mesh.vertices_mm, mesh.faces[drawn])

    def cost(pull: np.ndarray) -> float:
        flat = 0.0 if pins is None else max(_STEEP - np.abs(pins @ pull).min(), 0)
        length = np.ptp(mesh.vertices_mm @ pull) / mesh.longest_mm
        return float(undercut(some, pull, sight).mean() + _FLATTER * length + flat)

    best = min(directions(2 * _COARSE)[:_COARSE], key=cost)
    for ring in _RINGS:
        across, turn = perpendicular(best), np.arange(12)[:, None] * np.pi / 6
        tilt = np.cos(turn) * across + np.sin(turn) * np.cross(best, across)
        best = min([best, *(np.cos(ring) * best + np.sin(ring) * tilt)], key=cost)
    return unit(best)


class Cells:
    """Which cells' centres lie in a closed mesh, on a grid along the axes of its frame."""

    def __init__(self, mesh: Mesh, step_mm: tuple[float, float, float], margin_mm: float) -> None:
        self.step_mm = np.array(step_mm)
        margin = np.maximum([margin_mm, margin_mm, 0.0], 2 * self.step_mm)
        self.origin_mm = mesh.box_mm[0] - margin
        size = np.ptp(mesh.box_mm, axis=0) + 2 * margin
        self._frame = np.diag([*step_mm, 1.0])
        self._frame[:3, 3] = self.origin_mm
        i, j, k = (np.ceil(size / self.step_mm).astype(int) + 1).tolist()
        self.inside = self.fill(mesh, (i, j, k))

    def fill(
        self, mesh: Mesh, shape: tuple[int, int, int] | None = None
    ) -> Bool[np.ndarray, "i j k"]:
        """The same cells in another mesh."""
        return voxelise(mesh, self._frame, shape or self.inside.shape)

    def at(self, points_mm: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, " *n"]:
        """Whether points lie in a cell that is inside."""
        index = np.rint((points_mm - self.origin_mm) / self.step_mm).astype(int)
        held = np.clip(index, 0, np.array(self.inside.shape) - 1)  # the grid's border is outside
        return np.asarray(self.inside[tuple(np.moveaxis(held, -1, 0))])

    def place_mm(self, index: Real[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3"]:
        return self.origin_mm + self.step_mm * index


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights over a square grid: node (i, j) is at origin + step (i, j)."""

    origin_mm: Float64[np.ndarray, " 2"]
    step_mm: float
    heights_mm: Float64[np.ndarray, "i j"]

    def nodes(self) -> Float64[np.ndarray, "i j 2"]:
        """Where its nodes are, x and y."""
        return self.origin_mm + self.step_mm * np.moveaxis(np.indices(self.heights_mm.shape), 0, -1)

    def at(self, points_mm: Float[np.ndarray, "*n k"]) -> Float64[np.ndarray, " *n"]:
        """Heights over points (x and y come first), bilinear."""
        index = np.moveaxis((points_mm[..., :2] - self.origin_mm) / self.step_mm, -1, 0)
        return ndimage.map_coordinates(self.heights_mm, index, order=1, mode="nearest")

    def solid(self, other_mm: Float[np.ndarray, "i j"] | float) -> Any:
        """What lies between it and a second height at each node, as a ``manifold3d.Manifold``."""
        import manifold3d

        here = self.heights_mm
        n, plane = np.arange(here.size).reshape(here.shape), self.nodes().reshape(-1, 2)
        a, b, c, d = (x.ravel() for x in (n[:-1, :-1], n[1:, :-1], n[1:, 1:], n[:-1, 1:]))
        floor = np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)])
        ring = np.concatenate([n[:-1, 0], n[-1, :-1], n[:0:-1, -1], n[0, :0:-1]])
        ahead, up = np.roll(ring, -1), here.size
        walls = [np.stack([ring, ahead, ahead + up], 1), np.stack([ring, ahead + up, ring + up], 1)]
        ends = (here + 0 * other_mm, here * 0 + other_mm)
        z = [np.minimum(*ends).ravel(), np.maximum(*ends).ravel()]
        vertices = np.concatenate([np.column_stack([plane, heights]) for heights in z])
        faces = np.concatenate([floor, floor[:, ::-1] + up, *walls]).astype(np.uint64)
        return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))


def parting_surface(cells: Cells) -> HeightField:
    """The membrane over the grid of a surface in the mold's frame, where the pull is z.

    A column that passes in and out of the organ several times is parted in that of its pieces
    which is nearest to where the membrane would be if they were one.
    """
    inside = cells.inside
    z = cells.origin_mm[2] + cells.step_mm[2] * np.arange(inside.shape[2])
    covered = inside.any(2)
    low = np.where(covered, z[inside.argmax(2)], -np.inf)
    high = np.where(covered, z[len(z) - 1 - inside[:, :, ::-1].argmax(2)], np.inf)
    heights = _membrane(np.full(low.shape, np.mean([low[covered], high[covered]])), low, high)
    steps = np.diff(inside.astype(np.int8), axis=2)
    for i, j in np.argwhere((steps > 0).sum(2) > 1):
        begins, ends = z[1:][steps[i, j] > 0], z[:-1][steps[i, j] < 0]
        near = np.maximum(begins - heights[i, j], heights[i, j] - ends).argmin()
        low[i, j], high[i, j] = begins[near], ends[near]
    heights = _membrane(heights, low, high)
    return HeightField(cells.origin_mm[:2], float(cells.step_mm[0]), heights)


def _membrane(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Least sum of squared steps between neighbours, free edges, each node between bounds: half way
    from its own to the widest of its neighbours'. On a steep wall it may so leave the silhouette by
    some tenths of a step, which spares a rough organ a jagged loop."""
    keep, free = np.minimum(_INSIDE_MM, (high - low) / 4), np.isinf(high)
    low, high = np.where(free, np.inf, low + keep), np.where(free, -np.inf, high - keep)
    low = (low + ndimage.grey_erosion(low, footprint=_CROSS)) / 2
    high = (high + ndimage.grey_dilation(high, footprint=_CROSS)) / 2
    low, high = np.where(free, -np.inf, low), np.where(free, np.inf, high)
    heights = np.clip(start, low, high)
    _relax(heights, low, high, 2 / (1 + np.pi / max(heights.shape)), 3000)  # a square's best factor
    return heights


def _relax(
    heights: np.ndarray, low: np.ndarray, high: np.ndarray, factor: float, sweeps: int
) -> None:
    """Projected successive over-relaxation in place, until nothing moves by a micrometre. Nodes
    take turns as a chessboard's colours."""
    whole = np.pad(heights, 1, mode="reflect")  # beyond the edge stands the node's own image
    here, white = whole[1:-1, 1:-1], np.indices(heights.shape).sum(0) % 2 == 0
    for _ in range(sweeps):
        most = 0.0
        for turn in (white, ~white):
            total = whole[:-2, 1:-1] + whole[2:, 1:-1] + whole[1:-1, :-2] + whole[1:-1, 2:]
            new = np.clip(here + factor * (total / 4 - here), low, high)
            new = np.where(turn, new, here)
            most = max(most, float(np.abs(new - here).max()))
            here[...] = new
            whole[[0, -1]], whole[:, [0, -1]] = whole[[2, -3]], whole[:, [2, -3]]
        if most < 1e-3:
            break
    heights[...] = here
