"""The compiled part of ``plan.margin``."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def outline_fields(points, margins, levels, first, cell, fields):  # type: ignore[no-untyped-def]
    """For each level the signed distance (mm, near 0) to the outline of what comes away there.

    What comes away at a height is all that lies above the tumor grown by its margin: of each
    point a disc, as wide as its ball of the margin is at that height, and the whole ball's width
    above its middle.

    Args:
        points, margins: (n, 3) and (n,), mm.
        levels: heights (k,), mm.
        first, cell: x and y of the first grid point; distance between grid points, mm.
        fields: (k, nx, ny), large where nothing is near; filled.
    """
    n_levels, nx, ny = fields.shape
    for i in range(len(points)):
        x, y, z = points[i]
        margin = margins[i]
        for level in range(n_levels):
            rise = z - levels[level]
            if rise >= margin:
                continue
            radius = margin if rise <= 0 else np.sqrt(margin * margin - rise * rise)
            reach, core = radius + 2 * cell, max(0.0, radius - 2 * cell)
            left = max(0, int(np.ceil((x - reach - first[0]) / cell)))
            right = min(nx - 1, int(np.floor((x + reach - first[0]) / cell)))
            low = max(0, int(np.ceil((y - reach - first[1]) / cell)))
            high = min(ny - 1, int(np.floor((y + reach - first[1]) / cell)))
            for a in range(left, right + 1):
                across = first[0] + a * cell - x
                for b in range(low, high + 1):
                    along = first[1] + b * cell - y
                    square = across * across + along * along
                    if square >= reach * reach:
                        continue
                    # Deep inside it is enough to say so: only the outline's surroundings count.
                    off = core - radius if square < core * core else np.sqrt(square) - radius
                    if off < fields[level, a, b]:
                        fields[level, a, b] = off
