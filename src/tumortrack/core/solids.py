"""Meshes as solids that can be united: Manifold, imported where it is used."""

from __future__ import annotations

from typing import Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh


def solid_of(mesh: Mesh, name: str) -> Any:
    """A closed mesh as a ``manifold3d.Manifold``; ``name`` stands in the error.

    Raises:
        InputError: open, crossing itself beyond use, or inside out.
    """
    import manifold3d

    raw = manifold3d.Mesh64(mesh.vertices_mm.copy(), mesh.faces.astype(np.uint64))
    solid = manifold3d.Manifold(raw)
    if solid.status() != manifold3d.Error.NoError or solid.volume() <= 0:
        raise InputError(
            f"{name} is not a closed surface with faces turned outward "
            f"({solid.status().name}). Repair the mesh and try again."
        )
    return solid


def mesh_of(solid: Any) -> Mesh:
    """A ``manifold3d.Manifold``'s surface, faces outward."""
    out = solid.to_mesh64()
    return Mesh(out.vert_properties[:, :3], out.tri_verts)
