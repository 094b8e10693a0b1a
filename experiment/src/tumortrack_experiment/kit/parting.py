"""How a mold comes off: the pull of least undercut, and a parting surface that follows the organ.

Along the pull every point of the organ's surface that can be seen from above or below comes free;
the rest is undercut. Between the halves lies a membrane: over the plane across the pull, the
surface of least slope, all squares added up (a harmonic function, flat far away) that passes
between the lowest and the highest point of the organ in every column. At the silhouette these two
meet, so that it meets the organ where visibility changes sides, however rough the organ is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy import ndimage

from tumortrack.core.compiled import numba
from tumortrack.core.geometry import perpendicular, triangles_of
from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import voxelise
from tumortrack.sense.render import Visibility

_FAR_MM = 50_000.0  # an eye from where the organ is seen as good as in parallel
_SEARCHED = 3000  # faces that stand for all in the search, drawn by their area
_COARSE = 400  # directions over the sphere's half: 7 degrees apart
_CAPS = np.radians([5.0, 2.5, 1.2])
_FLATTER = 0.01  # share of the surface that a pull along the shortest side is worth
_STEEP = np.sin(np.radians(25.0))  # between a pin and the parting surface
_COLUMN_MM = 0.2  # along the pull, of what is found in a column
_CROSS = ndimage.generate_binary_structure(2, 1)
_INSIDE_MM = 0.3  # that the membrane keeps from the organ's surface where it can


def undercut(
    mesh: Mesh, pull: Float[np.ndarray, " 3"], sight: Visibility, faces: np.ndarray | None = None
) -> Bool[np.ndarray, " f"]:
    """Which faces (all, or those named) neither half's pull lays open, ``pull`` or against it."""
    corners = mesh.faces if faces is None else mesh.faces[faces]
    middle, area = triangles_of(mesh.vertices_mm, corners)
    up = area @ pull > 0
    hidden = np.zeros(len(corners), bool)
    for side, way in ((up, pull), (~up, -pull)):
        eye = mesh.box_mm.mean(0) + _FAR_MM * way
        hidden[side] = ~sight(middle[side], eye)
    return hidden


def directions(n: int) -> Float64[np.ndarray, "n 3"]:
    """Unit vectors evenly over the sphere (a Fibonacci lattice), those with z > 0 first."""
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + np.sqrt(5)) * i
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def best_pull(
    mesh: Mesh, pins: Float[np.ndarray, "p 3"] | None = None
) -> Float64[np.ndarray, " 3"]:
    """The direction of least undercut; of nearly equal ones that along which it is shortest. The
    ``pins`` are unit vectors that should not lie in the plane across it."""
    sight, rng = Visibility(mesh), np.random.default_rng(0)
    area = np.linalg.norm(triangles_of(mesh.vertices_mm, mesh.faces)[1], axis=1)
    some = rng.choice(len(area), min(_SEARCHED, 4 * len(area)), p=area / area.sum())
    longest = mesh.longest_mm

    def cost(pull: np.ndarray) -> float:
        length = np.ptp(mesh.vertices_mm @ pull) / longest
        flat = 0.0 if pins is None else max(_STEEP - np.abs(pins @ pull).min(), 0)
        return float(undercut(mesh, pull, sight, some).mean() + _FLATTER * length + flat)

    best = min(directions(2 * _COARSE)[:_COARSE], key=cost)
    for cap in _CAPS:
        across = perpendicular(best)
        along = np.cross(best, across)
        turns = np.arange(12) * np.pi / 6
        tilts = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * along
        best = min([best, *(np.cos(cap) * best + np.sin(cap) * tilts)], key=cost)
    return best / np.linalg.norm(best)


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights over a square grid of the mold's frame: node (i, j) is at origin + step (i, j)."""

    origin_mm: Float64[np.ndarray, " 2"]
    step_mm: float
    heights_mm: Float64[np.ndarray, "i j"]

    def nodes(self) -> Float64[np.ndarray, "i j 2"]:
        """Where its nodes are, x and y."""
        i, j = np.indices(self.heights_mm.shape)
        return self.origin_mm + self.step_mm * np.stack([i, j], axis=-1)

    def at(self, points_mm: Float[np.ndarray, "n 2"]) -> Float64[np.ndarray, " n"]:
        """Heights over points, bilinear."""
        index = (np.atleast_2d(points_mm)[:, :2] - self.origin_mm) / self.step_mm
        return ndimage.map_coordinates(self.heights_mm, index.T, order=1, mode="nearest")

    def solid(self, other_mm: Float[np.ndarray, "i j"] | float) -> Any:
        """What lies between it and a second height at each node, as a ``manifold3d.Manifold``."""
        import manifold3d

        here = self.heights_mm
        low, high = np.minimum(here, other_mm), np.maximum(here, other_mm)
        plane = self.nodes().reshape(-1, 2)
        n = np.arange(here.size).reshape(here.shape)
        a, b, c, d = (n[i, j].ravel() for i, j in _CORNERS)
        top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        ring = np.concatenate([n[:-1, 0], n[-1, :-1], n[:0:-1, -1], n[0, :0:-1]])
        ahead = np.roll(ring, -1)
        walls = [np.stack([ring, ahead, ahead + n.size], 1)]
        walls.append(np.stack([ring, ahead + n.size, ring + n.size], 1))
        faces = np.concatenate([top + n.size, top[:, ::-1], *walls])
        vertices = np.concatenate([np.c_[plane, low.ravel()], np.c_[plane, high.ravel()]])
        return manifold3d.Manifold(manifold3d.Mesh64(vertices, faces.astype(np.uint64)))


_CORNERS = (
    (slice(None, -1), slice(None, -1)),
    (slice(1, None), slice(None, -1)),
    (slice(1, None), slice(1, None)),
    (slice(None, -1), slice(1, None)),
)


def parting_surface(
    mesh: Mesh, margin_mm: float, step_mm: float = 1.0
) -> tuple[HeightField, HeightField]:
    """The parting surface of a closed mesh in the mold's frame (pull is +z), out to ``margin_mm``
    beyond its box, and the organ's highest point over each node (-inf where there is none).

    A column that passes in and out of the organ several times is parted where the membrane would
    be without it: in the piece that is nearest.
    """
    low, high = mesh.box_mm
    origin = low[:2] - margin_mm
    shape = np.ceil((high[:2] + margin_mm - origin) / step_mm).astype(int) + 1
    frame = np.diag([step_mm, step_mm, _COLUMN_MM, 1.0])
    frame[:3, 3] = *origin, low[2] - _COLUMN_MM
    deep = int(np.ceil((high[2] - low[2]) / _COLUMN_MM)) + 3
    inside = voxelise(mesh, frame, (int(shape[0]), int(shape[1]), deep))
    covered = inside.any(2)
    z = frame[2, 3] + _COLUMN_MM * np.arange(deep)
    roof = np.where(covered, z[deep - 1 - inside[:, :, ::-1].argmax(2)], -np.inf)
    lowest = np.where(covered, z[inside.argmax(2)], -np.inf)
    highest = np.where(covered, roof, np.inf)
    start = np.full(covered.shape, (lowest[covered].mean() + highest[covered].mean()) / 2)
    heights = _membrane(start, lowest, highest)
    # Again, in each column within the piece of the organ that is nearest to the first answer.
    steps = np.diff(inside.astype(np.int8), axis=2)
    for i, j in np.argwhere((steps > 0).sum(2) > 1):
        begins = z[1:][steps[i, j] > 0]
        ends = z[:-1][steps[i, j] < 0]
        far = np.maximum(begins - heights[i, j], heights[i, j] - ends)
        lowest[i, j], highest[i, j] = begins[far.argmin()], ends[far.argmin()]
    heights = _membrane(heights, lowest, highest)
    return HeightField(origin, step_mm, heights), HeightField(origin, step_mm, roof)


def _membrane(start: np.ndarray, lowest: np.ndarray, highest: np.ndarray) -> np.ndarray:
    """Least sum of squared steps between neighbours, free edges, each node between two bounds or
    those of a neighbour: on a steep wall it may so leave the silhouette by a step at most, which
    spares a rough organ a jagged loop."""
    keep = np.minimum(_INSIDE_MM, (highest - lowest) / 4)
    free = np.isinf(highest)
    lowest = ndimage.grey_erosion(np.where(free, np.inf, lowest + keep), footprint=_CROSS)
    highest = ndimage.grey_dilation(np.where(free, -np.inf, highest - keep), footprint=_CROSS)
    lowest, highest = np.where(free, -np.inf, lowest), np.where(free, np.inf, highest)
    heights = np.clip(start, lowest, highest)
    _relax(heights, lowest, highest, 1.0, 20)
    relaxation = 2 / (1 + np.pi / max(heights.shape))  # the best one of a plain square
    _relax(heights, lowest, highest, relaxation, 3000)
    return heights


@numba.njit(cache=True, nogil=True)
def _relax(h, low, high, factor, sweeps):  # type: ignore[no-untyped-def]
    """Projected successive over-relaxation in place, until nothing moves by a micrometre."""
    ni, nj = h.shape
    for _ in range(sweeps):
        most = 0.0
        for i in range(ni):
            for j in range(nj):
                total, n = 0.0, 0
                if i > 0:
                    total += h[i - 1, j]
                    n += 1
                if i + 1 < ni:
                    total += h[i + 1, j]
                    n += 1
                if j > 0:
                    total += h[i, j - 1]
                    n += 1
                if j + 1 < nj:
                    total += h[i, j + 1]
                    n += 1
                new = h[i, j] + factor * (total / n - h[i, j])
                new = min(max(new, low[i, j]), high[i, j])
                most = max(most, abs(new - h[i, j]))
                h[i, j] = new
        if most < 1e-3:
            break


def peaks(mesh: Mesh, heights_mm: Float[np.ndarray, " v"], prominence_mm: float) -> list[int]:
    """Vertices that are local maxima of a height and rise by ``prominence_mm`` at least above the
    saddle to a higher one; the highest first. Of surfaces seen from within: where air gathers."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    order = np.argsort(-heights_mm, kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    edges = edges[np.argsort(rank[edges].max(1), kind="stable")]
    parent, top = np.arange(len(order)), np.arange(len(order))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = int(parent[vertex])
        return vertex

    keep = {int(order[0])}
    for a, b in edges.tolist():
        one, two = root(a), root(b)
        if one == two:
            continue
        if rank[top[one]] > rank[top[two]]:
            one, two = two, one
        saddle = min(heights_mm[a], heights_mm[b])
        if heights_mm[top[two]] - saddle >= prominence_mm:
            keep.add(int(top[two]))
        parent[two] = one
    return sorted(keep, key=lambda v: rank[v])
