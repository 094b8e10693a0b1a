"""The paper's method (its section "Integration with Robotic Resection"): it knows the tip alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack_resection.facets import Vector
from tumortrack_resection.outline import common, concave_hull, evenly, grown, rings_of
from tumortrack_resection.values import Cut, Located, ResectionConfig


def published_cuts(
    located: Located, label: int, config: ResectionConfig
) -> tuple[tuple[Cut, ...], Float64[np.ndarray, "n 2"], float, Vector]:
    """The paper's strokes (its section II-D), the outline and the lower end of the piece, and the
    grasp point.

    The tumor's points are projected on the table's plane; their concave hull, grown by the margin
    and clipped to the organ's projection, is cut along twice: at the middle of the tumor's bounding
    box, and on the box's lower face. Held is the tumor's centre of mass, carried up to the top of
    the box. NoPlan where there is no contour.
    """
    tumor = located.of(label)
    low, high = float(tumor[:, 2].min()), float(tumor[:, 2].max())
    wide = grown(concave_hull(tumor[:, :2]), config.margin_mm)
    ring = rings_of(common(wide, concave_hull(located.points_mm[:, :2])))[0]
    flat = evenly(np.concatenate([ring, ring[:1]]), config.spacing_mm)
    heights = ((low + high) / 2, low)
    cuts = tuple(
        Cut(sweep, np.column_stack([flat, np.full(len(flat), height)]))
        for sweep, height in enumerate(heights, start=1)
    )
    x, y, _ = tumor.mean(0)
    return cuts, ring, low, np.array([x, y, high], float)
