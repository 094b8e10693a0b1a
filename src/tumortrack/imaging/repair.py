"""Closed, outward, uncrossed meshes, or a clear refusal."""

from __future__ import annotations

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import winding_numbers
from tumortrack.imaging.winding import grid_round, is_simple

_LARGEST_HOLE_MM = 10.0  # across; larger ones would invent anatomy
_LARGEST_REMESH = 1.5  # change of volume that a remesh may make, as a ratio


def closed_mesh(mesh: Mesh, name: str, notes: list[str]) -> Mesh:
    """Repair what can be repaired safely; every change adds a note that names the file.

    Doubled faces go, small holes (up to 10 mm across) are closed, faces are turned outward, and
    a mesh that crosses itself is remeshed from its winding numbers.

    Raises:
        InputError: open beyond that, or not a surface.
    """
    import trimesh

    size = float(np.ptp(mesh.box_mm, axis=0).max())
    if not size > 0:
        raise InputError(f"{name} has no extent; it is damaged.")
    faces = _unique_faces(mesh.faces)
    if doubled := len(mesh.faces) - len(faces):
        notes.append(f"{name}: {doubled} doubled faces removed")
    out = Mesh(mesh.vertices_mm, faces)
    work = trimesh.Trimesh(out.vertices_mm, out.faces, process=False)
    if not work.is_winding_consistent:
        trimesh.repair.fix_winding(work)
        notes.append(f"{name}: faces turned the same way round")
        out = Mesh(out.vertices_mm, np.asarray(work.faces))
    out = _close_holes(out, name, notes)
    if not trimesh.Trimesh(out.vertices_mm, out.faces, process=False).is_watertight:
        raise InputError(
            f"{name} is not a closed surface (edges with one or more than two faces). Repair it, "
            "for instance with Blender's 3D-Print toolbox, or give a label map."
        )
    if out.volume_mm3 < 0:
        out = Mesh(out.vertices_mm, out.faces[:, ::-1])
        notes.append(f"{name}: it was inside out; faces turned outward")
    if abs(out.volume_mm3) < 1e-9 * size**3:
        raise InputError(f"{name} encloses no volume; it is no solid.")
    if not is_simple(out, size / 80):
        out = _remesh(out, name, size)
        notes.append(f"{name}: it crossed itself; remeshed at {size / 120:.2g} mm")
    return out


def _unique_faces(faces: np.ndarray) -> np.ndarray:
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return faces[np.sort(first)]


def _close_holes(mesh: Mesh, name: str, notes: list[str]) -> Mesh:
    """Fan every boundary loop from its centre, if all are small."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    codes = edges[:, 0].astype(np.int64) * len(mesh.vertices_mm) + edges[:, 1]
    back = edges[:, 1].astype(np.int64) * len(mesh.vertices_mm) + edges[:, 0]
    border = edges[~np.isin(codes, back)]
    if len(border) == 0:
        return mesh
    following = {int(a): int(b) for a, b in border}
    if len(following) != len(border):
        raise InputError(f"{name} has holes that meet in one point; repair the mesh first.")
    vertices, faces, widest, n_loops = [mesh.vertices_mm], [mesh.faces], 0.0, 0
    while following:
        loop = [next(iter(following))]
        while (ahead := following.pop(loop[-1], None)) is not None and ahead != loop[0]:
            loop.append(ahead)
        if ahead is None:
            raise InputError(f"{name} has a border that does not close; repair the mesh first.")
        ring = mesh.vertices_mm[loop]
        widest = max(widest, float(np.ptp(ring, axis=0).max()))
        centre = len(mesh.vertices_mm) + n_loops
        vertices.append(ring.mean(0, keepdims=True))
        # The border runs as its faces do; the new ones run against it.
        faces.append(
            np.array([[b, a, centre] for a, b in zip(loop, [*loop[1:], loop[0]], strict=True)])
        )
        n_loops += 1
    if widest > _LARGEST_HOLE_MM:
        raise InputError(
            f"{name} is open: {n_loops} holes, the widest {widest:.1f} mm (up to "
            f"{_LARGEST_HOLE_MM:g} mm are closed). Close the mesh, or give a label map."
        )
    notes.append(f"{name}: {n_loops} holes closed, the widest {widest:.1f} mm")
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def _remesh(mesh: Mesh, name: str, size: float) -> Mesh:
    """March the region of positive winding number: crossings and inner walls vanish."""
    from tumortrack.core.types import LabelVolume
    from tumortrack.imaging.surface import surfaces

    step = size / 120
    affine, shape = grid_round(mesh.box_mm, step, 4 * step)
    inside = winding_numbers(mesh, affine, shape) > 0
    if not inside.any():
        raise InputError(f"{name} crosses itself and encloses nothing; repair it first.")
    out = surfaces(LabelVolume(inside.astype(np.uint8), affine))[0].organ
    ratio = out.volume_mm3 / mesh.volume_mm3
    if not 1 / _LARGEST_REMESH < ratio < _LARGEST_REMESH:
        raise InputError(f"{name} crosses itself too much to be repaired; repair it first.")
    return out
