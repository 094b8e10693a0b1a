"""Parts that are larger than the printer's bed, in pieces that fit together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Mesh
from tumortrack_experiment.kit.values import PrintedPart

_PEG_MM, _LONG_MM, _WALL_MM = (3.0, 2.2), 5.0, 2.0  # a cone's radii, its height, round its hole
_MOST_PIECES, _MOST_PEGS = 64, 4


def laid_mesh(part: PrintedPart) -> Mesh:
    """As it lies on the printer's bed."""
    return part.mesh.with_vertices(transform_points(part.print_from_frame, part.mesh.vertices_mm))


def fits(part: PrintedPart, bed_mm: tuple[float, float, float]) -> bool:
    """Whether it fits the bed as it lies, or turned by a quarter."""
    size = np.ptp(laid_mesh(part).box_mm, axis=0)
    return bool((size <= bed_mm).all() or (size[[1, 0, 2]] <= bed_mm).all())


def to_bed(
    points_mm: Float64[np.ndarray, "n 3"], turn: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "4 4"]:
    """Turn points, set the lowest on 0 and the others' middle over it."""
    turned = points_mm @ turn.T
    low, high = turned.min(0), turned.max(0)
    return rigid(turn, -np.append((low + high)[:2] / 2, low[2]))


def split_to_bed(
    part: PrintedPart, bed_mm: tuple[float, float, float], clearance_mm: float = 0.25
) -> tuple[PrintedPart, ...]:
    """The part itself where it fits the bed; else pieces that do, cut into equal lengths along the
    axes of the bed, with up to four pegs and their holes on each cut.

    Raises:
        InputError: a side of the bed under 30 mm, or one so small that it takes over 64 pieces.
    """
    if min(bed_mm) < 30:
        raise InputError(f"a bed of {bed_mm} mm is too small; each side must be 30 mm or more.")
    if fits(part, bed_mm):
        return (part,)
    laid, across = laid_mesh(part), sorted(bed_mm[:2])
    size = np.ptp(laid.box_mm, axis=0)
    room = np.array([*(across if size[0] < size[1] else across[::-1]), bed_mm[2]])
    counts = np.where(size > room, np.ceil(size / (room - _LONG_MM)), 1).astype(int)
    if counts.prod() > _MOST_PIECES:
        raise InputError(f"{part.name} takes {counts.prod()} pieces on a bed of {bed_mm} mm.")
    pieces = [solid_of(laid, part.name)]
    for axis, count in enumerate(counts):
        for n in range(1, count):
            at = laid.box_mm[0, axis] + size[axis] * n / count
            pieces = [half for piece in pieces for half in _cut(piece, axis, at, clearance_mm)]
    out, back = [], np.linalg.inv(part.print_from_frame)
    for n, mesh in enumerate(map(mesh_of, pieces), 1):
        on_bed = to_bed(mesh.vertices_mm, np.eye(3)) @ part.print_from_frame
        own = mesh.with_vertices(transform_points(back, mesh.vertices_mm))
        name, purpose = f"{part.name}_{n}", f"{part.purpose}, piece {n} of {len(pieces)}"
        out.append(replace(part, name=name, purpose=purpose, mesh=own, print_from_frame=on_bed))
    return tuple(out)


def _cut(piece: Any, axis: int, at_mm: float, clearance_mm: float) -> list[Any]:
    """Both sides of a cut across an axis, with pegs on the lower one, or the piece itself."""
    from manifold3d import CrossSection, JoinType, Manifold, OpType

    turn = np.column_stack([np.roll(np.eye(3), 2 - axis, axis=0), -at_mm * np.eye(3)[2]])
    back = np.column_stack([turn[:, :3].T, at_mm * np.eye(3)[axis]])
    upper, lower = piece.transform(turn).split_by_plane([0, 0, 1], 0.0)
    if upper.is_empty() or lower.is_empty():
        return [piece]
    reach = _LONG_MM + _WALL_MM
    slices = [lower.slice(-1.0), *(upper.slice(z) for z in (1e-3, reach / 2, reach))]
    room = CrossSection.batch_boolean(slices, OpType.Intersect)
    room = room.offset(-_PEG_MM[0] - _WALL_MM, JoinType.Round)
    spots = np.concatenate([*room.to_polygons(), np.zeros((0, 2))])
    for _ in range(_MOST_PEGS):
        if not len(spots):
            break
        spot = spots[np.linalg.norm(spots - spots.mean(0), axis=1).argmax()]
        spots = spots[np.linalg.norm(spots - spot, axis=1) > 4 * _PEG_MM[0]]
        wide, narrow = _PEG_MM
        root = Manifold.cylinder(1.0, wide, wide, 32).translate([0, 0, -1.0])
        peg = Manifold.cylinder(_LONG_MM, wide, narrow, 32) + root
        play = clearance_mm
        hole = Manifold.cylinder(_LONG_MM + play, wide + play, narrow + play, 32)
        lower, upper = lower + peg.translate([*spot, 0]), upper - hole.translate([*spot, 0])
    return [solid.transform(back) for side in (lower, upper) for solid in side.decompose()]
