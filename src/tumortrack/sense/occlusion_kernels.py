"""The per-pixel work of occlusion, compiled; opened by ``occlusion.occlude`` on first use.

Pixels that are seen come as flat lists. What hides them is an order: the lowest values go first,
infinity never goes.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_BINS = 1024

_jit = numba.njit(cache=True, nogil=True)  # no fast-math: a frame replays on every machine


@_jit
def seen_pixels(depth_mm):  # type: ignore[no-untyped-def]
    """Columns, rows and depths (n,) of the pixels with a return, in row-major order."""
    height, width = depth_mm.shape
    count = 0
    for v in range(height):
        for u in range(width):
            count += not math.isnan(depth_mm[v, u])
    columns, rows = np.empty(count, np.int32), np.empty(count, np.int32)
    seen_mm = np.empty(count, np.float32)
    place = 0
    for v in range(height):
        for u in range(width):
            if not math.isnan(depth_mm[v, u]):
                columns[place], rows[place], seen_mm[place] = u, v, depth_mm[v, u]
                place += 1
    return columns, rows, seen_mm


@_jit
def order_shaft(columns, rows, tip, towards, half, taper):  # type: ignore[no-untyped-def]
    """A straight band that comes in against ``towards`` (unit vector, px) and ends round at
    ``tip`` (px), ``half`` wide there to either side and wider by ``taper`` a pixel outwards.
    What lies farthest out goes first, as when it is pushed in."""
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
    """Mark in ``taken`` the first ``count`` pixels not taken yet, or a few less (a histogram's
    bin goes whole or not at all); returns how many."""
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
