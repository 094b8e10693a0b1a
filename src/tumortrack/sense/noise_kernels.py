"""The parts of the noise model, compiled; opened by ``noise.add_noise`` on first use.

Random numbers come from hashing (key, pixel) with SplitMix64 (Steele, Lea and Flood 2014,
doi 10.1145/2660193.2660195): no state, a few ns each, and a pixel's number does not depend on
what happened to the others.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from scipy.special import ndtri

from tumortrack.core.types import Intrinsics

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


@numba.njit(cache=True, inline="always")
def _bits(key, counter):  # type: ignore[no-untyped-def]
    z = np.uint64(key) + np.uint64(counter + 1) * _GOLDEN
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@_jit
def lose_grazing(true_mm, out_mm, key, share, degrees, pinhole):  # type: ignore[no-untyped-def]
    """Drop ``share`` of the pixels whose normal is over ``degrees`` from the line of sight.

    With the depth's slopes (p, q) per pixel the surface normal is n = (fx p, fy q,
    -(z + (u - cx) p + (v - cy) q)), and its product with the line of sight r is -z.
    """
    fx, fy, cx, cy = pinhole
    height, width = true_mm.shape
    cosine = math.cos(math.radians(degrees))
    for v in range(height):
        for u in range(width):
            z = true_mm[v, u]
            if math.isnan(z):
                continue
            left = true_mm[v, u - 1] if u > 0 else _NO_RETURN
            right = true_mm[v, u + 1] if u + 1 < width else _NO_RETURN
            above = true_mm[v - 1, u] if v > 0 else _NO_RETURN
            below = true_mm[v + 1, u] if v + 1 < height else _NO_RETURN
            p, q = _slope(left, z, right), _slope(above, z, below)
            along = z + (u - cx) * p + (v - cy) * q
            normal = (fx * p) ** 2 + (fy * q) ** 2 + along**2
            sight = ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2 + 1
            if z * z < cosine * cosine * normal * sight:
                chance = (_bits(key, v * width + u) & _LOW_32) * _TO_UNIT
                if chance < share:
                    out_mm[v, u] = np.nan


@numba.njit(cache=True, inline="always")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    if math.isnan(before):
        return np.float32(0) if math.isnan(after) else after - here
    return here - before if math.isnan(after) else (after - before) * np.float32(0.5)


@_jit
def fly(true_mm, out_mm, key, share, flying_mm, edge):  # type: ignore[no-untyped-def]
    """Send ``share`` of the edge pixels backwards; ``edge``: (how near in px, depth step in mm).

    The image's own border is no edge: what it cuts off goes on outside.
    """
    near_px, step_mm = edge
    height, width = true_mm.shape
    for v in range(height):
        for u in range(width):
            z = true_mm[v, u]
            if math.isnan(z):
                continue
            gap = 0.0
            for dv, du in ((-near_px, 0), (near_px, 0), (0, -near_px), (0, near_px)):
                if 0 <= v + dv < height and 0 <= u + du < width:
                    other = true_mm[v + dv, u + du]
                    gap = max(gap, flying_mm if math.isnan(other) else other - z)
            if gap >= step_mm:
                bits = _bits(key, v * width + u)
                if (bits & _LOW_32) * _TO_UNIT < share:
                    out_mm[v, u] = z + (bits >> _S32) * _TO_UNIT * min(gap, flying_mm)


@_jit
def normal_grid(height, width, step, key):  # type: ignore[no-untyped-def]
    """Standard normal values on every ``step``-th pixel, one node beyond the image."""
    rows, columns = height // step + 2, width // step + 2
    grid = np.empty((rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            grid[i, j] = _QUANTILES[_bits(key, i * columns + j) & _LOW_14]
    return grid


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
def smooth_row(grid, step, v, out):  # type: ignore[no-untyped-def]
    """Row ``v`` of the smooth field that the grid spans (each pixel standard normal)."""
    first, second = _weights(step)
    top, phase_v = v // step, v % step
    width = len(out)
    for node in range((width - 1) // step + 1):
        left = first[phase_v] * grid[top, node] + second[phase_v] * grid[top + 1, node]
        right = first[phase_v] * grid[top, node + 1] + second[phase_v] * grid[top + 1, node + 1]
        for phase in range(min(step, width - node * step)):
            out[node * step + phase] = first[phase] * left + second[phase] * right


@_jit
def jitter(out_mm, key, relative, correlated_share, grid, step):  # type: ignore[no-untyped-def]
    """Add noise of standard deviation ``relative * z^2``, part of its variance from the grid."""
    height, width = out_mm.shape
    smooth = np.empty(width, np.float32)
    own_weight = np.float32(math.sqrt(1 - correlated_share))
    common_weight = np.float32(math.sqrt(correlated_share))
    for v in range(height):
        smooth_row(grid, step, v, smooth)
        for u in range(width):
            z = out_mm[v, u]
            if not math.isnan(z):
                own = _QUANTILES[_bits(key, v * width + u) & _LOW_14]
                noise = own_weight * own + common_weight * smooth[u]
                out_mm[v, u] = z + np.float32(relative) * z * z * noise


@_jit
def lose_blobs(out_mm, threshold, grid, step):  # type: ignore[no-untyped-def]
    """Drop the pixels where the smooth field lies below ``threshold``."""
    height, width = out_mm.shape
    smooth = np.empty(width, np.float32)
    for v in range(height):
        smooth_row(grid, step, v, smooth)
        for u in range(width):
            if smooth[u] < threshold:
                out_mm[v, u] = np.nan


def slow_field(shape: tuple[int, int], peak: float, rng: np.random.Generator) -> np.ndarray:
    """A random sum of the lowest 3 x 3 cosines over the image, its largest magnitude ``peak``."""
    rows, columns = (
        np.cos(np.pi * np.outer((np.arange(n) + 0.5) / n, np.arange(3))).astype(np.float32)
        for n in shape
    )
    field = (rows @ rng.standard_normal((3, 3), np.float32)) @ columns.T
    field *= np.float32(peak) / max(field.max(), -field.min())
    return field


def pinhole(intrinsics: Intrinsics) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy), as the kernels take it."""
    return intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
