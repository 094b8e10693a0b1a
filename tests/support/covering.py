"""Scan conversion in plain NumPy: the reference for the compiled one."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

_CHUNK = 2_000_000  # candidate pixels held at once


def cover(
    triangles: Float[np.ndarray, "t 3 3"], shape: tuple[int, int]
) -> Iterator[
    tuple[
        Int[np.ndarray, " m"], Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]
    ]
]:
    """Pixels (i, j) whose centres the triangles cover, and the third coordinate there.

    Corners are (i, j, depth), pixel centres whole numbers in [0, shape). A pixel on an edge that
    two triangles share belongs to exactly one of them (half-open rule, both evaluate the edge
    with the same numbers), so a closed surface has no cracks and no double hits.

    Yields:
        (triangle, i, j, depth), chunk by chunk.
    """
    spans = np.ptp(triangles[:, :, :2], axis=1) + 1
    size = np.minimum(spans, shape).prod(1) if len(triangles) else np.zeros(0)
    chunk = (np.cumsum(size) // _CHUNK).astype(int)
    for part in np.split(np.arange(len(triangles)), np.flatnonzero(np.diff(chunk)) + 1):
        tri, i, j, depth = _cover_chunk(triangles[part], shape)
        yield part[tri], i, j, depth


def _cover_chunk(
    triangles: Float[np.ndarray, "t 3 3"], shape: tuple[int, int]
) -> tuple[
    Int[np.ndarray, " m"], Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]
]:
    x = triangles[:, :, 0]
    first = np.clip(np.ceil(x.min(1)), 0, shape[0]).astype(int)
    stop = np.clip(np.ceil(x.max(1)), 0, shape[0]).astype(int)
    tri, step = expand(np.maximum(stop - first, 0))
    i = first[tri] + step
    low, high = np.full(len(tri), np.nan), np.full(len(tri), np.nan)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        swap = x[:, a] > x[:, b]  # the same direction, hence the same rounding, from both sides
        start = np.where(swap[:, None], triangles[:, b], triangles[:, a])[tri]
        end = np.where(swap[:, None], triangles[:, a], triangles[:, b])[tri]
        crosses = (start[:, 0] <= i) & (end[:, 0] > i)
        run = np.where(crosses, end[:, 0] - start[:, 0], 1)
        at = start[:, 1] + (i - start[:, 0]) * (end[:, 1] - start[:, 1]) / run
        at[~crosses] = np.nan
        low, high = np.fmin(low, at), np.fmax(high, at)
    left = np.clip(np.ceil(low), 0, shape[1]).astype(int)
    right = np.clip(np.ceil(high), 0, shape[1]).astype(int)
    row, step = expand(right - left)
    tri, i, j = tri[row], i[row], left[row] + step
    corner = triangles[:, 0]
    normal = np.cross(triangles[:, 1] - corner, triangles[:, 2] - corner)
    slope = normal[:, :2] / np.where(normal[:, 2:] == 0, 1, normal[:, 2:])
    depth = corner[tri, 2] - slope[tri, 0] * (i - corner[tri, 0])
    depth -= slope[tri, 1] * (j - corner[tri, 1])
    depth = np.clip(depth, triangles[:, :, 2].min(1)[tri], triangles[:, :, 2].max(1)[tri])
    return tri, i, j, depth


def expand(counts: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """``counts[item]`` entries for each item: the item, and the entry's number within it."""
    item = np.repeat(np.arange(len(counts)), counts)
    return item, np.arange(len(item)) - np.repeat(np.cumsum(counts) - counts, counts)
