"""`tumortrack compile`: kernels compiled, and the fastest arithmetic measured, before any frame."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from rich.table import Table

from tumortrack.cli.console import console, say
from tumortrack.core import store
from tumortrack.core.errors import NoEstimate
from tumortrack.core.types import SensorCloud
from tumortrack.models.folder import WEIGHTS
from tumortrack.models.model import Model
from tumortrack.occupancy.compiled import Compiled, save
from tumortrack.occupancy.compiling import measured
from tumortrack.occupancy.model import OccupancyModel
from tumortrack.occupancy.sparse import sparse_margins
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model

_GRID = 32


def compile_model(folder: Path, device: str) -> None:
    """Fill MODEL/compiled for this machine, and numba's cache of the kernels that frames use.

    Raises:
        ArtifactError: no model.
        StorageError: the disk refused.
    """
    model = load_model(folder, device)
    _warm(model)
    say("kernels: compiled and kept for every model of this machine.")
    if not isinstance(model, OccupancyModel):
        say(
            "network: nothing to choose. It runs once a frame, on one cloud, in about a "
            "millisecond; the rest of a frame is the kernels."
        )
        return
    if next(model.network.parameters()).device.type != "cpu":
        say("network: runs as it is on a GPU; arithmetic is chosen on a CPU only.")
        return
    weights = store.read_json(folder / store.MANIFEST)["files"][WEIGHTS]
    compiled = measured(model, weights)
    path = save(folder, compiled)
    console.print(_table(compiled))
    best = compiled.arithmetic
    say(f"network: {best.numbers}, {best.chunk} queries at once and core; kept in {path}.")


def _ball(points_mm: np.ndarray) -> torch.Tensor:
    """Logits of a ball in the grid's middle."""
    inside = 5.0 - np.linalg.norm(points_mm - _GRID / 4, axis=1)
    return torch.from_numpy(np.column_stack([-inside, inside]).astype(np.float32))


def _warm(model: Model) -> None:
    """One frame and one answer in full; models that place an organ are shown their own."""
    tracker = Tracker(model)
    tracker.warm()
    grid = np.diag([0.5, 0.5, 0.5, 1.0])
    sparse_margins(_ball, grid, (_GRID, _GRID, _GRID), start_mm=2.0)
    if tracker.anatomy_ct is not None:
        organ = tracker.anatomy_ct.organ.vertices_mm
        cloud = SensorCloud(organ - organ.mean(0) + [0, 0, 150])
        with suppress(NoEstimate):  # seen from all sides at once it may fit nothing
            tracker.locate(cloud, _GRID)


def _table(compiled: Compiled) -> Table:
    table = Table(title=f"{compiled.queries} queries, {compiled.threads} cores")
    for name in ("arithmetic", "at once", "ms", "labels equal", "largest error of a logit"):
        table.add_column(name, justify="left" if name == "arithmetic" else "right")
    for one in sorted(compiled.timings, key=lambda timing: timing.milliseconds):
        table.add_row(
            one.arithmetic.numbers,
            str(one.arithmetic.chunk),
            f"{one.milliseconds:.1f}",
            f"{100 * one.labels_equal:.2f} %",
            f"{one.largest_error:.3f}",
        )
    return table
