"""The renderer's inner loops: which triangle a pixel sees, and in what light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from tumortrack.core.compiled import njit


class Triangles(NamedTuple):
    """Of many bodies, world frame, mm: each one's corners, their normals, and its colour."""

    corners: Float32[np.ndarray, "t 3 3"]
    normals: Float32[np.ndarray, "t 3 3"]
    colors: Float32[np.ndarray, "t 3"]


@njit(nogil=True)
def _dot(one, two):  # type: ignore[no-untyped-def]
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]


@njit(nogil=True)
def mean_normals(corner, weighted, facing, cosine):  # type: ignore[no-untyped-def]
    """Unit normals (f, 3, 3), float32, of faces' corners (3 f,), numbers of places: the mean of the
    ``weighted`` normals (f, 3) of the faces about the same place whose unit normals (``facing``)
    have at least this cosine to its own."""
    # The faces about place p are sharers[first[p] : first[p + 1]].
    places = corner.max() + 1 if len(corner) else 0
    first, sharers = np.zeros(places + 1, np.int64), np.empty(len(corner), np.int64)
    for place in corner:
        first[place + 1] += 1
    first = np.cumsum(first)
    filled = first.copy()
    for c in range(len(corner)):
        sharers[filled[corner[c]]] = c // 3
        filled[corner[c]] += 1
    out = np.empty((len(facing), 3, 3), np.float32)
    for c in range(len(corner)):
        own, x, y, z = facing[c // 3], 0.0, 0.0, 0.0
        for n in range(first[corner[c]], first[corner[c] + 1]):
            beside = sharers[n]
            if _dot(facing[beside], own) > cosine:
                x += weighted[beside, 0]
                y += weighted[beside, 1]
                z += weighted[beside, 2]
        long = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normal = out[c // 3, c % 3]
        normal[0], normal[1], normal[2] = x / long, y / long, z / long
    return out


@njit(nogil=True)
def nearest(seen, width, height, limit, perspective):  # type: ignore[no-untyped-def]
    """Greatest nearness up to the limit in each pixel (-inf: nothing) and whose it is (-1).

    Seen (t, 3, 3) are the corners' column, row and nearness, linear in the picture. In perspective
    a triangle that reaches behind the eye (nearness 0 or less) is left out.
    """
    near = np.full((height, width), -np.inf, np.float32)
    winner = np.full((height, width), -1, np.int32)
    for t in range(len(seen)):
        ua, va, na = seen[t, 0]
        ub, vb, nb = seen[t, 1]
        uc, vc, nc = seen[t, 2]
        if perspective and min(na, nb, nc) <= 0:
            continue
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0:
            continue
        top = max(int(np.ceil(min(va, vb, vc))), 0)
        bottom = min(int(np.floor(max(va, vb, vc))), height - 1)
        # Along a row nearness is slope * x + constant.
        slope = (na * (vb - vc) + nb * (vc - va) + nc * (va - vb)) / area
        rise = (na * (uc - ub) + nb * (ua - uc) + nc * (ub - ua)) / area
        for y in range(top, bottom + 1):
            start, end = np.float32(np.inf), np.float32(-np.inf)
            for u, v, to_u, to_v in ((ua, va, ub, vb), (ub, vb, uc, vc), (uc, vc, ua, va)):
                if min(v, to_v) <= y <= max(v, to_v):
                    at = u + (y - v) * (to_u - u) / (to_v - v) if to_v != v else u
                    start, end = min(start, at), max(end, at)
                    if to_v == v:
                        start, end = min(start, to_u), max(end, to_u)
            left = max(int(np.ceil(start - 1e-3)), 0)  # no cracks between neighbours
            right = min(int(np.floor(end + 1e-3)), width - 1)
            here = na + slope * (left - ua) + rise * (y - va)
            for x in range(left, right + 1):
                if near[y, x] < here <= limit:
                    near[y, x] = here
                    winner[y, x] = t
                here += slope
    return near, winner


@njit(nogil=True)
def _shares(seen, x, y, perspective):  # type: ignore[no-untyped-def]
    """How much of each corner there is in a pixel of a triangle."""
    ua, va, na = seen[0]
    ub, vb, nb = seen[1]
    uc, vc, nc = seen[2]
    area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
    a = ((ub - x) * (vc - y) - (vb - y) * (uc - x)) / area
    b = ((uc - x) * (va - y) - (vc - y) * (ua - x)) / area
    c = np.float32(1.0) - a - b
    if perspective:
        a, b, c = a * na, b * nb, c * nc
        whole = a + b + c
        a, b, c = a / whole, b / whole, c / whole
    return a, b, c


@njit(nogil=True)
def _mixed(of, shares):  # type: ignore[no-untyped-def]
    a, b, c = shares
    x = a * of[0, 0] + b * of[1, 0] + c * of[2, 0]
    y = a * of[0, 1] + b * of[1, 1] + c * of[2, 1]
    return x, y, a * of[0, 2] + b * of[1, 2] + c * of[2, 2]


@njit(nogil=True)
def shade(picture, winner, seen, triangles, light, eye, opacity):  # type: ignore[no-untyped-def]
    """Lay each pixel's triangle (-1: none) over what is there; a diffuse light, a little gloss.

    Seen as in ``nearest``; the light is a direction towards it and one where the rest of the light
    comes from; the eye is a place and whether it sees in perspective.
    """
    (place, perspective), (sun, up) = eye, light
    for y in range(winner.shape[0]):
        for x in range(winner.shape[1]):
            t = winner[y, x]
            if t < 0:
                continue
            shares = _shares(seen[t], x, y, perspective)
            spot = _mixed(triangles.corners[t], shares)
            normal = _mixed(triangles.normals[t], shares)
            view = (place[0] - spot[0], place[1] - spot[1], place[2] - spot[2])
            scale = 1 / max(np.sqrt(_dot(normal, normal)), 1e-12)
            far = 1 / np.sqrt(_dot(view, view))
            toward = _dot(normal, view) * far * scale
            scale = scale if toward >= 0 else -scale  # of a surface seen from behind
            lit, gloss = max(_dot(normal, sun) * scale, 0.0), 0.0
            if lit > 0:  # about the direction half way between the light and the viewer
                half = (sun[0] + view[0] * far, sun[1] + view[1] * far, sun[2] + view[2] * far)
                gloss = _dot(normal, half) * scale / np.sqrt(_dot(half, half))
                gloss = 0.16 * max(gloss, 0.0) ** 40
            strength = 0.46 + 0.1 * _dot(normal, up) * scale + 0.5 * lit
            slant = 1 - abs(toward)
            cover = opacity + (1 - opacity) * 0.75 * slant * slant
            for d in range(3):
                own = min(triangles.colors[t, d] * strength + gloss, 1.0)
                picture[y, x, d] += cover * (own - picture[y, x, d])
