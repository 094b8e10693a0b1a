"""Least-squares rigid transforms between points, or between bodies, with known correspondence."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine, Points, rigid, transform_points
from tumortrack.core.types import Mesh

# Barycentric quadrature points of a tetrahedron, exact for quadratics (Keast 1986, 4 points)
_ROUNDED_MM = 1e-3  # coordinates of 200 mm in single precision are right to 1e-5
_NEAR, _FAR = 0.1381966011250105, 0.5854101966249685


def kabsch(source_mm: Points, target_mm: Points, weights: Float[np.ndarray, " n"]) -> Affine:
    """The weighted least-squares rigid transform from source to target points (Kabsch 1976,
    doi 10.1107/S0567739476001873)."""
    share = weights / weights.sum()
    source_centre, target_centre = share @ source_mm, share @ target_mm
    spread = (source_mm - source_centre).T @ (share[:, None] * (target_mm - target_centre))
    u, _, vt = np.linalg.svd(spread)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ mirror @ u.T
    return rigid(rotation, target_centre - rotation @ source_centre)


def matched_vertices(rest: Mesh, moved: Mesh) -> Float64[np.ndarray, "_ 3"]:
    """The place in ``moved`` of each vertex of ``rest``, by triangles: reading a mesh merges and
    reorders vertices but keeps the order of triangles. Raises InputError: it has others."""
    vertex = np.full(len(rest.vertices_mm), -1)
    before, after = rest.faces, moved.faces
    if len(before) != len(after):
        before, after = (_wide_faces(mesh) for mesh in (rest, moved))
    same = before.shape == after.shape
    if same:
        vertex[before.reshape(-1)] = after.reshape(-1)
        off_mm = moved.vertices_mm[vertex[before]] - moved.vertices_mm[after]
        same = bool((vertex >= 0).all() and np.abs(off_mm).max() < _ROUNDED_MM)
    if not same:
        raise InputError(
            "the scene's surfaces must have the same triangles as the case's; compare scenes that "
            "were made from this case."
        )
    return moved.vertices_mm[vertex]


def _wide_faces(mesh: Mesh) -> Int[np.ndarray, "m 3"]:
    """Faces but those so thin that rounding may make them a line, which reading then drops."""
    corners = mesh.vertices_mm[mesh.faces]
    edges_mm = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return mesh.faces[edges_mm.min(1) > _ROUNDED_MM]


def fit_over_volume(source: Mesh, target: Mesh) -> tuple[Affine, float]:
    """``target_from_source`` with the least squared residual displacement over the source's volume,
    and the root of its mean square, mm. Exact if the displacement is linear in each tetrahedron of
    a triangle and the vertices' mean."""
    from_mm, weights = _volume_points(source, source)
    to_mm, _ = _volume_points(source, target)
    transform = kabsch(from_mm, to_mm, weights)
    left2 = ((transform_points(transform, from_mm) - to_mm) ** 2).sum(1)
    return transform, float(np.sqrt(max(np.average(left2, weights=weights), 0.0)))


def _volume_points(
    rest: Mesh, moved: Mesh
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Quadrature points of ``moved``, and their signed weights from ``rest``."""
    corners = rest.vertices_mm[rest.faces] - rest.vertices_mm.mean(0)
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    apex = np.broadcast_to(moved.vertices_mm.mean(0), (len(volume), 1, 3))
    tetrahedra = np.concatenate([apex, moved.vertices_mm[moved.faces]], axis=1)
    shares = np.full((4, 4), _NEAR) + (_FAR - _NEAR) * np.eye(4)
    points = np.einsum("qc,tcx->tqx", shares, tetrahedra).reshape(-1, 3)
    return points, np.repeat(volume / 4, 4)
