"""Speed of planning on this machine; its rows are also part of `make bench`.

    python bench/planning.py

One thread throughout.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay
from skimage.measure import find_contours
from turns import medians

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.raster import label_grid
from tumortrack.imaging.surface import surfaces
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.plan.arms.cell import Cell
from tumortrack.plan.arms.config import CellConfig
from tumortrack.plan.arms.procedure import plan_motions
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.located import STAND_MM
from tumortrack.plan.outline import common, evenly, grown
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located

POINTS = 40_000
VOXEL_MM = 0.5  # of the naive margin
Row = tuple[str, float, float]


def phantom() -> Located:
    """The built-in phantom on its stand: 40,000 points inside, and its surfaces."""
    anatomy, _ = surfaces(phantom_labels(PhantomParameters(), voxel_mm=1.0))
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # LPS, its front up
    parts = [part.vertices_mm @ turn.T for part in anatomy.parts]
    lift = np.array(
        [*-(parts[0].min(0) + parts[0].max(0))[:2] / 2, STAND_MM - parts[0][:, 2].min()]
    )
    meshes = {
        name: Mesh(vertices + lift, part.faces)
        for name, vertices, part in zip(anatomy.names, parts, anatomy.parts, strict=True)
    }
    table_from_index = np.diag([1.0, 1.0, 1.0, 1.0])
    low = meshes["kidney"].box_mm[0] - 2
    table_from_index[:3, 3] = low
    shape = np.ceil(np.ptp(meshes["kidney"].box_mm, axis=0) + 4).astype(int)
    grid = label_grid(Anatomy(tuple(meshes.values())), table_from_index, tuple(shape))
    rng = np.random.default_rng(0)
    cells = np.argwhere(grid > 0)
    chosen = cells[rng.integers(len(cells), size=POINTS)]
    points = chosen + rng.uniform(-0.5, 0.5, chosen.shape) + low
    return Located(points, grid[tuple(chosen.T)], meshes)


def naive_shares(seen: Located) -> None:
    """Which tumor lies outside: every point against a triangulation of all others."""
    hull = Delaunay(seen.of(1))
    for label in seen.tumors:
        (hull.find_simplex(seen.of(label)) < 0).mean()


def naive_published(seen: Located) -> None:
    """The same plan with hulls of all points."""
    import shapely

    naive_shares(seen)
    tumor = shapely.concave_hull(shapely.MultiPoint(seen.of(3)[:, :2]), ratio=0.1)
    organ = shapely.concave_hull(shapely.MultiPoint(seen.points_mm[:, :2]), ratio=0.1)
    zone = common(grown(tumor, 5.0), organ)
    evenly(np.array(zone.exterior.coords), 1.0)


def naive_margin(seen: Located) -> None:
    """The grown tumor on voxels: distances everywhere, then a contour in each layer."""
    naive_shares(seen)
    low, high = seen.meshes["tumor_2"].box_mm + [[-8.0], [8.0]]
    table_from_index = np.diag([VOXEL_MM, VOXEL_MM, VOXEL_MM, 1.0])
    table_from_index[:3, 3] = low
    shape = np.ceil((high - low) / VOXEL_MM).astype(int)
    tumor = label_grid(Anatomy((seen.meshes["tumor_2"],)), table_from_index, tuple(shape)) > 0
    grown_mm = VOXEL_MM * distance_transform_edt(~tumor)
    below = np.minimum.accumulate(grown_mm, axis=2)
    for level in range(0, shape[2], 8):
        find_contours(below[:, :, level], 5.0)


def rows() -> list[Row]:
    """(what, ours a second, the naive form a second); of motions, those of ours beside those of
    the paper's two sweeps."""
    seen, published, ours = phantom(), ResectionConfig(method="published"), ResectionConfig()
    rows: list[Row] = []
    for name, config, naive in (
        ("plan, published, 40,000 points (plans/s)", published, naive_published),
        ("plan, margin, 40,000 points (plans/s)", ours, naive_margin),
    ):
        mine, plain = medians(
            lambda config=config: plan_resection(seen, config),  # type: ignore[misc]
            lambda naive=naive: naive(seen),  # type: ignore[misc]
        )
        rows.append((name, 1 / mine, 1 / plain))
    organ = seen.meshes["kidney"]
    cell = Cell(CellConfig(), organ)
    plans = [plan_resection(seen, config) for config in (ours, published)]
    mine, plain = medians(*(lambda plan=plan: plan_motions(plan, cell, organ) for plan in plans))  # type: ignore[misc]
    rows.append((f"motions, {plans[0].sweeps} | 2 sweeps (plans/s)", 1 / mine, 1 / plain))
    return rows


if __name__ == "__main__":
    for name, mine, plain in rows():
        Console().print(
            f"{name}: {1000 / mine:.1f} ms, {1000 / plain:.1f} ms, {mine / plain:.1f} x"
        )
