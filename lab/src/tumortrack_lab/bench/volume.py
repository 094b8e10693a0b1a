"""Rows of the labelled volume: 400 voxels along the longest side."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from tumortrack_lab.bench import asked as occupancy
from tumortrack_lab.bench.asked import OccupancyWorkload, asked_of
from tumortrack_lab.bench.placing import Placing
from tumortrack_lab.bench.row import BenchRow, Work
from tumortrack_lab.bench.subject import PRESETS
from tumortrack_lab.bench.turns import in_turns

if TYPE_CHECKING:
    import torch

    from tumortrack.core.types import Anatomy
    from tumortrack_lab.bench.subject import Subject

NAME = "400^3 labels"
GRID = 400
_SLAB = 16_384  # voxels that the naive form is asked for
Grid = tuple[np.ndarray, tuple[int, int, int]]  # camera_from_index, shape


def rows(subject: Subject, threads: int, budget_s: float) -> Iterator[BenchRow]:
    """From what is known of the cloud to a label in every voxel."""
    for preset in PRESETS:
        share = budget_s / len(PRESETS)
        if preset == "clinic":
            yield _placed(subject, threads, share)
        else:
            yield asked_volume(asked_of(subject, preset), preset, threads, share)


def asked_volume(asked: OccupancyWorkload, preset: str, threads: int, budget_s: float) -> BenchRow:

    from tumortrack.occupancy.sparse import sparse_margins

    latent = asked.inference.encode(asked.points_mm)
    camera_from_index, shape = organ_grid(asked, latent, GRID)
    asked_of_us, labels = 0, np.zeros(0, np.uint8)

    def logits_at(points: np.ndarray) -> torch.Tensor:
        nonlocal asked_of_us
        asked_of_us += len(points)
        return asked.inference.logits(latent, points)

    def filled() -> None:
        nonlocal asked_of_us, labels
        asked_of_us = 0
        labels = sparse_margins(logits_at, camera_from_index, shape)[1]

    index, points = _slab((camera_from_index, shape))
    ours, naive = in_turns(filled, asked.naive_frame(points), budget_s=budget_s)
    voxels = int(np.prod(shape))
    same = asked.naive_labels(points) == labels[tuple(index.T)]
    return BenchRow(
        name=NAME,
        what=preset,
        threads=threads,
        item="volume",
        ours=ours,
        naive=naive.times(voxels / len(points)),
        naive_is=f"dense; {occupancy.NAIVE}; {len(points):,} voxels spread over the volume, scaled",
        work=_with_voxels(asked.decoder_work(asked_of_us), voxels),
        naive_work=asked.naive_decoder_work(voxels),
        agreement=float(same.mean()),
        others={"voxels": voxels, "asked": asked_of_us},
        note=f"{asked_of_us:,} of {voxels:,} voxels asked",
        device=asked.device,
    )


def organ_grid(asked: OccupancyWorkload, latent: object, grid: int) -> Grid:
    """Voxels over the organ, as `locate` lays them: about the points that are inside."""
    from tumortrack.models.report import grid_over

    queries = asked.queries(40_000)
    inside = asked.inference.logits(latent, queries).argmax(-1).cpu().numpy() > 0  # type: ignore[arg-type]
    return grid_over(queries[inside], grid)


def _placed(subject: Subject, threads: int, budget_s: float) -> BenchRow:
    from tumortrack.core.types import Anatomy
    from tumortrack.imaging.raster import label_grid
    from tumortrack.models.report import grid_over

    placing = Placing(subject)
    anatomy = Anatomy(tuple(placing.estimate.meshes.values()))
    camera_from_index, shape = grid_over(anatomy.organ.vertices_mm, GRID)
    labels = label_grid(anatomy, camera_from_index, shape)
    index, points = _slab((camera_from_index, shape))
    back = _plainly_back(placing)
    ours, naive = in_turns(
        lambda: label_grid(anatomy, camera_from_index, shape),
        lambda: placing.plain.labels_where(back(points)),
        budget_s=budget_s,
    )
    same = placing.plain.labels_where(back(points)) == labels[tuple(index.T)]
    voxels = int(np.prod(shape))
    return BenchRow(
        name=NAME,
        what="clinic",
        threads=threads,
        item="volume",
        ours=ours,
        naive=naive.times(voxels / len(points)),
        naive_is=f"every voxel carried back, inside tests; {len(points):,} voxels, scaled",
        work=_drawn(anatomy, shape),
        agreement=float(same.mean()),
        others={"voxels": voxels},
        note="the moved surfaces filled",
    )


def _plainly_back(placing: Placing) -> Callable[[np.ndarray], np.ndarray]:
    from tumortrack_lab.bench.naive.scenes import flowed

    body = placing.plain.body
    motion = placing.estimate.report["motion"]
    camera_from_ct = np.array(motion["camera_from_ct"])
    state = np.array(motion["coefficients"])

    def back(points: np.ndarray) -> np.ndarray:
        rest = (points - camera_from_ct[:3, 3]) @ camera_from_ct[:3, :3]
        return flowed(body, -state, rest)

    return back


def _drawn(anatomy: Anatomy, shape: tuple[int, int, int]) -> Work:
    """Each column of voxels is crossed by triangles, every voxel written once."""
    faces = sum(len(part.faces) for part in anatomy.parts)
    i, j, k = shape
    return Work(flops=60.0 * faces + 40.0 * i * j, bytes=float(i * j * k + 36 * faces))


def _with_voxels(work: Work, voxels: int) -> Work:
    """A label is written to every voxel."""
    return Work(flops=work.flops, bytes=work.bytes + voxels, precision=work.precision)


def _slab(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Indices and places (n, 3) of random voxels."""
    from tumortrack.core.geometry import transform_points

    camera_from_index, shape = grid
    index = np.random.default_rng(0).integers(0, shape, (_SLAB, 3))
    return index, transform_points(camera_from_index, index.astype(float)).astype(np.float32)
