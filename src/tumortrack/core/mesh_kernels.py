"""Kernels on meshes and points: volumes, points inside, nearest places, farthest points."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tumortrack.core.compiled import njit


@njit(fastmath=True, nogil=True)
def signed_volume(vertices, faces):  # type: ignore[no-untyped-def]
    """The volume of a closed surface, positive where faces (f, 3) turn outward: the sum of each
    face's area projected along z times its height over the first vertex."""
    triple = 0.0
    for n in range(len(faces)):
        a, b, c = vertices[faces[n, 0]], vertices[faces[n, 1]], vertices[faces[n, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        triple += area * (a[2] + b[2] + c[2] - 3 * vertices[0, 2])
    return triple / 6


def contained(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether points (n, 3) lie inside a closed surface: below an odd number of faces (f, 3)."""
    side = int(np.sqrt(len(points) / 2)) + 1  # of a grid over x and y
    lower = points[:, :2].min(0, initial=np.inf)
    per_mm = side / np.maximum(points[:, :2].max(0, initial=-np.inf) - lower, 1e-9)
    column, row = np.minimum((points[:, :2] - lower) * per_mm, side - 1).astype(np.int64).T
    order = np.argsort(row * side + column, kind="stable")
    starts = np.searchsorted((row * side + column)[order], np.arange(side * side + 1))
    sorted_inside = _above(points[order], vertices, faces, side, starts, (*lower, *per_mm))
    inside = np.empty(len(points), np.bool_)
    inside[order] = sorted_inside
    return inside


@njit(nogil=True)
def _above(points, vertices, faces, side, starts, grid):  # type: ignore[no-untyped-def]
    """Whether an odd number of faces lies above each point. Points are sorted by grid cell; each
    face is tested only against those in cells below it.

    Of two triangles that share an edge exactly one owns a point on it, as both compute that edge's
    sign from its lower end (crossing rule of Shimrat 1962, doi 10.1145/368637.368653).
    """
    inside = np.zeros(len(points), np.bool_)
    x0, y0, per_x, per_y = grid
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        left = (min(a[0], b[0], c[0]) - x0) * per_x
        right = (max(a[0], b[0], c[0]) - x0) * per_x
        bottom = (min(a[1], b[1], c[1]) - y0) * per_y
        top = (max(a[1], b[1], c[1]) - y0) * per_y
        if right < 0 or top < 0 or left > side or bottom > side:
            continue
        first, last = int(max(left, 0)), int(min(right, side - 1))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        for row in range(int(max(bottom, 0)), int(min(top, side - 1)) + 1):
            start = starts[row * side + min(first, side - 1)]
            for i in range(start, starts[row * side + last + 1]):
                x, y = points[i, 0], points[i, 1]
                crossed = _left_of(a, b, x, y) != _left_of(b, c, x, y)
                if crossed == _left_of(c, a, x, y) or area == 0:
                    continue
                s = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
                t = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
                if a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2]) > points[i, 2]:
                    inside[i] = not inside[i]
    return inside


@njit(inline="always")
def _left_of(a, b, x, y):  # type: ignore[no-untyped-def]
    """Whether, projected on x and y, the edge passes to the right of the point."""
    if (a[1] > y) == (b[1] > y):
        return False
    if a[1] > b[1]:
        a, b = b, a
    return (b[0] - a[0]) * (y - a[1]) - (x - a[0]) * (b[1] - a[1]) > 0


_LEAF = 4  # triangles in a box of the lowest level
_A_THREAD = 20_000  # points that are worth a thread


def nearest_on_faces(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The nearest place on triangles (f, 3, 3) of each point (n, 3), by a tree of boxes: triangles
    in the order of a curve through space (Morton's), halved again and again."""
    middles = triangles.mean(1)
    span = np.maximum(np.ptp(middles, axis=0), 1e-9)
    cells = (1023 * (middles - middles.min(0)) / span).astype(np.int64)
    bits = cells[:, :, None] >> np.arange(10) & 1
    keys = (bits << np.arange(3)[:, None] + 3 * np.arange(10)).sum((1, 2))
    levels = max(0, int(np.ceil(np.log2(len(triangles) / _LEAF))))
    # Filled up with the last one, so that all leaves are full
    order = np.argsort(keys, kind="stable")[
        np.minimum(np.arange(_LEAF << levels), len(triangles) - 1)
    ]
    leaves = np.ascontiguousarray(triangles[order]).reshape(-1, _LEAF, 3, 3)
    level, boxes = np.stack([leaves.min((1, 2)), leaves.max((1, 2))], axis=1), []
    for _ in range(levels + 1):
        boxes.append(level)
        pairs = level.reshape(-1, 2, 2, 3) if len(level) > 1 else level[None]
        level = np.stack([pairs[:, :, 0].min(1), pairs[:, :, 1].max(1)], axis=1)
    tree = leaves, np.concatenate(boxes[::-1]), levels
    parts = np.array_split(points, 1 + len(points) // _A_THREAD)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(lambda part: _nearest(part, *tree), parts)))


@njit(nogil=True, error_model="numpy")
def _nearest(points, leaves, boxes, levels):  # type: ignore[no-untyped-def]
    """Box 0 is around all; in box n are the boxes 2 n + 1 and 2 n + 2, or leaf n - 2^levels + 1."""
    places, first, last = np.full((len(points), 3), np.nan), 2**levels - 1, 0
    open_boxes, away = np.empty(levels + 3, np.int64), np.empty(levels + 3)
    for n in range(len(points)):
        # Neighbouring points are often nearest to neighbouring triangles: first where the last was
        p, least, count = points[n], np.inf, 2
        open_boxes[0], open_boxes[1] = 0, first + last
        away[0] = away[1] = 0.0
        while count:
            count -= 1
            box = open_boxes[count]
            if away[count] >= least:
                continue
            if box >= first:
                leaf = leaves[box - first]
                for k in range(_LEAF):
                    x, y, z = _on_triangle(p, leaf[k, 0], leaf[k, 1], leaf[k, 2])
                    off = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
                    if off < least:
                        least, last = off, box - first
                        places[n, 0], places[n, 1], places[n, 2] = x, y, z
                continue
            one, other = 2 * box + 1, 2 * box + 2
            near, far = _to_box(p, boxes[one]), _to_box(p, boxes[other])
            if near > far:
                one, other, near, far = other, one, far, near
            if far < least:
                open_boxes[count], away[count] = other, far
                count += 1
            if near < least:
                open_boxes[count], away[count] = one, near
                count += 1
    return places


@njit(inline="always")
def _to_box(p, box):  # type: ignore[no-untyped-def]
    """The square of a point's distance to a box (2, 3)."""
    total = 0.0
    for axis in range(3):
        off = max(box[0, axis] - p[axis], p[axis] - box[1, axis], 0.0)
        total += off * off
    return total


_FLAT = 1e-14  # square of the sine of a corner, below which a triangle is a line


@njit(inline="always")
def _on_triangle(p, a, b, c):  # type: ignore[no-untyped-def]
    """The nearest place on a triangle, by the region (corner, edge, inside) that the point is over:
    Ericson 2005, Real-Time Collision Detection, 5.1.5."""
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1, d2 = ab0 * x + ab1 * y + ab2 * z, ac0 * x + ac1 * y + ac2 * z
    bb, bc, cc = (
        ab0 * ab0 + ab1 * ab1 + ab2 * ab2,
        ab0 * ac0 + ab1 * ac1 + ab2 * ac2,
        ac0 * ac0 + ac1 * ac1 + ac2 * ac2,
    )
    d3, d4 = d1 - bb, d2 - bc  # of p - b
    d5, d6 = d1 - bc, d2 - cc  # of p - c
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    ee = bb + cc - 2 * bc  # squares of the edges' lengths
    if bb * cc - bc * bc <= _FLAT * bb * cc or ee <= 0:  # a line: its longest edge
        if bb >= cc and bb >= ee:
            s, t = min(max(d1 / bb, 0.0), 1.0) if bb > 0 else 0.0, 0.0
        elif cc >= ee:
            s, t = 0.0, min(max(d2 / cc, 0.0), 1.0)
        else:
            t = min(max((d4 - d3) / ee, 0.0), 1.0)
            s = 1.0 - t
    elif d1 <= 0 and d2 <= 0:
        s, t = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        s, t = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        s, t = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        s, t = d1 / (d1 - d3), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        s, t = 0.0, d2 / (d2 - d6)
    elif va <= 0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        s, t = vb / (va + vb + vc), vc / (va + vb + vc)
    return (a[0] + s * ab0 + t * ac0, a[1] + s * ab1 + t * ac1, a[2] + s * ab2 + t * ac2)


_MAXIMUM = {"nnan", "nsz"}  # lets a maximum be taken in lanes; sums stay as they are written


@njit(nogil=True, fastmath=_MAXIMUM)
def farthest(points, first, chosen):  # type: ignore[no-untyped-def]
    """Farthest points of clouds (B, 3, N), float32, into ``chosen`` (B, k), int64, from the first
    choices (B,) on."""
    n_clouds, _, n = points.shape
    nearest = np.empty(n, np.float32)
    for cloud in range(n_clouds):
        x, y, z = points[cloud, 0], points[cloud, 1], points[cloud, 2]
        nearest[:] = np.inf
        newest = first[cloud]
        for step in range(chosen.shape[1]):
            chosen[cloud, step] = newest
            cx, cy, cz = x[newest], y[newest], z[newest]
            for i in range(n):
                dx, dy, dz = x[i] - cx, y[i] - cy, z[i] - cz
                nearest[i] = min(nearest[i], dx * dx + dy * dy + dz * dz)
            most = np.float32(-1.0)
            for i in range(n):
                most = max(most, nearest[i])
            newest = 0
            while newest < n - 1 and nearest[newest] != most:
                newest += 1
