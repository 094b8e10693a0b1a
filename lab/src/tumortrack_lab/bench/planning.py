"""Workloads of planning a resection: the plan, and the arms' motions; naive: on all points."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from importlib.util import find_spec

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay
from skimage.measure import find_contours

from tumortrack.core.geometry import rigid
from tumortrack.core.types import Anatomy
from tumortrack.imaging.raster import label_grid
from tumortrack_lab.bench.rows import MOTIONS, PLAN, Workload
from tumortrack_lab.bench.subject import BenchSubject
from tumortrack_lab.twin.apparatus import moved
from tumortrack_resection.located import STAND_MM
from tumortrack_resection.outline import common, evenly, grown
from tumortrack_resection.resection import plan_resection
from tumortrack_resection.values import Located, ResectionConfig

_VOXEL_MM = 0.5
_POINTS = 40_000


def _naive_published(seen: Located) -> None:
    """The paper's plan with hulls of all points."""
    import shapely

    _shares(seen)
    tumor = shapely.concave_hull(shapely.MultiPoint(seen.of(3)[:, :2]), ratio=0.1)
    organ = shapely.concave_hull(shapely.MultiPoint(seen.points_mm[:, :2]), ratio=0.1)
    zone = common(grown(tumor, 5.0), organ)
    evenly(np.array(zone.exterior.coords), 1.0)


def _naive_margin(seen: Located) -> None:
    """The grown tumor on voxels: distances everywhere, then a contour in each layer."""
    _shares(seen)
    low, high = seen.meshes["tumor_2"].box_mm + [[-8.0], [8.0]]
    table_from_index = np.diag([_VOXEL_MM, _VOXEL_MM, _VOXEL_MM, 1.0])
    table_from_index[:3, 3] = low
    i, j, k = (int(n) for n in np.ceil((high - low) / _VOXEL_MM))
    tumor = label_grid(Anatomy((seen.meshes["tumor_2"],)), table_from_index, (i, j, k)) > 0
    grown_mm = _VOXEL_MM * distance_transform_edt(~tumor)
    below = np.minimum.accumulate(grown_mm, axis=2)
    for level in range(0, k, 8):
        find_contours(below[:, :, level], 5.0)


def _shares(seen: Located) -> None:
    """Which tumor lies outside: every point against a triangulation of all others."""
    hull = Delaunay(seen.of(1))
    for label in seen.tumors:
        (hull.find_simplex(seen.of(label)) < 0).mean()


def workloads(subject: BenchSubject, _: float) -> Iterator[Workload]:
    """Both planners; motions where the arms' libraries are installed."""
    seen = on_its_stand(subject.anatomy)
    published, ours = ResectionConfig(method="published"), ResectionConfig()
    for what, config, naive, naive_is in (
        ("published", published, _naive_published, "hulls and a triangulation of all points"),
        ("margin", ours, _naive_margin, "the same, and the grown tumor on voxels of 0.5 mm"),
    ):
        call = partial(plan_resection, seen, config)
        what = f"{what}, {_POINTS:,} points"
        yield Workload(PLAN, what, "plan", call, partial(naive, seen), naive_is)
    if find_spec("pinocchio") is None:  # the extra `arms`
        return
    from tumortrack_resection.arms.cell import ArmCell
    from tumortrack_resection.arms.config import CellConfig
    from tumortrack_resection.arms.procedure import plan_motions

    organ = seen.organ
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
