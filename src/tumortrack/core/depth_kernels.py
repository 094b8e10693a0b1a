"""Compiled work of ``noise`` on each pixel with a return; imported on first use."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from scipy.special import ndtri

from tumortrack.native import F32, F64, I32, kernel

# Of the normal distribution: a hash's low 14 bits choose one. Scaled to variance 1.
_QUANTILES = ndtri((np.arange(2**14) + 0.5) / 2**14)
_QUANTILES = (_QUANTILES / _QUANTILES.std()).astype(np.float32)

_DEPTH = F32["height", "width"].any_value  # NaN: no return
_SEEN = I32["n"], I32["starts"]
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


# Drops pixels that see a surface at grazing angles. Depths, their list, what it lists, key, the
# share that is lost, the cosine from which; the camera, squared tangents of the columns.
lose_grazing = kernel(
    "lose_grazing",
    *(_DEPTH, F32["n"].out, _SEEN, int, float, float, (float,) * 4, F64["width"]),
)
# Sends edge pixels backwards: those within so many px of which the depth falls back by a step or
# more, or ends; the image's own border is no edge. Depths, their list, what it lists, key; the
# share of edge pixels, how far behind the edge they end up at most, px, mm of a step.
fly = kernel("fly", _DEPTH, F32["n"].out, _SEEN, int, (float, float, int, float))
# Adds noise to depths. Of these pixels, by key: its relative size, the weights of each pixel's own
# and of that of a smooth field, which follows.
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
