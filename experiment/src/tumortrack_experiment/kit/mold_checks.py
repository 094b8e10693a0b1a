"""What is measured on a mold's printed parts, as they are."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.types import Mesh
from tumortrack.report.metrics import distance_to_surface
from tumortrack_experiment.kit.casting import Halves, Layout

_STEPS_MM = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # of a part that is pulled off
_RAYS = 4000
LINES_MM = 1.2  # three lines of a nozzle of 0.4 mm: thinner walls break
_TOUCH_MM = 0.05


def open_edges(mesh: Mesh) -> int:
    """Edges without two faces once a part was written as STL (single precision, no shared corners)
    and read again; 0: closed."""
    import trimesh
    from trimesh.exchange.stl import export_stl

    data = export_stl(trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False))
    again = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    again.merge_vertices()
    _, counts = np.unique(again.edges_sorted, axis=0, return_counts=True)
    return int((counts % 2 != 0).sum())


def thin_share(mesh: Mesh) -> float:
    """Share of a solid's surface with less than 1.2 mm of it behind."""
    return float((_depths(mesh)[2] < LINES_MM).mean())


def walls(mesh: Mesh, layout: Layout) -> tuple[float, float]:
    """Least thickness of a half's wall between cavity and outside, mm, and ``thin_share``."""
    start, ends, deep = _depths(mesh)
    outside = layout.beyond(ends) > -_TOUCH_MM
    sides = np.abs(ends[:, 2, None] - [layout.top_mm, layout.bottom_mm])
    outside |= sides.min(1) < _TOUCH_MM
    cavity = distance_to_surface(start, layout.mesh) < _TOUCH_MM
    return float(deep[outside & cavity].min(initial=np.inf)), float((deep < LINES_MM).mean())


def _depths(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays evenly over a solid's surface and square to it: where each starts and ends, and how
    long it is in the solid, mm."""
    import trimesh

    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(solid, _RAYS, seed=0)
    inward = -solid.face_normals[face]
    ends, ray, _ = solid.ray.intersects_location(points + 1e-3 * inward, inward, False)
    return points[ray], ends, np.linalg.norm(ends - points[ray], axis=1)


def demould(part: Any, organ: Any, organ_mesh: Mesh, pull: Float64[np.ndarray, " 3"]) -> float:
    """How far the cast must yield, mm, while a part (both ``manifold3d.Manifold``) is moved along
    its pull in steps: its deepest point in the organ, which stays as it was."""
    met = [part.translate((step * pull).tolist()) ^ organ for step in _STEPS_MM]
    points = np.concatenate([solid.to_mesh64().vert_properties[:, :3] for solid in met])
    return float(distance_to_surface(points, organ_mesh).max(initial=0.0))


def cast_error(halves: Halves, organ: Any) -> tuple[float, float]:
    """What the closed mold casts, mm3, and by how much of space it differs from the organ: what the
    halves leave of their block, less what stands in the holes of their walls."""
    hollow = halves.block - halves.upper - halves.lower - (halves.channels - organ)
    cast = max(hollow.decompose(), key=lambda solid: solid.volume())
    return float(cast.volume()), float((cast - organ).volume() + (organ - cast).volume())
