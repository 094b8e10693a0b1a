"""Workloads of planning a resection: the plan, and the arms' motions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec

import numpy as np

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy
from tumortrack.imaging.raster import label_grid
from tumortrack.plan.located import STAND_MM
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located, ResectionConfig
from tumortrack_lab.bench.rows import MOTIONS, PLAN, Workload
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.twin.apparatus import moved

_POINTS = 40_000


def workloads(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Both planners; motions where the arms' libraries are installed."""
    seen = on_its_stand(subject.anatomy)
    ours = ResectionConfig()
    for what, config in (("published", ResectionConfig(method="published")), ("margin", ours)):
        call = partial(plan_resection, seen, config)
        yield Workload(PLAN, f"{what}, {_POINTS:,} points", "plan", call)
    if find_spec("pinocchio") is None:  # the extra `arms`
        return
    from tumortrack.plan.arms.cell import ArmCell
    from tumortrack.plan.arms.config import CellConfig
    from tumortrack.plan.arms.procedure import plan_motions

    organ = seen.meshes["kidney"]
    cell, plan = ArmCell(CellConfig(), organ), plan_resection(seen, ours)
    motions = partial(plan_motions, plan, cell, organ)
    yield Workload(MOTIONS, f"margin, {plan.sweeps} sweeps", "plan", motions)


def on_its_stand(anatomy_ct: Anatomy) -> Located:
    """An organ with its front up: 40,000 points inside, and its surfaces."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # LPS, its front up
    organ = anatomy_ct.organ.vertices_mm @ turn.T
    x, y, _ = -(organ.min(0) + organ.max(0)) / 2
    placed = moved(anatomy_ct, rigid(turn, np.array([x, y, STAND_MM - organ[:, 2].min()])))
    low = placed.organ.box_mm[0] - 2
    table_from_index = np.eye(4)
    table_from_index[:3, 3] = low
    i, j, k = (int(n) for n in np.ceil(np.ptp(placed.organ.box_mm, axis=0) + 4))
    grid = label_grid(placed, table_from_index, (i, j, k))
    rng = np.random.default_rng(0)
    cells = np.argwhere(grid > 0)
    chosen = cells[rng.integers(len(cells), size=_POINTS)]
    points = chosen + rng.uniform(-0.5, 0.5, chosen.shape) + low
    return Located(
        points, grid[tuple(chosen.T)], dict(zip(placed.names, placed.parts, strict=True))
    )
