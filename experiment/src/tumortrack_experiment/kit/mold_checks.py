"""What is measured on printed parts of a mold: every number on the parts themselves."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from tumortrack.core.geometry import triangles_of
from tumortrack.core.types import Mesh

_STEPS_MM = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # of a part that is pulled off
_RAYS = 4000
_LINES_MM = 1.2  # three lines of a nozzle of 0.4 mm: thinner walls break
_NEAREST = 12  # triangles tried for the distance to a surface


def open_edges(mesh: Mesh) -> int:
    """Edges that do not have two faces once the part was written as STL (single precision, corners
    without numbers) and read again; 0: closed."""
    import trimesh

    data = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(file_type="stl")
    again = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    again.merge_vertices()
    again.update_faces(again.nondegenerate_faces(height=None))
    _, counts = np.unique(again.edges_sorted, axis=0, return_counts=True)
    return int((counts % 2 != 0).sum())


def behind_mm(mesh: Mesh, rays: int = _RAYS) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Points all over a closed surface (n, 3), evenly by area, and how much of the solid lies
    behind each, at right angles to the surface."""
    import trimesh

    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(solid, rays, seed=0)
    inward = -solid.face_normals[face]
    start = points + 1e-3 * inward
    hit, ray, _ = solid.ray.intersects_location(start, inward, multiple_hits=False)
    deep = np.full(len(points), np.inf)
    deep[ray] = np.linalg.norm(hit - start[ray], axis=1) + 1e-3
    return points, deep


def thin_share(deep_mm: Float[np.ndarray, " n"]) -> float:
    """Share of a part's surface with less than three lines of plastic behind it."""
    return float((deep_mm < _LINES_MM).mean())


def distance_mm(points_mm: Float[np.ndarray, "n 3"], mesh: Mesh) -> Float64[np.ndarray, " n"]:
    """From points to a surface of small triangles, exact among the twelve nearest triangles."""
    from trimesh.triangles import closest_point

    corners = mesh.vertices_mm[mesh.faces]
    _, near = cKDTree(corners.mean(1)).query(points_mm, min(_NEAREST, len(corners)))
    repeated = np.repeat(points_mm[:, None], near.shape[1], axis=1).reshape(-1, 3)
    touched = closest_point(corners[near.ravel()], repeated)
    return np.linalg.norm(touched - repeated, axis=1).reshape(near.shape).min(1)


@dataclass(frozen=True)
class Demoulding:
    """How far the cast must yield while a part is pulled off, and the most of it at once."""

    depth_mm: float
    volume_mm3: float


def demould(part: Any, organ: Any, organ_mesh: Mesh, pull: Float[np.ndarray, " 3"]) -> Demoulding:
    """Move a part (``manifold3d.Manifold``) along its pull in steps and intersect it with the cast
    as it was: rigid, so that a cast that yields gives less."""
    depth, most = 0.0, 0.0
    for step in _STEPS_MM:
        met = part.translate((step * pull).tolist()) ^ organ
        most = max(most, float(met.volume()))
        points = met.to_mesh64().vert_properties[:, :3]
        if len(points):
            depth = max(depth, float(distance_mm(points, organ_mesh).max()))
    return Demoulding(depth, most)


def cast_solid(block: Any, parts: list[Any], channels: Any, organ: Any) -> tuple[float, float]:
    """Volume that is filled in the closed mold without what stands in the channels' walls, and the
    part of space in which it differs from the organ; mm3. Play round keys is not filled."""
    import manifold3d

    void = block - manifold3d.Manifold.batch_boolean(parts, manifold3d.OpType.Add)
    filled = max(void.decompose(), key=lambda piece: piece.volume())
    cast = filled - (channels - organ)
    return float(cast.volume()), float((cast - organ).volume() + (organ - cast).volume())


def area_mm2(mesh: Mesh) -> Float64[np.ndarray, " f"]:
    """Of each face."""
    return np.linalg.norm(triangles_of(mesh.vertices_mm, mesh.faces)[1], axis=1) / 2
