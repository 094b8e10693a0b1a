"""What a trained model is made into: `compile` and `onnx`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import Device, console, say
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate

if TYPE_CHECKING:
    from tumortrack.models.model import Model

_GRID = 32


@dataclass(frozen=True, kw_only=True)
class Compile:
    """Make a model as fast as this machine allows, before the first frame.

    Attributes:
        model: folder that `train` wrote; what is found fastest is kept in MODEL/compiled.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path]
    device: Device = "auto"

    def run(self) -> None:
        """Fill MODEL/compiled for this machine, and numba's cache of a frame's kernels."""
        from rich.table import Table

        from tumortrack.models.folder import WEIGHTS
        from tumortrack.occupancy.model import OccupancyModel, measured, save
        from tumortrack.training.model import load_model

        model = load_model(self.model, self.device)
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
        weights = store.read_json(self.model / store.MANIFEST)["files"][WEIGHTS]
        half_mm = model.in_distribution.spread_mm[1]
        compiled = measured(model.network, model.query_box_mm, half_mm, weights)
        path = save(self.model, compiled)
        table = Table(title=f"{compiled.queries} queries, {compiled.threads} cores")
        table.add_column("arithmetic")
        for name in ("at once", "ms", "labels equal", "largest error of a logit"):
            table.add_column(name, justify="right")
        for one in sorted(compiled.timings, key=lambda timing: timing.milliseconds):
            shares = f"{100 * one.labels_equal:.2f} %", f"{one.largest_error:.3f}"
            how = one.arithmetic.numbers, str(one.arithmetic.chunk)
            table.add_row(*how, f"{one.milliseconds:.1f}", *shares)
        console.print(table)
        best = compiled.arithmetic
        say(f"network: {best.numbers}, {best.chunk} queries at once and core; kept in {path}.")


@dataclass(frozen=True, kw_only=True)
class Onnx:
    """Write a model's network as an ONNX file, for other programs.

    Attributes:
        model: folder that `train` wrote.
        out: file to write, .onnx: clouds and queries in, logits out (quick, paper); clouds in,
            placements out (clinic). docs/method.md says what they mean.
        overwrite: replace OUT if it exists.
    """

    model: Positional[Path]
    out: Positional[Path]
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack.models.folder import read_model_manifest

        out = self.out
        if out.suffix != ".onnx":
            raise InputError(f"{out} must end in .onnx.")
        if out.exists() and not self.overwrite:
            raise InputError(f"{out} exists already. Choose another file, or give --overwrite.")
        if not out.parent.is_dir():
            raise InputError(f"{out.parent} is no folder; make it first.")
        read_model_manifest(self.model)
        if find_spec("onnx") is None:  # reported before PyTorch's seconds
            raise InputError("writing ONNX needs the package onnx: pip install 'tumortrack[onnx]'.")

        from tumortrack.models.model import onnx_bytes
        from tumortrack.training.model import load_model

        model = load_model(self.model, "cpu")
        content = onnx_bytes(model)
        store.write_atomically(out, content)
        points = model.config.scene.cloud.n_points
        say(f"written to {out} ({len(content) / 2**20:.1f} MB): clouds of {points} points, mm.")


def _warm(model: Model) -> None:
    """One frame and one answer in full; models that place an organ are shown their own."""
    import numpy as np
    import torch

    from tumortrack.core.types import SensorCloud
    from tumortrack.occupancy.sparse import sparse_margins
    from tumortrack.tracking.tracker import Tracker

    def ball(points_mm: np.ndarray) -> torch.Tensor:
        """Logits of a ball in the grid's middle."""
        inside = 5.0 - np.linalg.norm(points_mm - _GRID / 4, axis=1)
        return torch.from_numpy(np.column_stack([-inside, inside]).astype(np.float32))

    tracker = Tracker(model)
    tracker.warm()
    grid = np.diag([0.5, 0.5, 0.5, 1.0])
    sparse_margins(ball, grid, (_GRID, _GRID, _GRID), start_mm=2.0)
    if tracker.anatomy_ct is not None:
        organ = tracker.anatomy_ct.organ.vertices_mm
        cloud = SensorCloud(organ - organ.mean(0) + [0, 0, 150])
        with suppress(NoEstimate):  # seen from all sides at once it may fit nothing
            tracker.locate(cloud, _GRID)
