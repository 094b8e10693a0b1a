"""Workloads of planning a resection: the plan, and the arms' motions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec

import numpy as np

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.raster import label_grid
from tumortrack.plan.located import STAND_MM
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located, ResectionConfig
from tumortrack_lab.bench.naive import plans
from tumortrack_lab.bench.rows import MOTIONS, PLAN, Workload
from tumortrack_lab.bench.subject import BenchSubject

_POINTS = 40_000


def workloads(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Both planners; motions where the arms' libraries are installed."""
    seen = on_its_stand(subject.anatomy)
    published, ours = ResectionConfig(method="published"), ResectionConfig()
    for what, config, naive, naive_is in (
        ("published", published, plans.published, "hulls and a triangulation of all points"),
        ("margin", ours, plans.margin, "the same, and the grown tumor on voxels of 0.5 mm"),
    ):
        call = partial(plan_resection, seen, config)
        what = f"{what}, {_POINTS:,} points"
        yield Workload(PLAN, what, "plan", call, partial(naive, seen), naive_is)
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
    parts = [part.vertices_mm @ turn.T for part in anatomy_ct.parts]
    middle = -(parts[0].min(0) + parts[0].max(0)) / 2
    lift = np.array([middle[0], middle[1], STAND_MM - parts[0][:, 2].min()])
    meshes = {
        name: Mesh(vertices + lift, part.faces)
        for name, vertices, part in zip(anatomy_ct.names, parts, anatomy_ct.parts, strict=True)
    }
    low = meshes["kidney"].box_mm[0] - 2
    table_from_index = np.eye(4)
    table_from_index[:3, 3] = low
    i, j, k = (int(n) for n in np.ceil(np.ptp(meshes["kidney"].box_mm, axis=0) + 4))
    grid = label_grid(Anatomy(tuple(meshes.values())), table_from_index, (i, j, k))
    rng = np.random.default_rng(0)
    cells = np.argwhere(grid > 0)
    chosen = cells[rng.integers(len(cells), size=_POINTS)]
    points = chosen + rng.uniform(-0.5, 0.5, chosen.shape) + low
    return Located(points, grid[tuple(chosen.T)], meshes)
