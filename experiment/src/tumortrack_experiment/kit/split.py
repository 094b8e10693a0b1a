"""Parts that are larger than the printer's bed, in pieces that fit together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.imaging.raster import voxelise
from tumortrack_experiment.kit.values import PrintedPart

_PEG_MM, _LONG_MM, _WALL_MM = (3.0, 2.2), 5.0, 2.0  # radii of a cone, its height, round its hole
_MOST_PIECES = 64


def split_to_bed(
    part: PrintedPart, bed_mm: tuple[float, float, float], clearance_mm: float = 0.25
) -> tuple[PrintedPart, ...]:
    """The part itself where it fits the bed as it lies, or turned by a quarter; else pieces that
    do, cut square in the middle, with up to four pegs and their holes on each cut.

    Raises:
        InputError: the bed is no bed, or it would take more than 64 pieces.
    """
    bed = np.array(bed_mm, float)
    if not (bed > 4 * _LONG_MM).all():
        raise InputError(f"a bed of {bed_mm} mm: each side must be over {4 * _LONG_MM:g} mm.")
    laid = part.mesh.moved(transform_points(part.print_from_frame, part.mesh.vertices_mm))
    if fits(laid, bed_mm):
        return (part,)
    room = bed - [0.0, 0.0, _LONG_MM]  # a peg may stand on a piece
    size = np.ptp(laid.box_mm, axis=0)
    if size[0] < size[1]:
        room[:2] = room[:2].min(), room[:2].max()
    else:
        room[:2] = room[:2].max(), room[:2].min()
    room[:2] -= _LONG_MM
    counts = np.ceil(size / room).astype(int)
    if counts.prod() > _MOST_PIECES:
        raise InputError(f"{part.name}: {counts.prod()} pieces for a bed of {bed_mm} mm.")
    pieces = [solid_of(laid, part.name)]
    for axis in range(3):
        for n in range(1, counts[axis]):
            at = laid.box_mm[0, axis] + size[axis] * n / counts[axis]
            pieces = [half for piece in pieces for half in _cut(piece, axis, at, clearance_mm)]
    frame_from_print = np.linalg.inv(part.print_from_frame)
    return tuple(
        _piece(part, mesh_of(piece), n, frame_from_print)
        for n, piece in enumerate(pieces, 1)
    )  # fmt: skip


def fits(laid: Mesh, bed_mm: tuple[float, float, float]) -> bool:
    """Whether a part that lies as it is printed fits, turned by a quarter if need be."""
    size, bed = np.ptp(laid.box_mm, axis=0), np.array(bed_mm)
    return bool((size <= bed).all() or (size[[1, 0, 2]] <= bed).all())


def to_bed(points_mm: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, "3 3"]) -> np.ndarray:
    """A 4 x 4 transform that turns by ``up``, sets the lowest point on 0 and centres the rest."""
    turned = points_mm @ up.T
    low, high = turned.min(0), turned.max(0)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = up, [*(-(low + high)[:2] / 2), -low[2]]
    return out


def _piece(part: PrintedPart, laid: Mesh, number: int, frame_from_print: np.ndarray) -> PrintedPart:
    mesh = laid.moved(transform_points(frame_from_print, laid.vertices_mm))
    print_from_frame = to_bed(laid.vertices_mm, np.eye(3)) @ part.print_from_frame
    name, purpose = f"{part.name}_{number}", f"{part.purpose} (piece {number})"
    return replace(part, name=name, purpose=purpose, mesh=mesh, print_from_frame=print_from_frame)


def _cut(piece: Any, axis: int, at_mm: float, clearance_mm: float) -> list[Any]:
    """Both sides of a cut, those that are not empty; pegs on the lower side."""
    import manifold3d

    normal = np.eye(3)[axis]
    above, below = piece.split_by_plane(normal.tolist(), at_mm)
    if above.is_empty() or below.is_empty():
        return [piece]
    turn = np.roll(np.eye(3), -axis - 1, axis=0)  # rows: across, across, along the axis
    pegs, holes = [], []
    for place in _spots(mesh_of(piece), axis, at_mm):
        pose = np.column_stack([turn.T, place])
        wide, narrow = _PEG_MM
        peg = manifold3d.Manifold.cylinder(_LONG_MM, wide, narrow, 32)
        # It is rooted in its own side.
        peg += manifold3d.Manifold.cylinder(1.0, wide, wide, 32).translate([0, 0, -1.0])
        c = clearance_mm
        hole = manifold3d.Manifold.cylinder(_LONG_MM + c, wide + c, narrow + c, 32)
        pegs.append(peg.transform(pose))
        holes.append(hole.transform(pose))
    for peg, hole in zip(pegs, holes, strict=True):
        below, above = below + peg, above - hole
    return [*below.decompose(), *above.decompose()]


def _spots(mesh: Mesh, axis: int, at_mm: float) -> list[np.ndarray]:
    """Up to four places far apart on a cut where a peg's root and hole have solid round them."""
    low, high = mesh.box_mm
    turn = np.roll(np.eye(3), -axis - 1, axis=0)
    step, deep = 1.0, int(_LONG_MM + _WALL_MM)
    flat = turn[:2]
    start, span = flat @ low, flat @ (high - low)
    shape = (int(span[0] / step) + 1, int(span[1] / step) + 1, 2 * deep + 1)
    frame = np.eye(4)
    frame[:3, :3] = (turn * step).T
    frame[:3, 3] = turn.T @ [*start, at_mm - deep * step]
    solid = voxelise(mesh, frame, shape)[:, :, deep - 2 :].all(2)
    room = ndimage.distance_transform_edt(np.pad(solid, 1))[1:-1, 1:-1] * step
    free = np.argwhere(room > _PEG_MM[0] + _WALL_MM)
    chosen: list[np.ndarray] = []
    while len(free) and len(chosen) < 4:
        if not chosen:
            away = np.linalg.norm(free - free.mean(0), axis=1)
        else:
            away = np.linalg.norm(free[:, None] - np.array(chosen), axis=2).min(1)
            if away.max() * step < 4 * _PEG_MM[0]:
                break
        chosen.append(free[away.argmax()])
    return [frame[:3, :3] @ [*spot, deep] + frame[:3, 3] for spot in chosen]
