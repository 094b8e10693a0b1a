"""Anatomy from a folder of surface meshes (STL, OBJ, PLY), repaired where that is safe."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tumortrack.case.options import MIN_TUMOR_ML
from tumortrack.case.surface import largest_shell, shells, surface_of
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS, transform_points
from tumortrack.core.grid import grid_round
from tumortrack.core.organ import KIDNEY, Organ
from tumortrack.core.raster import winding_numbers
from tumortrack.core.report import Finding, Note
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.store import natural
from tumortrack.core.types import FIRST_TUMOR, ORGAN, Anatomy, LabelVolume, Mesh, part_names
from tumortrack.io.mesh_files import SUFFIXES, read_mesh
from tumortrack.io.segments import is_tumor

LEAST_DROPPED_ML = 0.05  # that is said of a piece alone
_ORGAN_MM = (15.0, 600.0)  # plausible longest extent
_VOXEL_MM = 1.0
_MOST_TUMORS = 254  # labels 2 to 255
_LARGEST_HOLE_MM = 10.0  # to close a larger one would invent anatomy
_LARGEST_REMESH = 1.5  # ratio by which a remesh may change the volume
_RULE = (
    "The rule: one file whose name contains {} or organ is the organ; names with tumor, lesion, "
    "mass or the like are tumors, in order of name."
)


def read_meshes(
    paths: Sequence[Path],
    unit: str | None = None,
    organ_kind: Organ = KIDNEY,
    min_tumor_ml: float = MIN_TUMOR_ML,
) -> tuple[Anatomy, list[Note]]:
    """Read one organ and its tumors, LPS mm, from the meshes among files; and notes on every
    change.

    ``unit``: None is mm; metres are then recognised and refused. The organ becomes the union of
    organ and tumors; each piece of a tumor's file is a tumor. Raises InputError: unclear names,
    open or damaged meshes, wrong unit, a tumor apart from the organ."""
    if unit not in (None, "mm", "m"):
        raise InputError(f"unit {unit!r} is not allowed: mm or m.")
    files = _files_by_name(paths, organ_kind.name)
    notes: list[Note] = []
    meshes = [read_lps(file, 1000.0 if unit == "m" else 1.0, notes) for file in files]
    _check_unit(files[0], meshes[0], unit)
    parts: list[Mesh] = []
    for file, mesh in zip(files, meshes, strict=True):
        # Without walls of cavities, such as one that was cut out for an inner tumor
        bodies = [b for b in shells(closed_mesh(mesh, file.name, notes)) if b.volume_mm3 > 0]
        kept = bodies[:1]
        kept += [b for b in bodies[1:] if len(parts) and b.volume_ml >= min_tumor_ml]
        notes += _dropped(file.name, [body.volume_ml for body in bodies[len(kept) :]])
        first, last = len(parts), len(parts) + len(kept) - 1
        names = part_names(last + 1, organ_kind.name)
        notes.append(f"{file.name} is {' to '.join(dict.fromkeys([names[first], names[last]]))}")
        parts += kept
    if len(parts) - 1 > _MOST_TUMORS:
        raise InputError(f"{len(parts) - 1} tumors; up to {_MOST_TUMORS} are read.")
    for number, tumor in enumerate(parts[1:], 1):
        parts[0] = _union(parts[0], tumor, f"tumor_{number}")
    if len(parts) == 1:
        notes.append("no tumor in these files")
    return Anatomy(tuple(parts), organ_kind), notes


def _dropped(name: str, pieces_ml: list[float]) -> list[Note]:
    specks = [ml for ml in pieces_ml if ml < LEAST_DROPPED_ML]
    large = [Finding("dropped", {"what": name, "ml": ml}) for ml in pieces_ml if ml not in specks]
    words = f"{name}: {len(specks)} specks of together {sum(specks):.3f} ml dropped"
    return [*large, words] if specks else [*large]


def label_meshes(anatomy: Anatomy) -> LabelVolume:
    """Label the voxels of an LPS-aligned grid whose centres the parts contain; tumors win."""
    lps_from_index, shape = grid_round(anatomy.organ.box_mm, _VOXEL_MM, 8.0)
    labels = np.zeros(shape, np.uint8)
    for number, part in enumerate(anatomy.parts, ORGAN):
        labels[winding_numbers(part, lps_from_index, shape) > 0] = number
    for number in range(FIRST_TUMOR, len(anatomy.parts) + 1):
        if not (labels == number).any():
            raise InputError(f"tumor {number - 1} fills no {_VOXEL_MM:g} mm cell: too small.")
    return LabelVolume(labels, lps_from_index)


def _files_by_name(paths: Sequence[Path], organ: str) -> list[Path]:
    """The organ's file, then the tumors'."""
    files = sorted((p for p in paths if p.suffix.lower() in SUFFIXES), key=natural)
    tumors = [f for f in files if is_tumor(f.stem)]  # also kidney_tumor.stl
    rest = [f for f in files if f not in tumors]
    organs = [f for f in rest if organ in f.stem.lower() or "organ" in f.stem.lower()]
    other = [f.name for f in rest if f not in organs]
    if len(organs) != 1 or other:
        problem = f"{len(organs)} name an organ" + (f", {other} name neither" if other else "")
        raise InputError(f"of {[f.name for f in files]} {problem}. {_RULE.format(organ)}")
    return [*organs, *tumors]


def read_lps(path: Path, scale: float, notes: list[Note]) -> Mesh:
    """A mesh file in LPS, its vertices times ``scale``; a conversion from RAS is noted. Raises
    InputError: not a mesh, or an unknown frame."""
    mesh = read_mesh(path)
    if not np.abs(mesh.vertices_mm).max() < 1e7:
        raise InputError(f"{path} has vertices kilometres away; it is damaged or not in mm.")
    space = _stated_space(path)
    vertices = mesh.vertices_mm * scale
    if space == "RAS":
        vertices = transform_points(RAS_FROM_LPS, vertices)
        notes.append(f"{path.name} states SPACE=RAS: converted to LPS")
    elif space not in (None, "LPS"):
        raise InputError(f"{path} states SPACE={space}; LPS or RAS is allowed.")
    return mesh.with_vertices(vertices)


def _stated_space(path: Path) -> str | None:
    """SPACE=... from a PLY, OBJ or STL comment, as 3D Slicer writes it."""
    with path.open("rb") as stream:
        head = stream.read(4096)
    if path.suffix.lower() == ".ply":
        head = head.partition(b"end_header")[0]
    elif path.suffix.lower() == ".stl":
        head = head[:80] if not head.lstrip().startswith(b"solid") else head.partition(b"\n")[0]
    match = re.search(rb"SPACE\s*=\s*([A-Za-z]+)", head)
    return match.group(1).decode().upper() if match else None


def _check_unit(path: Path, organ: Mesh, unit: str | None) -> None:
    extent, (low, high) = organ.longest_mm, _ORGAN_MM
    if not low <= extent <= high:
        is_metres = unit != "m" and low <= 1000 * extent <= high
        what = "it looks like metres. Give --unit m" if is_metres else "check its unit"
        raise InputError(
            f"{path} is {extent:.4g} mm long; an organ has {low:g} to {high:g} mm: {what}."
        )


def _union(organ: Mesh, tumor: Mesh, name: str) -> Mesh:
    """Organ and tumor as one closed surface, without cavities between them."""
    joined = solid_of(organ, "the organ") + solid_of(tumor, name)
    outer = [shell for shell in joined.decompose() if shell.volume() > 0]
    outer.sort(key=lambda shell: -shell.volume())
    if not outer or (len(outer) > 1 and outer[1].volume() > 0.01 * tumor.volume_mm3):
        raise InputError(
            f"{name} lies apart from the organ. Check that all meshes share one frame and unit."
        )
    return largest_shell(mesh_of(outer[0]))


def closed_mesh(mesh: Mesh, name: str, notes: list[Note]) -> Mesh:
    """Repair a mesh and note each change: doubled faces are removed, holes up to 10 mm closed and
    faces turned outward; a mesh that crosses itself is remeshed from its winding numbers. Raises
    InputError: still open, or not a surface."""
    import trimesh

    size = mesh.longest_mm
    if not size > 0:
        raise InputError(f"{name} has no extent; it is damaged.")
    _, first = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
    out = Mesh(mesh.vertices_mm, mesh.faces[np.sort(first)])
    if doubled := len(mesh.faces) - len(first):
        notes.append(f"{name}: {doubled} doubled faces removed")
    work = trimesh.Trimesh(out.vertices_mm, out.faces, process=False)
    if not work.is_winding_consistent:
        trimesh.repair.fix_winding(work)
        notes.append(f"{name}: faces turned the same way round")
        out = Mesh(out.vertices_mm, np.asarray(work.faces))
    out = _close_holes(out, name, notes)
    if not trimesh.Trimesh(out.vertices_mm, out.faces, process=False).is_watertight:
        raise InputError(f"{name} is not a closed surface. Repair it, or give a label map.")
    if out.volume_mm3 < 0:
        out = Mesh(out.vertices_mm, out.faces[:, ::-1])
        notes.append(f"{name}: it was inside out; faces turned outward")
    bodies = list(shells(out))
    for n, body in enumerate(bodies):  # a cavity's wall lies in the box of another body
        boxes = (other.box_mm - body.box_mm for other in bodies if other is not body)
        if body.volume_mm3 < 0 and not any((b[0] <= 0).all() and (b[1] >= 0).all() for b in boxes):
            bodies[n] = Mesh(body.vertices_mm, body.faces[:, ::-1])
            notes.append(f"{name}: a piece of {bodies[n].volume_ml:.2f} ml was inside out; turned")
    _check_nested(bodies, name)
    starts = np.cumsum([0, *(len(body.vertices_mm) for body in bodies)])
    faces = [body.faces + start for body, start in zip(bodies, starts, strict=False)]
    out = Mesh(np.concatenate([b.vertices_mm for b in bodies]), np.concatenate(faces))
    if abs(out.volume_mm3) < 1e-9 * size**3:
        raise InputError(f"{name} encloses no volume; it is no solid.")
    if not is_simple(out, size / 80):
        out = _remesh(out, name, size / 120)
        notes.append(f"{name}: it crossed itself; remeshed at {size / 120:.2g} mm")
    return out


def _check_nested(bodies: list[Mesh], name: str) -> None:
    """Refuse a solid within another one, as of a tumor in its organ's file: it would be lost."""
    for outer, inner in itertools.permutations(bodies, 2):
        boxes = inner.box_mm - outer.box_mm
        if inner.volume_mm3 <= 0 or not ((boxes[0] >= 0).all() and (boxes[1] <= 0).all()):
            continue
        both = solid_of(outer, name) ^ solid_of(inner, name)
        if both.volume() > 0.9 * inner.volume_mm3:
            ml = f"{inner.volume_ml:.2f} ml"
            raise InputError(f"{name} holds {ml} within another body. Give each part its own file.")


def _close_holes(mesh: Mesh, name: str, notes: list[Note]) -> Mesh:
    """Close every boundary loop by a fan about its centre, if all are small."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    n = len(mesh.vertices_mm)
    codes, back = (edges.astype(np.int64) @ weights for weights in ([n, 1], [1, n]))
    border = edges[~np.isin(codes, back)]
    if len(border) == 0:
        return mesh
    successor = {int(a): int(b) for a, b in border}
    if len(successor) != len(border):
        raise InputError(f"{name} has holes that meet in one point; repair the mesh first.")
    centres: list[np.ndarray] = []
    faces, widest = [mesh.faces], 0.0
    while successor:
        loop = [next(iter(successor))]
        while (vertex := successor.pop(loop[-1], None)) is not None and vertex != loop[0]:
            loop.append(vertex)
        if vertex is None:
            raise InputError(f"{name} has a border that does not close; repair the mesh first.")
        ring = mesh.vertices_mm[loop]
        widest = max(widest, float(np.ptp(ring, axis=0).max()))
        # Border edges run as their faces do; new faces run the other way.
        centre = np.full(len(loop), n + len(centres))
        faces.append(np.stack([np.roll(loop, -1), loop, centre], axis=1))
        centres.append(ring.mean(0))
    if widest > _LARGEST_HOLE_MM:
        raise InputError(
            f"{name} is open: {len(centres)} holes, the widest {widest:.1f} mm (up to "
            f"{_LARGEST_HOLE_MM:g} mm are closed). Close them, or give a label map."
        )
    notes.append(f"{name}: {len(centres)} holes closed, the widest {widest:.1f} mm")
    return Mesh(np.concatenate([mesh.vertices_mm, centres]), np.concatenate(faces))


def _remesh(mesh: Mesh, name: str, step: float) -> Mesh:
    """The surface of the region with a positive winding number: no crossings or inner walls."""
    affine, shape = grid_round(mesh.box_mm, step, 4 * step)
    inside = winding_numbers(mesh, affine, shape) > 0
    if not inside.any():
        raise InputError(f"{name} crosses itself and encloses nothing; repair it first.")
    out = surface_of(name, inside, affine, step, keep=lambda whole: whole)
    if not 1 / _LARGEST_REMESH < out.volume_mm3 / mesh.volume_mm3 < _LARGEST_REMESH:
        raise InputError(f"{name} crosses itself too much to be repaired; repair it first.")
    return out


def is_simple(mesh: Mesh, step_mm: float) -> bool:
    """Whether rays along all three axes find only winding numbers 0 and 1."""
    for axis in range(3):
        rolled = mesh.with_vertices(np.roll(mesh.vertices_mm, axis, axis=1))
        numbers = winding_numbers(rolled, *grid_round(rolled.box_mm, step_mm, 2 * step_mm))
        # Rounding may swap the faces of thin slivers: tolerate single rays.
        wrong = ((numbers < 0) | (numbers > 1)).any(2) | (numbers[:, :, -1] != 0)
        if wrong.sum() > 2:
            return False
    return True
