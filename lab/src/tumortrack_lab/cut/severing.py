"""Connected pieces of tissue after a cut. Faces between voxels are severed and no voxels removed,
so that a cut has no volume and leaves no diagonal way through.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from tumortrack.imaging.raster import expand

Flat = Float[np.ndarray, "_ 2"]
Mask = Bool[np.ndarray, "i j"]
Voxels = Bool[np.ndarray, "i j k"]

# In voxels: with this offset no line that anyone draws runs exactly through a voxel's centre, where
# rounding would decide on which side it passes. So closed lines separate inside from outside.
_ASIDE = 1e-7 * np.sqrt([2.0, 3.0])


class Severed:
    """Which faces between neighbouring voxels of a grid are cut; axis by axis, face n between
    voxels n and n + 1."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.shape = shape
        self.faces = [
            np.zeros(tuple(n - (axis == a) for a, n in enumerate(shape)), bool) for axis in range(3)
        ]

    def wall(self, path: Flat, first: int, stop: int) -> None:
        """Cut along a line (x and y in voxels), in the levels first .. stop - 1."""
        i, j, _ = self.shape
        path = path + _ASIDE
        self.faces[0][:, :, first:stop] |= (_crossings(path, (i, j))[1:-1] > 0)[:, :, None]
        across = _crossings(path[:, ::-1], (j, i))[1:-1].T
        self.faces[1][:, :, first:stop] |= (across > 0)[:, :, None]

    def sheet(self, columns: Mask, level: int) -> None:
        """Cut these columns level, between the levels level - 1 and level."""
        if 0 < level < self.shape[2]:
            self.faces[2][:, :, level - 1] |= columns


def within(rings: tuple[Flat, ...], shape: tuple[int, int]) -> Mask:
    """Which of the points (i, j), i < shape[0], j < shape[1], lie within rings (the first point not
    repeated) by the even-odd rule."""
    counts = np.zeros((shape[0] + 1, shape[1]), int)
    for ring in rings:
        counts += _crossings(np.concatenate([ring, ring[:1]]) + _ASIDE, shape)
    return np.cumsum(counts, axis=0)[:-1] % 2 == 1


def _crossings(path: Flat, shape: tuple[int, int]) -> Int[np.ndarray, "i j"]:
    """How often a line passes each row j just before point i; (shape[0] + 1, shape[1])."""
    start, end = path[:-1], path[1:]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.clip(np.ceil(low), 0, shape[1]).astype(int)
    stop = np.clip(np.ceil(high), 0, shape[1]).astype(int)
    part, step = expand(np.maximum(stop - first, 0))
    row = first[part] + step
    share = (row - start[part, 1]) / (end[part, 1] - start[part, 1])
    at = start[part, 0] + share * (end[part, 0] - start[part, 0])
    counts = np.zeros((shape[0] + 1, shape[1]), int)
    np.add.at(counts, (np.clip(np.ceil(at), 0, shape[0]).astype(int), row), 1)
    return counts


def pieces_of(tissue: Voxels, severed: Severed) -> Int[np.ndarray, "i j k"]:
    """Pieces connected over faces that are not severed: 1 is the largest, then 2, 3, ...; 0 where
    there is no tissue."""
    from scipy.ndimage import label
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    # Pieces of voxels that touch no severed face, found fast; each other voxel is one by itself.
    beside = np.zeros(tissue.shape, bool)
    for axis, cut in enumerate(severed.faces):
        low, high = _ends(axis)
        beside[low] |= cut
        beside[high] |= cut
    pieces, count = label(tissue & ~beside, output=np.int32)
    alone = np.flatnonzero(tissue & beside)
    pieces.reshape(-1)[alone] = count + 1 + np.arange(len(alone))
    ends = []
    for axis, cut in enumerate(severed.faces):
        low, high = _ends(axis)
        holds = tissue[low] & tissue[high] & ~cut & (beside[low] | beside[high])
        ends.append(np.stack([pieces[low][holds], pieces[high][holds]]))
    a, b = np.concatenate(ends, axis=1)
    total = count + 1 + len(alone)
    graph = coo_array((np.ones(len(a), bool), (a, b)), (total, total))
    _, whole = connected_components(graph, directed=False)
    of_voxel = whole[pieces]
    sizes = np.bincount(of_voxel[tissue], minlength=total)
    rank = np.empty(total, int)
    rank[np.argsort(-sizes, kind="stable")] = 1 + np.arange(total)
    return np.where(tissue, rank[of_voxel], 0)


def _ends(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """The voxels below and above each face along an axis."""
    low, high = [slice(None)] * 3, [slice(None)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    return tuple(low), tuple(high)
