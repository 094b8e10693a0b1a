"""Closed meshes as solids, and back: ``manifold3d.Manifold``, which cuts and joins them."""

from __future__ import annotations

from typing import Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh


def solid_of(mesh: Mesh, name: str) -> Any:
    """A closed mesh as a ``manifold3d.Manifold``. Raises InputError, which names ``name``: it is
    open, crosses itself too much, or is inside out."""
    import manifold3d

    raw = manifold3d.Mesh64(mesh.vertices_mm.copy(), mesh.faces.astype(np.uint64))
    solid = manifold3d.Manifold(raw)
    if (status := solid.status()) != manifold3d.Error.NoError or solid.volume() <= 0:
        what = f"is no closed surface with faces outward ({status.name})"
        raise InputError(f"{name} {what}. Repair it.")
    return solid


def mesh_of(solid: Any) -> Mesh:
    """A ``manifold3d.Manifold``'s surface, faces outward."""
    out = solid.to_mesh64()
    return Mesh(out.vert_properties[:, :3], out.tri_verts)
