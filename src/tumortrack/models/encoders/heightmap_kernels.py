"""Kernel: a cloud's height map."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def spread(places, heights, weight, height):  # type: ignore[no-untyped-def]
    """Share each point among the four pixels about it: add the shares to ``weight`` and share times
    height to ``height`` (B, rows, columns). ``places`` (B, N, 2) are columns and rows; float32."""
    one = np.float32(1)
    rows, columns = weight.shape[1:]
    for b in range(len(places)):
        for p in range(places.shape[1]):
            x, y = places[b, p, 0], places[b, p, 1]
            left, upper = np.floor(x), np.floor(y)
            along, down = x - left, y - upper
            for below in range(2):
                row = int(upper) + below
                if not 0 <= row < rows:
                    continue
                part = down if below else one - down
                for right in range(2):
                    column = int(left) + right
                    if 0 <= column < columns:
                        share = part * (along if right else one - along)
                        weight[b, row, column] += share
                        height[b, row, column] += share * heights[b, p]
