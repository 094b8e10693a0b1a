"""What locators of all kinds do with a cloud, and what all of them report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.cloud import FEWEST_POINTS, check_cloud, thin_cloud
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import Affine, transform_points
from tumortrack.core.raster import label_grid
from tumortrack.core.report import FitReport, PartReport, Residuals
from tumortrack.core.types import Anatomy, CameraLabels, Mesh, OccupancyCloud, SensorCloud
from tumortrack.registration.base_model import Model

Rng = np.random.Generator
CLOUD_POINTS = 40_000  # of an estimate made of surfaces


class Frame:
    """One cloud (camera frame, mm; checked by ``check_cloud``) on its way to an estimate:
    ``points_mm`` are those that the network sees, ``seconds`` what each stage took."""

    def __init__(
        self,
        model: Model,
        cloud: SensorCloud,
        seed: int,
        rng: Rng,
        fewest: int = FEWEST_POINTS,
    ) -> None:
        check_cloud(cloud, fewest)
        self.model, self.cloud, self.seed, self.rng = model, cloud, seed, rng
        self.points_mm = thin_cloud(cloud, model.config.scene.cloud.n_points, rng).points_mm
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.model.synchronise()
        self.seconds[name] = time.perf_counter() - start

    @property
    def timings(self) -> dict[str, float]:
        """Seconds by stage, and of all."""
        return {**self.seconds, "total": sum(self.seconds.values())}


def residuals(distances_mm: Float[np.ndarray, " n"]) -> Residuals:
    """Of the observed points, by their distances from the estimated surface."""
    median, p95 = np.percentile(distances_mm, (50, 95)).tolist()
    return Residuals(median=median, p95=p95)


def grid_over(points_mm: np.ndarray, grid: int) -> tuple[Affine, tuple[int, int, int]]:
    """``camera_from_index`` and shape of cubic voxels over the points' box, 4 % larger, with
    ``grid`` voxels along its longest side."""
    lower, upper = points_mm.min(0).astype(float), points_mm.max(0).astype(float)
    margin = 0.02 * (upper - lower).max()
    lower, upper = lower - margin, upper + margin
    voxel = (upper - lower).max() / grid
    shape = np.maximum(np.ceil((upper - lower) / voxel - 1e-9).astype(int), 2)
    camera_from_index = np.diag([voxel, voxel, voxel, 1.0])
    camera_from_index[:3, 3] = (lower + upper) / 2 - voxel * (shape - 1) / 2
    i, j, k = (int(n) for n in shape)
    return camera_from_index, (i, j, k)


def describe_parts(
    names: tuple[str, ...],
    meshes: dict[str, Mesh],
    inside: OccupancyCloud,
    deviations: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> dict[str, PartReport]:
    """Per part: volume, centre, box, how sure the labels inside it are, and its ``deviations``
    (fields of ``PartReport``). The organ's numbers are the whole organ's, tumors included."""
    parts: dict[str, PartReport] = {}
    counts = np.bincount(inside.labels, minlength=len(names) + 1)
    sums = np.bincount(inside.labels, inside.probability, len(names) + 1)
    for n, name in enumerate(names):
        if name not in meshes:
            parts[name] = PartReport(label=n + 1, found=False)
            continue
        mesh, mine = meshes[name], slice(1, None) if n == 0 else n + 1
        points = int(counts[mine].sum())
        parts[name] = PartReport(
            label=n + 1,
            found=True,
            volume_ml=mesh.volume_ml,
            center_mm=mesh.box_mm.mean(0).tolist(),
            box_mm=mesh.box_mm.tolist(),
            points=points,
            probability=float(sums[mine].sum() / points) if points else None,
            **deviations.get(name, {}),
        )
    return parts


def estimate_of(
    meshes: dict[str, Mesh], grid: int = 160, stamp_ns: int = 0, **report: Any
) -> Estimate:
    """Surfaces of any method (camera frame, mm) as an estimate: labels are voxelised from them,
    ``grid`` voxels along the longest side; points are evenly chosen voxels with probability 1.
    ``report``: further fields of the estimate's report."""
    anatomy = Anatomy(tuple(meshes.values()))
    camera_from_index, shape = grid_over(anatomy.organ.vertices_mm, grid)
    labels = label_grid(anatomy, camera_from_index, shape)
    voxels = np.flatnonzero(labels)
    voxels = voxels[:: max(1, len(voxels) // CLOUD_POINTS)]
    index = np.stack(np.unravel_index(voxels, labels.shape), 1).astype(float)
    points_mm = transform_points(camera_from_index, index)
    inside = OccupancyCloud(points_mm, labels.reshape(-1)[voxels], np.ones(len(voxels)), stamp_ns)
    parts = describe_parts(tuple(meshes), meshes, inside)
    about = FitReport(voxel_mm=float(camera_from_index[0, 0]), parts=parts, **report)
    return Estimate(inside, CameraLabels(labels, camera_from_index), meshes, about)
