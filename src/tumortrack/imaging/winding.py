"""Winding numbers of a mesh on a voxel grid, by rays along one axis.

Each triangle adds +1 or -1 to every cell behind it. A closed mesh whose faces turn outward and
that does not cross itself gives 0 outside and 1 inside, and nothing else.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int16

from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh

_MOST_CELLS = 2**28
_MOST_PAIRS = 2**27
_NUDGE = np.array([0.000_317, 0.000_471])  # cells: keeps rays off vertices on round numbers


def winding_numbers(
    mesh: Mesh, origin_mm: Float[np.ndarray, " 3"], step_mm: float, shape: tuple[int, int, int]
) -> Int16[np.ndarray, "i j k"]:
    """The winding number at the centres of a grid's cells (centre of cell 0: ``origin_mm``).

    Rays run along the last axis, from before the grid.

    Raises:
        InputError: the grid or the mesh is too large.
    """
    if np.prod(np.array(shape, float)) > _MOST_CELLS:
        raise InputError(f"a mesh {step_mm:g} mm cells wide needs {shape} cells: too many.")
    triangles = ((mesh.vertices_mm - origin_mm) / step_mm)[mesh.faces]
    triangles[:, :, :2] += _NUDGE
    low = np.ceil(np.maximum(triangles[:, :, :2].min(1), 0)).astype(int)
    high = np.floor(np.minimum(triangles[:, :, :2].max(1), np.array(shape[:2]) - 1)).astype(int)
    width = np.maximum(high - low + 1, 0)
    pairs = width[:, 0] * width[:, 1]
    if pairs.sum() > _MOST_PAIRS:
        raise InputError("the mesh has too many large triangles; reduce or repair it first.")
    which = np.repeat(np.arange(len(triangles)), pairs)
    nth = np.arange(len(which)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    column = low[which] + np.stack([nth // width[which, 1], nth % width[which, 1]], 1)
    hit, depth, sign = _crossings(triangles[which], column.astype(float))
    steps = np.zeros((shape[0], shape[1], shape[2] + 1), np.int16)
    first_behind = np.clip(np.ceil(depth[hit]), 0, shape[2]).astype(int)
    np.add.at(steps, (column[hit, 0], column[hit, 1], first_behind), sign[hit])
    return np.cumsum(steps[:, :, :-1], axis=2, dtype=np.int16)


def _crossings(triangles: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Does the column through ``at`` cross, where along it, entering (+1) or leaving (-1)."""
    a, b, c = (triangles[:, n, :2] - at for n in range(3))

    def cross(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    weights = np.stack([cross(b, c), cross(c, a), cross(a, b)], 1)
    area = weights.sum(1)
    hit = ((weights > 0).all(1) | (weights < 0).all(1)) & (area != 0)
    safe = np.where(area == 0, 1.0, area)
    depth = (weights * triangles[:, :, 2]).sum(1) / safe
    # A face that turns towards the ray's start (negative projected area) is entered.
    return hit, depth, np.where(area < 0, 1, -1).astype(np.int16)


def grid_round(
    box_mm: Float[np.ndarray, "2 3"], step_mm: float, margin_mm: float
) -> tuple[Float[np.ndarray, " 3"], tuple[int, int, int]]:
    """Origin and shape of a grid that holds a box and a margin."""
    origin = box_mm[0] - margin_mm
    counts = np.ceil((box_mm[1] + margin_mm - origin) / step_mm).astype(int) + 1
    return origin, (int(counts[0]), int(counts[1]), int(counts[2]))


def is_simple(mesh: Mesh, step_mm: float) -> bool:
    """True where rays along all three axes find only winding numbers 0 and 1."""
    for turn in range(3):
        turned = mesh.moved(np.roll(mesh.vertices_mm, turn, axis=1))
        origin, shape = grid_round(turned.box_mm, step_mm, 2 * step_mm)
        numbers = winding_numbers(turned, origin, step_mm, shape)
        # A ray within 1e-9 of an edge may be counted twice: single columns do not decide.
        wrong = ((numbers < 0) | (numbers > 1)).any(2) | (numbers[:, :, -1] != 0)
        if wrong.sum() > 2:
            return False
    return True
