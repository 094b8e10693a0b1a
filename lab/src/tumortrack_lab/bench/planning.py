"""Timing of resection planning: the plan, and the arms' motions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec

import numpy as np

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy
from tumortrack.imaging.raster import label_grid
from tumortrack_lab.bench.rows import MOTIONS, PLAN, Workload
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.twin.apparatus import moved
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import STAND_MM
from tumortrack_resection.values import Located, ResectionConfig

_POINTS = 40_000
_FRONT_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # of LPS


def workloads(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Both planners; motions where the arms' libraries are installed."""
    located = on_its_stand(subject.anatomy)
    published, ours = ResectionConfig(method="published"), ResectionConfig()
    for name, config in (("published", published), ("margin", ours)):
        plan = partial(plan_resection, located, config)
        yield Workload(PLAN, f"{name}, {_POINTS:,} points", "plan", plan)
    if find_spec("pinocchio") is None:  # the extra `arms`
        return
    from tumortrack_resection.arms.body import cell_urdf
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.arms.procedure import plan_motions
    from tumortrack_resection.check import checked
    from tumortrack_resection.planning import below

    cell = below(located.organ, CellConfig())
    plan_both = partial(plan_motions, located, ours, cell)
    made, motions = plan_both()
    yield Workload(MOTIONS, f"margin, {made.sweeps} sweeps, the plan included", "plan", plan_both)
    check = partial(checked, made, motions, cell_urdf(cell), located)
    yield Workload(MOTIONS, "their check", "plan", check)


def on_its_stand(anatomy_ct: Anatomy, turn: np.ndarray = _FRONT_UP) -> Located:
    """An organ, turned so (3, 3): 40,000 points inside, and its surfaces."""
    organ = anatomy_ct.organ.vertices_mm @ turn.T
    x, y, _ = -(organ.min(0) + organ.max(0)) / 2
    placed = moved(anatomy_ct, rigid(turn, np.array([x, y, STAND_MM - organ[:, 2].min()])))
    low = placed.organ.box_mm[0] - 2
    i, j, k = (int(n) for n in np.ceil(np.ptp(placed.organ.box_mm, axis=0) + 4))
    grid = label_grid(placed, rigid(np.eye(3), low), (i, j, k))
    rng = np.random.default_rng(0)
    cells = np.argwhere(grid > 0)
    chosen = cells[rng.integers(len(cells), size=_POINTS)]
    points = chosen + rng.uniform(-0.5, 0.5, chosen.shape) + low
    return Located(
        points, grid[tuple(chosen.T)], dict(zip(placed.names, placed.parts, strict=True))
    )
