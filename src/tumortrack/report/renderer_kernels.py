"""The renderer's inner loops: which triangle a pixel sees, and in what light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from tumortrack.native import F32, F64, I32, I64, kernel


class Triangles(NamedTuple):
    """Of many bodies, world frame, mm: each one's corners, their normals, and its colour."""

    corners: Float32[np.ndarray, "t 3 3"]
    normals: Float32[np.ndarray, "t 3 3"]
    colors: Float32[np.ndarray, "t 3"]


_NORMALS = F64["f", 3], F64["f", 3], float, F32["f", 3, 3].out
_mean_normals = kernel("mean_normals", I64["f", 3], I64["ends"].out, I64["f", 3].out, *_NORMALS)


def mean_normals(
    corner: Int64[np.ndarray, "f 3"],
    weighted: Float64[np.ndarray, "f 3"],
    facing: Float64[np.ndarray, "f 3"],
    cosine: float,
) -> Float32[np.ndarray, "f 3 3"]:
    """Unit normals of faces' corners, numbers of places: the mean of the ``weighted``
    normals of the faces about the same place whose unit normals (``facing``) have at least this
    cosine to its own."""
    ends = np.append(np.cumsum(np.bincount(corner.ravel())), corner.size)  # of places' corners
    out = np.empty((len(corner), 3, 3), np.float32)
    _mean_normals(corner, ends, np.empty_like(corner), weighted, facing, cosine, out)
    return out


_SEEN = F32["t", 3, 3].any_value  # may overflow at the eye
_nearest = kernel("nearest", _SEEN, float, int, F32["h", "w"].out, I32["h", "w"].out)


def nearest(
    seen: Float32[np.ndarray, "t 3 3"], width: int, height: int, limit: float, perspective: bool
) -> tuple[Float32[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Greatest nearness up to the limit in each pixel (-inf: nothing) and whose it is (-1).

    Seen are the corners' column, row and nearness, linear in the picture. In perspective a triangle
    that reaches behind the eye (nearness 0 or less) is left out.
    """
    near = np.full((height, width), -np.inf, np.float32)
    winner = np.full((height, width), -1, np.int32)
    _nearest(seen, limit, perspective, near, winner)
    return near, winner


# Lays each pixel's triangle (``winner``, -1: none) over what is there; a diffuse light, a little
# gloss. The light is a direction towards it and one where the rest of the light comes from; the eye
# is a place and whether it sees in perspective; the last number is the opacity.
_TRIANGLES = F32["t", 3, 3].any_value, F32["t", 3, 3].any_value, F32["t", 3]
_LIGHT, _EYE = (F32[3], F32[3]), (F32[3], int)
shade = kernel("shade", F32["h", "w", 3].out, I32["h", "w"], _SEEN, _TRIANGLES, _LIGHT, _EYE, float)
