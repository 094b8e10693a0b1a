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


_WIDE = 8  # boxes in a box, triangles in a leaf: tested together, in lanes
_A_THREAD = 20_000  # points that are worth a thread


def nearest_on_faces(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The nearest place on triangles (f, 3, 3) of each point (n, 3), by a tree of boxes: triangles
    in the order of a curve through space (Hilbert's), by eights, again and again."""
    middles = triangles.mean(1)
    span = np.maximum(np.ptp(middles, axis=0), 1e-9)
    order = np.argsort(_along_curve((1023 * (middles - middles.min(0)) / span).astype(np.int64)))
    sizes = [-(-len(triangles) // _WIDE)]  # of the levels: leaves first, one box last
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // _WIDE))
    firsts = np.cumsum([0, 0, *sizes[1:]])[: len(sizes)]
    tree = _tree(triangles[order], np.array(sizes), firsts)
    parts = np.array_split(points, 1 + len(points) // _A_THREAD)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return np.concatenate(list(pool.map(lambda part: _nearest(part, *tree), parts)))


@njit(nogil=True)
def _along_curve(cells):  # type: ignore[no-untyped-def]
    """How far along Hilbert's curve cells (n, 3) below 1024 are: Skilling 2004, Programming the
    Hilbert curve, doi 10.1063/1.1751381."""
    keys = np.zeros(len(cells), np.int64)
    for n in range(len(cells)):
        x = cells[n].copy()
        for bit in range(9, 0, -1):
            low = (1 << bit) - 1
            for axis in range(3):
                if x[axis] >> bit & 1:
                    x[0] ^= low
                else:
                    swapped = (x[0] ^ x[axis]) & low
                    x[0] ^= swapped
                    x[axis] ^= swapped
        x[1] ^= x[0]
        x[2] ^= x[1]
        turn = 0
        for bit in range(9, 0, -1):
            turn ^= (1 << bit) - 1 if x[2] >> bit & 1 else 0
        for bit in range(10):
            for axis in range(3):
                keys[n] |= ((x[axis] ^ turn) >> bit & 1) << (3 * bit + 2 - axis)
    return keys


@njit(nogil=True, error_model="numpy")
def _tree(triangles, sizes, firsts):  # type: ignore[no-untyped-def]
    """The triangles; leaves (n, 7, 8) of each one's middle, unit normal (0 if it is a line) and
    radius; boxes (m, 6, 8), the lower and upper corners of those in them, of which each level's
    begin at ``firsts``. What fills the last of a level is infinitely far away."""
    leaves = np.zeros((sizes[0], 7, _WIDE))
    leaves[-1, :3] = np.inf
    low, high = np.full((sizes[0], 3), np.inf), np.full((sizes[0], 3), -np.inf)
    for f in range(len(triangles)):
        (a, b, c), leaf, k = triangles[f], leaves[f // _WIDE], f % _WIDE
        u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        square, edges = x * x + y * y + z * z, (u0 * u0 + u1 * u1 + u2 * u2)
        edges *= v0 * v0 + v1 * v1 + v2 * v2
        scale = 1 / np.sqrt(square) if square > 1e-10 * edges else 0.0
        leaf[3, k], leaf[4, k], leaf[5, k] = scale * x, scale * y, scale * z
        for axis in range(3):
            leaf[axis, k] = (a[axis] + b[axis] + c[axis]) / 3
        for corner in (a, b, c):
            off = 0.0
            for axis in range(3):
                off += (corner[axis] - leaf[axis, k]) ** 2
                low[f // _WIDE, axis] = min(low[f // _WIDE, axis], corner[axis])
                high[f // _WIDE, axis] = max(high[f // _WIDE, axis], corner[axis])
            leaf[6, k] = max(leaf[6, k], np.sqrt(off))
    boxes = np.full((max(firsts[-1] + 1, 1), 6, _WIDE), np.inf)
    for level in range(1, len(sizes)):
        lower, higher = low, high
        low, high = np.full((sizes[level], 3), np.inf), np.full((sizes[level], 3), -np.inf)
        for n in range(sizes[level - 1]):
            box, k = n // _WIDE, n % _WIDE
            for axis in range(3):
                boxes[firsts[level] + box, axis, k] = lower[n, axis]
                boxes[firsts[level] + box, 3 + axis, k] = higher[n, axis]
                low[box, axis] = min(low[box, axis], lower[n, axis])
                high[box, axis] = max(high[box, axis], higher[n, axis])
    return triangles, leaves, boxes, firsts


@njit(nogil=True, error_model="numpy")
def _nearest(points, triangles, leaves, boxes, firsts):  # type: ignore[no-untyped-def]
    """See ``nearest_on_faces`` and ``_tree``. Open boxes are kept as level, number and distance."""
    places, bounds, last = np.full((len(points), 3), np.nan), np.empty(_WIDE), 0
    levels = np.empty(_WIDE * len(firsts) + 1, np.int64)
    numbers, away = np.empty(len(levels), np.int64), np.empty(len(levels))
    for n in range(len(points)):
        # Neighbouring points are often nearest to neighbouring triangles: first where the last was
        p, least, count = (points[n, 0], points[n, 1], points[n, 2]), np.inf, 2
        levels[0], numbers[0], away[0] = len(firsts) - 1, 0, 0.0
        levels[1], numbers[1], away[1] = 0, last // _WIDE, 0.0
        while count:
            count -= 1
            if away[count] >= least:
                continue
            level, number = levels[count], numbers[count]
            if level == 0:
                _to_triangles(p, leaves[number], bounds)
                for k in range(min(_WIDE, len(triangles) - _WIDE * number)):
                    if bounds[k] < least:
                        t = _WIDE * number + k
                        x, y, z = _on_triangle(p, triangles[t, 0], triangles[t, 1], triangles[t, 2])
                        off = (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2
                        if off < least:
                            least, last = off, t
                            places[n, 0], places[n, 1], places[n, 2] = x, y, z
                continue
            _to_boxes(p, boxes[firsts[level] + number], bounds)
            first = count
            for k in range(_WIDE):
                if bounds[k] < least:  # sorted in, the nearest last
                    at = count
                    while at > first and away[at - 1] < bounds[k]:
                        numbers[at], away[at] = numbers[at - 1], away[at - 1]
                        at -= 1
                    numbers[at], away[at] = _WIDE * number + k, bounds[k]
                    levels[count] = level - 1
                    count += 1
    return places


@njit(inline="always")
def _to_boxes(p, boxes, out):  # type: ignore[no-untyped-def]
    """The squares of a point's distances to boxes (6, 8)."""
    px, py, pz = p  # not read again for each lane, as ``out`` might be the same
    for k in range(_WIDE):
        x = max(max(boxes[0, k] - px, px - boxes[3, k]), 0.0)
        y = max(max(boxes[1, k] - py, py - boxes[4, k]), 0.0)
        z = max(max(boxes[2, k] - pz, pz - boxes[5, k]), 0.0)
        out[k] = x * x + y * y + z * z


@njit(inline="always")
def _to_triangles(p, leaf, out):  # type: ignore[no-untyped-def]
    """Not above the squares of a point's distances to a leaf's triangles: those to discs about
    them (balls, if they are lines)."""
    px, py, pz = p
    for k in range(_WIDE):
        x, y, z = px - leaf[0, k], py - leaf[1, k], pz - leaf[2, k]
        height = x * leaf[3, k] + y * leaf[4, k] + z * leaf[5, k]
        aside = np.sqrt(max(x * x + y * y + z * z - height * height, 0.0)) - leaf[6, k]
        out[k] = height * height + max(aside, 0.0) ** 2


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


@njit(nogil=True)
def spread(triangles, spacing):  # type: ignore[no-untyped-def]
    """Points on triangles (f, 3, 3), and each one's area: see ``mesh_query.surface_samples``."""
    cuts = np.empty(len(triangles), np.int64)
    for f in range(len(triangles)):
        longest = 0.0
        for corner in range(3):
            edge = triangles[f, corner] - triangles[f, corner - 1]
            longest = max(longest, np.sqrt(edge[0] ** 2 + edge[1] ** 2 + edge[2] ** 2))
        cuts[f] = max(np.ceil(longest / spacing), 1)
    points, areas, at = np.empty((np.sum(cuts**2), 3)), np.empty(np.sum(cuts**2)), 0
    for f in range(len(triangles)):
        (a, b, c), n = triangles[f], cuts[f]
        x = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        y = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        z = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        for row in range(n):
            for place in range(2 * row + 1):  # pointing up (even) and down (odd) in turn
                down = place % 2
                third = 2 / 3 if down else 1 / 3
                u, v = (row - place // 2 - down + third) / n, (place // 2 + third) / n
                for axis in range(3):
                    own = a[axis]
                    points[at, axis] = own + u * (b[axis] - own) + v * (c[axis] - own)
                areas[at] = np.sqrt(x * x + y * y + z * z) / 2 / n**2
                at += 1
    return points, areas


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
