"""Surfaces to draw of what was located and planned: organ, tumors, the piece that comes away."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.errors import InputError
from tumortrack.core.types import ORGAN, Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.imaging.raster import voxelise
from tumortrack.plan.values import Cut, CutLayer, Located

_BLUR = 1.2  # cells: bridges the gaps between points strewn at random
_INSIDE = 0.75  # quantile of the density at the points: those near the surface have less
_FEWEST, _MOST_CELLS = 8, 60  # points of a part; cells along its longest side
_CELL_MM = 1.0  # in which a stroke is said to be in the organ


def organ_surfaces(located: Located) -> dict[int, Mesh]:
    """By label 1 (the whole organ, tumors included), 2, ...: closed surfaces, table frame, mm.
    Of a bare cloud they are the skin of its points.

    Raises:
        InputError: neither meshes nor enough points.
    """
    if "kidney" in located.meshes:
        names = {"kidney": ORGAN} | {f"tumor_{n - 1}": n for n in range(2, 256)}
        return {names[name]: mesh for name, mesh in located.meshes.items() if name in names}
    clouds = {ORGAN: located.points_mm} | {n: located.of(n) for n in located.tumors}
    return {label: skin(np.asarray(points, float)) for label, points in clouds.items()}


def skin(points_mm: Float[np.ndarray, "n 3"]) -> Mesh:
    """The closed surface around points strewn evenly through a body.

    A level of the points' blurred density: the one that holds all of them at the density that
    there is inside.

    Raises:
        InputError: too few points.
    """
    from scipy.ndimage import gaussian_filter
    from skimage.measure import marching_cubes

    if len(points_mm) < _FEWEST:
        raise InputError(f"{len(points_mm)} points are too few to draw a part of the organ.")
    low, size = points_mm.min(0), np.ptp(points_mm, axis=0)
    # About two points a cell, if they fill an ellipsoid.
    cell = (2 * np.pi / 6 * np.prod(np.maximum(size, 1.0)) / len(points_mm)) ** (1 / 3)
    cell = max(cell, size.max() / _MOST_CELLS)
    low = low - 4 * cell
    edges = [low[d] + cell * np.arange(np.ceil(size[d] / cell) + 9) for d in range(3)]
    counts, _ = np.histogramdd(points_mm, edges)
    density = gaussian_filter(counts, _BLUR, mode="constant")
    inside = np.quantile(density[tuple(((points_mm - low) / cell).astype(int).T)], _INSIDE)
    ranked, cells = np.sort(density, axis=None), round(len(points_mm) / inside)
    level = float(ranked[-cells - 1 : -cells + 1].mean())  # of no cell: corners would coincide
    vertices, faces, _, _ = marching_cubes(density, level, gradient_direction="ascent")
    mesh = Mesh(low + cell * (vertices + 0.5), faces)
    return mesh if mesh.volume_mm3 > 0 else Mesh(mesh.vertices_mm, mesh.faces[:, ::-1])


def parted(organ: Mesh, layers: tuple[CutLayer, ...]) -> tuple[Mesh, Mesh]:
    """The piece that comes away, and what stays."""
    import manifold3d

    solid = solid_of(organ, "the located organ")
    above_mm = organ.box_mm[1, 2] + 1.0
    slabs = []
    for layer in layers:
        area = manifold3d.CrossSection(list(layer.rings_mm), manifold3d.FillRule.NonZero)
        height = min(layer.top_mm, above_mm) - layer.bottom_mm
        if height > 0:
            slabs.append(area.extrude(height).translate((0.0, 0.0, layer.bottom_mm)))
    taken = manifold3d.Manifold.batch_boolean(slabs, manifold3d.OpType.Add)
    return mesh_of(solid ^ taken), mesh_of(solid - taken)


def within(cut: Cut, organ: Mesh) -> Bool[np.ndarray, " n"]:
    """Which points of a stroke lie in the organ."""
    low, high = cut.path_mm.min(0) - _CELL_MM, cut.path_mm.max(0) + _CELL_MM
    way = np.diag([_CELL_MM, _CELL_MM, _CELL_MM, 1.0])
    way[:3, 3] = low
    nx, ny, nz = (np.ceil((high - low) / _CELL_MM).astype(int) + 1).tolist()
    grid = voxelise(organ, way, (nx, ny, nz))
    return grid[tuple(np.rint((cut.path_mm - low) / _CELL_MM).astype(int).T)]
