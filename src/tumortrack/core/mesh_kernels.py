"""Kernels on meshes and points: volumes, points inside, nearest places, farthest points.

Faces (f, 3), int32, must name vertices that exist, as those of a ``Mesh`` do.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tumortrack.native import BOOL, F32, F64, I32, I64, kernel

_VERTICES, _FACES = F64["v", 3], I32["f", 3]

_signed_volume = kernel("signed_volume", _VERTICES.any_value, _FACES, result=float)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """The volume of a closed surface, positive where faces turn outward."""
    return float(_signed_volume(np.ascontiguousarray(vertices), np.ascontiguousarray(faces)))


# Turns ``inside`` over for each face that lies above a point. Points are sorted by cell of a grid:
# cells along a side, the cells' first points, the lower corner and cells per mm.
_GRID = int, I64["starts"], (float, float, float, float)
_faces_above = kernel("faces_above", F64["n", 3], _VERTICES, _FACES, *_GRID, BOOL["n"].out)


def contained(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) lie inside a closed surface: below an odd number of faces."""
    side = int(np.sqrt(len(points) / 2)) + 1  # of a grid over x and y
    lower = points[:, :2].min(0, initial=np.inf)
    per_mm = side / np.maximum(points[:, :2].max(0, initial=-np.inf) - lower, 1e-9)
    column, row = np.minimum((points[:, :2] - lower) * per_mm, side - 1).astype(np.int64).T
    order = np.argsort(row * side + column, kind="stable")
    starts = np.searchsorted((row * side + column)[order], np.arange(side * side + 1))
    above = np.zeros(len(points), np.bool_)
    grid = side, starts, (*lower, *per_mm)
    surface = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
    _faces_above(np.ascontiguousarray(points[order]), *surface, *grid, above)
    inside = np.empty(len(points), np.bool_)
    inside[order] = above
    return inside


_WIDE = 8  # boxes in a box, triangles in a leaf, as in nearest_place.c
_A_THREAD = 20_000  # points that are worth a thread

# Fills leaves and boxes about triangles
_LEAVES, _BOXES = F64["leaves", 7, _WIDE], F64["boxes", 6, _WIDE]
_build_tree = kernel("build_tree", (F64["f", 3, 3], _LEAVES.out, _BOXES.out, I64["levels"]))
# The nearest places of points on a tree's triangles
_TREE = F64["f", 3, 3].any_value, _LEAVES.any_value, _BOXES.any_value, I64["levels"]
_nearest_places = kernel("nearest_places", F64["n", 3], _TREE, F64["n", 3].out)


def nearest_on_faces(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The nearest place on triangles (f, 3, 3) of each point (n, 3), by a tree of boxes: triangles
    in the order of a curve through space (Morton's), by eights, again and again."""
    middles = triangles.mean(1)
    span = np.maximum(np.ptp(middles, axis=0), 1e-9)
    cells = (1023 * (middles - middles.min(0)) / span).astype(np.int64)
    keys = sum((cells[:, n % 3] >> n // 3 & 1) << n for n in range(30))
    sizes = [-(-len(triangles) // _WIDE)]  # of the levels: leaves first, one box last
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // _WIDE))
    firsts = np.cumsum([0, 0, *sizes[1:]])[: len(sizes)]
    leaves = np.zeros((sizes[0], 7, _WIDE))
    leaves[-1, :3] = np.inf
    boxes = np.full((max(firsts[-1] + 1, 1), 6, _WIDE), np.inf)
    tree = np.ascontiguousarray(triangles[np.argsort(keys)]), leaves, boxes, firsts
    _build_tree(tree)

    def nearest(part: np.ndarray) -> np.ndarray:
        places = np.empty(part.shape)
        _nearest_places(part, tree, places)
        return places

    parts = np.array_split(points, 1 + len(points) // _A_THREAD)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(nearest, parts)))


_farthest = kernel(
    "farthest", F32["clouds", 3, "n"], I64["clouds"], F32["n"].out, I64["clouds", "k"].out
)


def farthest(points: np.ndarray, first: np.ndarray, chosen: np.ndarray) -> None:
    """Farthest points of clouds (B, 3, N), float32, into ``chosen`` (B, k), int64, from the first
    choices (B,), below N, on."""
    if ((first < 0) | (first >= points.shape[2])).any():
        raise ValueError(f"first choices {first} of {points.shape[2]} points")
    _farthest(points, first, np.empty(points.shape[2], np.float32), chosen)
