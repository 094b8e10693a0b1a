"""What a plan does to the organ, to be drawn: the piece, the rest, strokes in tissue."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.imaging.raster import voxelise
from tumortrack.plan.values import Cut, CutLayer

_INSIDE_MM = 1.0  # cells in which a stroke is said to be in the organ


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
    low, high = cut.path_mm.min(0) - _INSIDE_MM, cut.path_mm.max(0) + _INSIDE_MM
    way = np.diag([_INSIDE_MM, _INSIDE_MM, _INSIDE_MM, 1.0])
    way[:3, 3] = low
    nx, ny, nz = (np.ceil((high - low) / _INSIDE_MM).astype(int) + 1).tolist()
    grid = voxelise(organ, way, (nx, ny, nz))
    return grid[tuple(np.rint((cut.path_mm - low) / _INSIDE_MM).astype(int).T)]
