"""Meshes, cameras and slow references for the tests of rendering and simulation."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from tumortrack.core.geometry import rotation_onto
from tumortrack.core.types import Anatomy, Mesh


def sphere(radius_mm: float, center_mm: ArrayLike, subdivisions: int = 4) -> Mesh:
    """An icosphere with one vertex exactly on the side that faces the camera (-z)."""
    solid = trimesh.creation.icosphere(subdivisions, 1.0)
    turn = rotation_onto(solid.vertices[0], np.array([0.0, 0.0, -1.0]))
    return Mesh(radius_mm * solid.vertices @ turn.T + np.array(center_mm, float), solid.faces)


def ellipsoid(
    half_axes_mm: ArrayLike, center_mm: ArrayLike = (0, 0, 0), subdivisions: int = 4
) -> Mesh:
    unit = sphere(1.0, (0, 0, 0), subdivisions)
    return unit.with_vertices(
        unit.vertices_mm * np.array(half_axes_mm) + np.array(center_mm, float)
    )


def bumpy(radius_mm: float, center_mm: ArrayLike, subdivisions: int = 4) -> Mesh:
    """A ball with hills and valleys, parts of which hide others."""
    unit = sphere(1.0, (0, 0, 0), subdivisions)
    x, y, z = unit.vertices_mm.T
    radius = radius_mm * (1 + 0.18 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.12 * np.sin(7 * z))
    return unit.with_vertices(unit.vertices_mm * radius[:, None] + np.array(center_mm, float))


# The parts of ``anatomy()`` as half axes and centre: a kidney's size, tumors inside.
ELLIPSOIDS = (
    ((50, 28, 24), (0, 0, 0)),
    ((11, 11, 11), (24, 0, -8)),
    ((9, 12, 8), (-22, 3, 6)),
)


def anatomy(subdivisions: int = 4) -> Anatomy:
    return Anatomy(tuple(ellipsoid(*e, subdivisions) for e in ELLIPSOIDS))


def ray_hits(
    origin: np.ndarray, directions: np.ndarray, mesh: Mesh, slack: float = 0.0
) -> np.ndarray:
    """Every ray against every triangle (Moeller, Trumbore 1997): multiple t of the direction at
    the hit, (r, f), inf where it misses. ``slack`` widens the triangles."""
    a, b, c = (mesh.vertices_mm[mesh.faces[:, i]] for i in range(3))
    edge_1, edge_2, start = b - a, c - a, origin - a
    p = np.cross(directions[:, None], edge_2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / np.einsum("fk,rfk->rf", edge_1, p)
        u = np.einsum("fk,rfk->rf", start, p) * inverse
        q = np.cross(start, edge_1)
        v = (directions @ q.T) * inverse
        t = np.einsum("fk,fk->f", edge_2, q) * inverse
    hit = (u >= -slack) & (v >= -slack) & (u + v <= 1 + slack) & (t > 0)
    return np.where(hit, t, np.inf)


def winding_number(mesh: Mesh, points_mm: np.ndarray) -> np.ndarray:
    """1 inside a closed mesh, 0 outside: solid angles of all triangles (van Oosterom, Strackee
    1983), nothing shared with rays."""
    out = np.empty(len(points_mm))
    for begin in range(0, len(points_mm), 500):
        chunk = points_mm[begin : begin + 500, None].astype(float)
        a, b, c = (mesh.vertices_mm[mesh.faces[:, i]] - chunk for i in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
        above = np.einsum("pfk,pfk->pf", a, np.cross(b, c))
        dots = [np.einsum("pfk,pfk->pf", x, y) for x, y in ((a, b), (b, c), (c, a))]
        below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
        out[begin : begin + 500] = np.arctan2(above, below).sum(1) / (2 * np.pi)
    return out
