"""The per-pixel work of ``noise`` and ``occlusion``, compiled; imported on first use.

An organ fills a tenth of an image: kernels visit only the pixels with a return, which
``seen_pixels`` finds once, and change a list of their depths.

Noise is hashed from (key, pixel) with SplitMix64 (Steele, Lea and Flood 2014,
doi 10.1145/2660193.2660195): no state, a few ns each, and no pixel's number depends on the others.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from tumortrack.core.compiled import njit

# Quantiles of the normal distribution: a hash's low 14 bits choose one. Scaled to variance 1.
_QUANTILES = np.array([NormalDist().inv_cdf((n + 0.5) / 2**14) for n in range(2**14)])
_QUANTILES = (_QUANTILES / _QUANTILES.std()).astype(np.float32)
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S32 = (np.uint64(s) for s in (27, 30, 31, 32))
_LOW_14, _LOW_32 = np.uint64(0x3FFF), np.uint64(0xFFFFFFFF)
_TO_UNIT = 2.0**-32

_NO_RETURN = np.float32(np.nan)
_BINS = 1024  # of the histogram in ``take_first``

_jit = njit(nogil=True)  # no fast-math: a frame replays on every machine


class Seen(NamedTuple):
    """The n pixels with a return: their flat indices, row by row (n,), and where each of the h
    rows starts among them (h + 1,); both int32."""

    pixels: np.ndarray
    starts: np.ndarray


@njit(inline="always")
def _bits(key, counter):  # type: ignore[no-untyped-def]
    z = np.uint64(key) + np.uint64(counter + 1) * _GOLDEN
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@_jit
def seen_pixels(depth_mm):  # type: ignore[no-untyped-def]
    """The pixels of ``depth_mm`` (h, w) that are not NaN, as ``Seen``."""
    height, width = depth_mm.shape
    starts = np.zeros(height + 1, np.int32)
    for v in range(height):
        count = np.int32(0)
        for u in range(width):
            count += np.int32(depth_mm[v, u] == depth_mm[v, u])
        starts[v + 1] = starts[v] + count
    pixels = np.empty(starts[height], np.int32)
    for v in range(height):
        at, last = starts[v], starts[v + 1]
        u = 0
        while at < last:
            pixels[at] = v * width + u
            at += not math.isnan(depth_mm[v, u])
            u += 1
    return Seen(pixels, starts)


@_jit
def lose_grazing(true_mm, depths_mm, seen, key, grazing, pinhole):  # type: ignore[no-untyped-def]
    """Drop pixels that see a surface at grazing angles; ``grazing``: (share that is dropped, from
    how many degrees between the normal and the line of sight).

    With the depth's slopes (p, q) per pixel the surface normal is n = (fx p, fy q,
    -(z + (u - cx) p + (v - cy) q)), and its product with the line of sight r is -z.
    """
    share, degrees = grazing
    fx, fy, cx, cy = pinhole
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


@njit(inline="always")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    if math.isnan(before):
        return np.float32(0) if math.isnan(after) else after - here
    return here - before if math.isnan(after) else (after - before) * np.float32(0.5)


class Flying(NamedTuple):
    """Flying pixels: the share of edge pixels, how far behind the edge they end up at most, and
    what is an edge: within ``near_px`` the depth falls back by ``step_mm`` or more, or ends."""

    share: float
    reach_mm: float
    near_px: int
    step_mm: float


@_jit
def fly(true_mm, depths_mm, seen, key, flying):  # type: ignore[no-untyped-def]
    """Send edge pixels backwards, as ``Flying`` states. The image's own border is no edge: what it
    cuts off continues outside."""
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


@njit(inline="always")
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
def order_shaft(columns, rows, tip, towards, half, taper):  # type: ignore[no-untyped-def]
    """A straight band that comes in against ``towards`` (unit vector, px) and ends round at
    ``tip`` (px), ``half`` wide there to either side and wider by ``taper`` a pixel outwards.
    What lies farthest out comes first, as when it is pushed in."""
    order = np.full(len(columns), np.inf, np.float32)
    for i in range(len(columns)):
        du, dv = columns[i] - tip[0], rows[i] - tip[1]
        along = du * towards[0] + dv * towards[1]
        across = abs(dv * towards[0] - du * towards[1])
        if along >= 0:
            if across < half + taper * along:
                order[i] = -along
        elif du * du + dv * dv < half * half:
            order[i] = -along
    return order


@_jit
def order_patch(columns, rows, start, axes, round_one, waves):  # type: ignore[no-untyped-def]
    """A patch with a wavy edge that grows from ``start`` (px): a blob or a half plane.

    ``axes`` (2, 2), 1/px: a blob's two lengths and directions; a half plane grows along the first.
    ``waves`` (2, k, 3): frequency (rad/px), phase and height of the edge's waves along the columns
    and along the rows.
    """
    along_u, along_v = _wave(columns.max() + 1, waves[0]), _wave(rows[-1] + 1, waves[1])
    order = np.empty(len(columns), np.float32)
    for i in range(len(columns)):
        du, dv = columns[i] - start[0], rows[i] - start[1]
        a = du * axes[0, 0] + dv * axes[0, 1]
        b = du * axes[1, 0] + dv * axes[1, 1]
        distance = math.sqrt(a * a + b * b) if round_one else a
        order[i] = distance + along_u[columns[i]] + along_v[rows[i]]
    return order


@_jit
def _wave(length, waves):  # type: ignore[no-untyped-def]
    out = np.zeros(length, np.float32)
    for frequency, phase, height in waves:
        for place in range(length):
            out[place] += height * math.cos(frequency * place + phase)
    return out


@_jit
def take_first(order, taken, count):  # type: ignore[no-untyped-def]
    """Mark in ``taken`` the ``count`` pixels of lowest ``order`` that are not taken yet, or a few
    less (whole bins of a histogram only); infinite ones never. Returns how many."""
    low, high, room = np.float32(np.inf), np.float32(-np.inf), 0
    for i in range(len(order)):
        if not taken[i] and order[i] < np.inf:
            low, high = min(low, order[i]), max(high, order[i])
            room += 1
    if room == 0:
        return 0
    scale = (_BINS - 1) / max(high - low, np.float32(1e-6))
    last = _BINS - 1
    if room > count:
        histogram = np.zeros(_BINS, np.int64)
        for i in range(len(order)):
            if not taken[i] and order[i] < np.inf:
                histogram[int((order[i] - low) * scale)] += 1
        total, last = 0, -1
        while total + histogram[last + 1] <= count:
            last += 1
            total += histogram[last]
    marked = 0
    for i in range(len(order)):
        if not taken[i] and order[i] < np.inf and int((order[i] - low) * scale) <= last:
            taken[i] = True
            marked += 1
    return marked
