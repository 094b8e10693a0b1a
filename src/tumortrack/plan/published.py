"""The paper's planner: two sweeps round the tumor's grown projection (its section II-D)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.outline import common, concave_hull, evenly, grown, rings_of
from tumortrack.plan.values import Cut, CutLayer, Located


def published_plan(
    located: Located, label: int, config: ResectionConfig
) -> tuple[tuple[CutLayer, ...], tuple[Cut, ...], Float64[np.ndarray, " 3"]]:
    """The piece, the two sweeps, and where to hold; table frame, mm.

    The tumor's points are projected on the table's plane; their concave hull, grown by the margin
    and cut with the organ's projection, is walked along twice: at the middle of the tumor's
    bounding box, and on the box's lower face. Held is the tumor's centre of mass, carried up to the
    top of the box.

    Raises:
        NoPlan: there is no contour.
    """
    tumor = located.of(label)
    low, high = float(tumor[:, 2].min()), float(tumor[:, 2].max())
    zone = common(
        grown(concave_hull(tumor[:, :2]), config.margin_mm), concave_hull(located.points_mm[:, :2])
    )
    ring = rings_of(zone)[0]
    flat = evenly(np.concatenate([ring, ring[:1]]), config.spacing_mm)
    cuts = tuple(
        Cut(sweep, np.column_stack([flat, np.full(len(flat), height)]))
        for sweep, height in enumerate(((low + high) / 2, low), start=1)
    )
    x, y, _ = tumor.mean(0)
    return (CutLayer(low, np.inf, (ring,)),), cuts, np.array([x, y, high], float)
