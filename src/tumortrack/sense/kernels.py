"""The per-pixel work of ``noise`` and ``occlusion``, compiled; imported on first use."""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from tumortrack.native import F32, F64, I32, I64, U8, kernel
from tumortrack.sense.camera import Pinhole

# Quantiles of the normal distribution: a hash's low 14 bits choose one. Scaled to variance 1.
_QUANTILES = np.array([NormalDist().inv_cdf((n + 0.5) / 2**14) for n in range(2**14)])
_QUANTILES = (_QUANTILES / _QUANTILES.std()).astype(np.float32)
_BINS = 1024  # of the histogram in ``take_first``

_DEPTH = F32["height", "width"].any_value  # NaN: no return
_SEEN = I32["n"], I32["starts"]
_PINHOLE, _TWO = (float,) * 4, (float, float)
_TABLE = F32[len(_QUANTILES)].any_value


class Seen(NamedTuple):
    """The n pixels with a return: their flat indices, row by row (n,), and where each of the h
    rows starts among them (h + 1,); both int32."""

    pixels: np.ndarray
    starts: np.ndarray


# Lists the pixels that are not NaN, where each row starts, and returns how many they are.
_seen_pixels = kernel("seen_pixels", _DEPTH, I32["size"].out, I32["starts"].out, result=int)


def seen_pixels(depth_mm: Float32[np.ndarray, "h w"]) -> Seen:
    """The pixels of a depth image that are not NaN."""
    pixels, starts = np.empty(depth_mm.size, np.int32), np.empty(len(depth_mm) + 1, np.int32)
    count = _seen_pixels(np.ascontiguousarray(depth_mm), pixels, starts)
    return Seen(pixels[:count], starts)


# Depths, their list, what it lists, key, share that is lost, the cosine from which; the camera,
# squared tangents of the columns.
_lose_grazing = kernel(
    "lose_grazing",
    *(_DEPTH, F32["n"].out, _SEEN, int, float, float, _PINHOLE, F64["width"]),
)


def lose_grazing(
    true_mm: Float32[np.ndarray, "h w"],
    depths_mm: Float32[np.ndarray, " n"],
    seen: Seen,
    key: int,
    grazing: tuple[float, float],
    pinhole: Pinhole,
) -> None:
    """Drop pixels that see a surface at grazing angles; ``grazing``: (share that is dropped, from
    how many degrees between the normal and the line of sight)."""
    share, degrees = grazing
    across = ((np.arange(true_mm.shape[1]) - pinhole.cx) / pinhole.fx) ** 2
    cosine = math.cos(math.radians(degrees))
    depth_mm = np.ascontiguousarray(true_mm)
    _lose_grazing(depth_mm, depths_mm, seen, key, share, cosine, pinhole, across)


class Flying(NamedTuple):
    """Flying pixels: the share of edge pixels, how far behind the edge they end up at most, and
    what is an edge: within ``near_px`` the depth falls back by ``step_mm`` or more, or ends."""

    share: float
    reach_mm: float
    near_px: int
    step_mm: float


# Depths, their list, what it lists, key, and how.
_fly = kernel("fly", _DEPTH, F32["n"].out, _SEEN, int, (float, float, int, float))


def fly(
    true_mm: Float32[np.ndarray, "h w"],
    depths_mm: Float32[np.ndarray, " n"],
    seen: Seen,
    key: int,
    flying: Flying,
) -> None:
    """Send edge pixels backwards, as ``Flying`` states. The image's own border is no edge: what it
    cuts off continues outside."""
    _fly(np.ascontiguousarray(true_mm), depths_mm, seen, key, flying)


# Adds to depths, of these pixels, by key: relative noise, the weights of each pixel's own and of
# that of a smooth field, which follows.
_jitter = kernel(
    "jitter", F32["n"].out, I32["n"], int, float, float, float, F32["n"].any_value, _TABLE
)


def jitter(
    depths_mm: Float32[np.ndarray, " n"],
    seen: Seen,
    key: int,
    relative: float,
    correlated_share: float,
    smooth: Float32[np.ndarray, " n"],
) -> None:
    """Add noise of standard deviation ``relative * z^2``, part of its variance from ``smooth``."""
    weights = math.sqrt(1 - correlated_share), math.sqrt(correlated_share)
    _jitter(depths_mm, seen.pixels, key, relative, *weights, smooth, _QUANTILES)


# What is seen, key, weights between the nodes, room for the nodes and for a row.
_smooth_at = kernel(
    "smooth_at",
    *(_SEEN, int, F32[2, "step"], _TABLE, F32["rows", "columns"].out, F32["row"].out, F32["n"].out),
)


def smooth_at(seen: Seen, shape: tuple[int, int], step: int, key: int) -> Float32[np.ndarray, " n"]:
    """A smooth random field, correlated over ``step`` pixels and standard normal in each, at the
    seen pixels of an image of that shape."""
    rows, columns = (n // step + 2 for n in shape)
    grid, row = np.empty((rows, columns), np.float32), np.empty(shape[1] + step, np.float32)
    out = np.empty(len(seen.pixels), np.float32)
    _smooth_at(seen, key, _weights(step), _QUANTILES, grid, row, out)
    return out


@lru_cache(maxsize=16)
def _weights(step: int) -> Float32[np.ndarray, "2 step"]:
    """Linear interpolation scaled so that the variance stays 1 between the nodes too."""
    a = np.arange(step) / step
    weights = (np.stack([1 - a, a]) / np.sqrt((1 - a) ** 2 + a**2)).astype(np.float32)
    weights.flags.writeable = False
    return weights


def slow_shape(
    shape: tuple[int, int], peak: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.float32]:
    """A random sum of the lowest 3 x 3 cosines over the image, as (field, factor): their product
    has ``peak`` as its largest magnitude, and callers that need few pixels multiply only those."""
    rows, columns = (_lowest_cosines(n) for n in shape)
    field = (rows @ rng.standard_normal((3, 3), np.float32)) @ columns.T
    return field, np.float32(peak) / max(field.max(), -field.min())


@lru_cache(maxsize=16)
def _lowest_cosines(n: int) -> np.ndarray:
    waves = np.cos(np.pi * np.outer((np.arange(n) + 0.5) / n, np.arange(3))).astype(np.float32)
    waves.flags.writeable = False
    return waves


# Columns, rows, tip, direction, half the width, taper.
_order_shaft = kernel("order_shaft", I32["n"], I32["n"], _TWO, _TWO, float, float, F32["n"].out)


def order_shaft(
    columns: Int32[np.ndarray, " n"],
    rows: Int32[np.ndarray, " n"],
    tip: Float64[np.ndarray, " 2"],
    towards: Float64[np.ndarray, " 2"],
    half: float,
    taper: float,
) -> Float32[np.ndarray, " n"]:
    """A straight band that comes in against ``towards`` (unit vector, px) and ends round at
    ``tip`` (px), ``half`` wide there to either side and wider by ``taper`` a pixel outwards.
    What lies farthest out comes first, as when it is pushed in."""
    order = np.empty(len(columns), np.float32)
    _order_shaft(columns, rows, tip, towards, half, taper, order)
    return order


# Columns, rows, start, axes, whether it is round, waves of its edge; room for these.
_order_patch = kernel(
    "order_patch",
    *(I32["n"], I32["n"], _TWO, (_TWO, _TWO), int, F64[2, "waves", 3]),
    *(F32["width"].out, F32["height"].out, F32["n"].out),
)


def order_patch(
    columns: Int32[np.ndarray, " n"],
    rows: Int32[np.ndarray, " n"],
    start: Float64[np.ndarray, " 2"],
    axes: Float64[np.ndarray, "2 2"],
    round_one: bool,
    waves: Float64[np.ndarray, "2 k 3"],
) -> Float32[np.ndarray, " n"]:
    """A patch with a wavy edge that grows from ``start`` (px): a blob or a half plane.

    ``axes``, 1/px: a blob's two lengths and directions; a half plane grows along the first.
    ``waves``: frequency (rad/px), phase and height of the edge's waves along the columns and along
    the rows.
    """
    along = (np.empty(places.max() + 1, np.float32) for places in (columns, rows))
    order = np.empty(len(columns), np.float32)
    _order_patch(columns, rows, start, axes, round_one, waves, *along, order)
    return order


# Order, what is taken, how many; a histogram. Both precisions are in use, and bins differ.
_take_first, _take_first_wide = (
    kernel(name, order["n"].any_value, U8["n"].out, int, I64[_BINS].out, result=int)
    for name, order in (("take_first", F32), ("take_first_wide", F64))
)


def take_first(order: Float[np.ndarray, " n"], taken: Bool[np.ndarray, " n"], count: int) -> int:
    """Mark in ``taken`` the ``count`` pixels of lowest ``order`` that are not taken yet, or a few
    less (whole bins of a histogram only); infinite ones never. Returns how many."""
    take = _take_first if order.dtype == np.float32 else _take_first_wide
    return int(take(order, taken.view(np.uint8), count, np.empty(_BINS, np.int64)))
