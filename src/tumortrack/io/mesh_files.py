"""Mesh files. PLY is written and read again by own code, as trimesh, which does the rest, is slow
to import."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path

import numpy as np

from tumortrack.core.errors import InputError, readable
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.store import read_file, writing
from tumortrack.core.types import Anatomy, Mesh

SUFFIXES = (".ply", ".stl", ".obj")
_LARGEST_FILE = 512 * 2**20  # bytes
_SILENT = logging.NullHandler()  # trimesh logs tracebacks of normals and textures that it skips
_SPACE, _STL_HEADER = b"SPACE=LPS", 80
_FACE = np.dtype([("corners", "u1"), ("indices", "<i4", 3)])  # in a PLY of ours


def read_mesh(path: Path) -> Mesh:
    """Read one triangle mesh (PLY, STL or OBJ) with equal vertices merged. Raises InputError:
    missing, too large, not a mesh, no triangles."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown mesh type. Allowed: {', '.join(SUFFIXES)}.")
    content = read_file(path, _LARGEST_FILE, "Reduce the mesh first.")
    vertices, faces = _own_ply(content) or _by_trimesh(content, path)
    if faces.ndim != 2 or len(faces) == 0 or len(vertices) == 0:
        raise InputError(f"{path} holds no triangles (an empty or damaged file).")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path} has triangles that name vertices it does not have (damaged).")
    # STL repeats each vertex: merge equal ones so that the surface can be closed.
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[faces]
    a, b, c = faces.T
    proper = (a != b) & (b != c) & (c != a)
    if not proper.any():
        raise InputError(f"{path} holds only triangles without area (a damaged file).")
    return Mesh(unique, faces[proper])


def _own_ply(content: bytes) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices and faces of what ``_ply`` wrote; None: something else."""
    counts = list(map(int, re.findall(rb"\nelement [a-z]+ (\d{1,9})\n", content[:400])))
    if len(counts) != 2 or not content.startswith(header := _ply_header(*counts)):
        return None
    start, end = len(header), len(header) + 12 * counts[0]
    if len(content) != end + _FACE.itemsize * counts[1]:
        return None
    vertices = np.frombuffer(content[start:end], "<f4").reshape(-1, 3)
    faces = np.frombuffer(content[end:], _FACE)
    return (vertices.astype(float), faces["indices"]) if (faces["corners"] == 3).all() else None


def _by_trimesh(content: bytes, path: Path) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    logging.getLogger("trimesh").addHandler(_SILENT)
    with readable(path, "cannot be read as a mesh"):
        loaded = trimesh.load_mesh(  # from memory, so that no texture that it names is opened
            io.BytesIO(content), path.suffix.lower()[1:], process=False, skip_materials=True
        )
        return np.asarray(loaded.vertices), np.asarray(loaded.faces)


def write_mesh(path: Path, mesh: Mesh) -> None:
    """Write a binary PLY or STL, by suffix, in mm. The header states ``SPACE=LPS`` for 3D Slicer,
    also for meshes in the camera frame, which Slicer shows as if it were the patient's. Raises
    StorageError: the disk refuses."""
    content = {".ply": _ply, ".stl": _stl}[path.suffix](mesh)
    with writing(path):
        path.write_bytes(content)


def _ply_header(vertices: int, faces: int) -> bytes:
    """Turk 1994, "The PLY Polygon File Format"."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {_SPACE.decode()}\n"
        f"element vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode()


def _ply(mesh: Mesh) -> bytes:
    faces = np.empty(len(mesh.faces), _FACE)
    faces["corners"], faces["indices"] = 3, mesh.faces
    vertices = mesh.vertices_mm.astype("<f4")
    return _ply_header(len(vertices), len(faces)) + vertices.tobytes() + faces.tobytes()


def _stl(mesh: Mesh) -> bytes:
    import trimesh
    from trimesh.exchange.stl import export_stl

    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    return _SPACE.ljust(_STL_HEADER, b"\0") + export_stl(solid)[_STL_HEADER:]


def write_anatomy(folder: Path, anatomy: Anatomy) -> None:
    """Write kidney.ply (or as the organ is named), tumor_1.ply, ... into a folder."""
    for name, part in zip(anatomy.names, anatomy.parts, strict=True):
        write_mesh(folder / f"{name}.ply", part)


def read_anatomy(folder: Path, organ_kind: Organ = KIDNEY) -> Anatomy:
    """Read what ``write_anatomy`` wrote. Raises InputError: no such organ, an unreadable mesh."""
    parts = [read_mesh(folder / f"{organ_kind.name}.ply")]
    while (path := folder / f"tumor_{len(parts)}.ply").exists():
        parts.append(read_mesh(path))
    return Anatomy(tuple(parts), organ_kind)
