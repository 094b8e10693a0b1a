"""The per-pixel work of ``noise``, compiled; imported on first use.

An organ fills a tenth of an image: kernels visit only the pixels with a return, which
``seen_pixels`` finds once, and change a list of their depths.

Noise is hashed from (key, pixel) with SplitMix64 (Steele, Lea and Flood 2014,
doi 10.1145/2660193.2660195): no state, a few ns each, and no pixel's number depends on the others.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from scipy.special import ndtri

# Quantiles of the normal distribution: a hash's low 14 bits choose one. Scaled to variance 1.
_QUANTILES = ndtri((np.arange(2**14) + 0.5) / 2**14)
_QUANTILES = (_QUANTILES / _QUANTILES.std()).astype(np.float32)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S32 = (np.uint64(s) for s in (27, 30, 31, 32))
_LOW_14, _LOW_32 = np.uint64(0x3FFF), np.uint64(0xFFFFFFFF)
_TO_UNIT = 2.0**-32

_NO_RETURN = np.float32(np.nan)

_jit = numba.njit(cache=True, nogil=True)  # no fast-math: a frame replays on every machine


class Seen(NamedTuple):
    """The n pixels with a return: their flat indices, row by row (n,), and where each of the h
    rows starts among them (h + 1,); both int32."""

    pixels: np.ndarray
    starts: np.ndarray


@numba.njit(cache=True, inline="always")
def _bits(key, counter):  # type: ignore[no-untyped-def]
    z = np.uint64(key) + np.uint64(counter + 1) * _GOLDEN
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


def seen_pixels(depth_mm: np.ndarray) -> Seen:
    """The pixels of ``depth_mm`` (h, w) that are not NaN."""
    height, width = depth_mm.shape
    pixels = np.flatnonzero(~np.isnan(depth_mm)).astype(np.int32)
    starts = np.searchsorted(pixels, np.arange(height + 1, dtype=np.int32) * np.int32(width))
    return Seen(pixels, starts.astype(np.int32))


@_jit
def lose_grazing(true_mm, depths_mm, seen, key, grazing):  # type: ignore[no-untyped-def]
    """Drop pixels that see a surface at grazing angles; ``grazing``: (share that is dropped, from
    how many degrees between the normal and the line of sight, fx, fy, cx, cy).

    With the depth's slopes (p, q) per pixel the surface normal is n = (fx p, fy q,
    -(z + (u - cx) p + (v - cy) q)), and its product with the line of sight r is -z.
    """
    share, degrees, fx, fy, cx, cy = grazing
    pixels, starts = seen
    height, width = true_mm.shape
    cosine = math.cos(math.radians(degrees))
    across = ((np.arange(width) - cx) / fx) ** 2
    for v in range(height):
        down = ((v - cy) / fy) ** 2
        for i in range(starts[v], starts[v + 1]):
            u = pixels[i] - v * width
            z = true_mm[v, u]
            left = true_mm[v, u - 1] if u > 0 else _NO_RETURN
            right = true_mm[v, u + 1] if u + 1 < width else _NO_RETURN
            above = true_mm[v - 1, u] if v > 0 else _NO_RETURN
            below = true_mm[v + 1, u] if v + 1 < height else _NO_RETURN
            p, q = _slope(left, z, right), _slope(above, z, below)
            along = z + (u - cx) * p + (v - cy) * q
            normal = (fx * p) ** 2 + (fy * q) ** 2 + along**2
            if z * z < cosine * cosine * normal * (across[u] + down + 1):
                chance = (_bits(key, pixels[i]) & _LOW_32) * _TO_UNIT
                if chance < share:
                    depths_mm[i] = np.nan


@numba.njit(cache=True, inline="always")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    if math.isnan(before):
        return np.float32(0) if math.isnan(after) else after - here
    return here - before if math.isnan(after) else (after - before) * np.float32(0.5)


@_jit
def fly(true_mm, depths_mm, seen, key, flying):  # type: ignore[no-untyped-def]
    """Send edge pixels backwards. ``flying``: the share of edge pixels, how far behind the edge
    they end up at most, and what is an edge: within so many pixels the depth falls back by so many
    mm or more, or ends. The image's own border is no edge: what it cuts off continues outside."""
    share, flying_mm, near, step_mm = flying
    pixels, starts = seen
    height, width = true_mm.shape
    for v in range(height):
        for i in range(starts[v], starts[v + 1]):
            u = pixels[i] - v * width
            z = true_mm[v, u]
            above = true_mm[v - near, u] if v >= near else z
            below = true_mm[v + near, u] if v + near < height else z
            left = true_mm[v, u - near] if u >= near else z
            right = true_mm[v, u + near] if u + near < width else z
            # A sum with no number in it is none either.
            if math.isnan(above + below + left + right):
                farthest, gap = z, flying_mm
                for other in (above, below, left, right):
                    farthest = farthest if math.isnan(other) else max(farthest, other)
                gap = max(gap, farthest - z)
            else:
                gap = max(max(max(above, below), max(left, right)) - z, 0.0)
            if gap >= step_mm:
                bits = _bits(key, pixels[i])
                if (bits & _LOW_32) * _TO_UNIT < share:
                    depths_mm[i] = z + (bits >> _S32) * _TO_UNIT * min(gap, flying_mm)


@numba.njit(cache=True, inline="always")
def _weights(step):  # type: ignore[no-untyped-def]
    """Linear interpolation scaled so that the variance stays 1 between the nodes too."""
    first, second = np.empty(step, np.float32), np.empty(step, np.float32)
    for phase in range(step):
        a = phase / step
        length = math.sqrt((1 - a) ** 2 + a**2)
        first[phase], second[phase] = (1 - a) / length, a / length
    return first, second


@_jit
def jitter(depths_mm, seen, key, relative, correlated_share, smooth):  # type: ignore[no-untyped-def]
    """Add noise of standard deviation ``relative * z^2``, part of its variance from ``smooth``."""
    pixels, _ = seen
    own_weight = np.float32(math.sqrt(1 - correlated_share))
    common_weight = np.float32(math.sqrt(correlated_share))
    for i in range(len(pixels)):
        z = depths_mm[i]
        own = _QUANTILES[_bits(key, pixels[i]) & _LOW_14]
        noise = own_weight * own + common_weight * smooth[i]
        depths_mm[i] = z + np.float32(relative) * z * z * noise


@_jit
def smooth_at(seen, shape, step, key):  # type: ignore[no-untyped-def]
    """A smooth random field, correlated over ``step`` pixels and standard normal in each, at the
    seen pixels of an image of that shape."""
    pixels, starts = seen
    height, width = shape
    # Standard normal values on every ``step``-th pixel, one node beyond the image.
    rows, columns = height // step + 2, width // step + 2
    grid = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            grid[i, j] = _QUANTILES[_bits(key, i * columns + j) & _LOW_14]
    first, second = _weights(step)
    out = np.empty(len(pixels), np.float32)
    row = np.empty(width + step, np.float32)
    for v in range(height):
        if starts[v] == starts[v + 1]:
            continue
        left, right = pixels[starts[v]] - v * width, pixels[starts[v + 1] - 1] - v * width
        top, phase_v = v // step, v % step
        for node in range(left // step, right // step + 1):
            one = first[phase_v] * grid[top, node] + second[phase_v] * grid[top + 1, node]
            two = first[phase_v] * grid[top, node + 1] + second[phase_v] * grid[top + 1, node + 1]
            for phase in range(step):
                row[node * step + phase] = first[phase] * one + second[phase] * two
        for i in range(starts[v], starts[v + 1]):
            out[i] = row[pixels[i] - v * width]
    return out


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


@_jit
def wave(length, waves):  # type: ignore[no-untyped-def]
    """The sum of waves (k, 3), of frequency (rad/px), phase and height, at the first pixels."""
    out = np.zeros(length, np.float32)
    for frequency, phase, height in waves:
        for place in range(length):
            out[place] += height * math.cos(frequency * place + phase)
    return out
