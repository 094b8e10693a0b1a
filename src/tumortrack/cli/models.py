"""What a trained model is made into: `compile` and `onnx`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import Device, say
from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate

if TYPE_CHECKING:
    from tumortrack.models.model import Model

_GRID = 32
_VOXEL_MM, _UP_LPS = 1.5, (0.0, -1.0, 0.0)  # of the built-in phantom


@dataclass(frozen=True, kw_only=True)
class Compile:
    """Compile what this machine needs, before the first patient or frame would wait for it.

    Attributes:
        model: folder that `train` wrote; nothing is written into it. Without one, what a new
            patient's model needs is compiled as well, on the built-in phantom.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path | None] = None
    device: Device = "auto"

    def run(self) -> None:
        """Fill numba's cache: one frame and one answer in full; models that place an organ are
        shown their own."""
        say("compiling ...")

        import numpy as np
        import torch

        from tumortrack.core.types import SensorCloud
        from tumortrack.occupancy.sparse import sparse_margins
        from tumortrack.tracking.tracker import Tracker
        from tumortrack.training.model import load_model

        def ball(points_mm: np.ndarray) -> torch.Tensor:
            """Logits of a ball in the grid's middle."""
            inside = 5.0 - np.linalg.norm(points_mm - _GRID / 4, axis=1)
            return torch.from_numpy(np.column_stack([-inside, inside]).astype(np.float32))

        model = load_model(self.model, self.device) if self.model else _phantom_model(self.device)
        tracker = Tracker(model)
        tracker.warm()
        grid = np.diag([0.5, 0.5, 0.5, 1.0])
        sparse_margins(ball, grid, (_GRID, _GRID, _GRID), start_mm=2.0)
        if tracker.anatomy_ct is not None:
            organ = tracker.anatomy_ct.organ.vertices_mm
            cloud = SensorCloud(organ - organ.mean(0) + [0, 0, 150])
            with suppress(NoEstimate):  # seen from all sides at once it may fit nothing
                tracker.locate(cloud, _GRID)
        say("kernels: compiled and kept for every model of this machine.")


def _phantom_model(device: Device) -> Model:
    """Of the built-in phantom, made as `train --minutes 0` makes one; none of it stays."""
    from tumortrack.imaging.surface import surfaces
    from tumortrack.phantom.digital import PhantomParameters, phantom_labels
    from tumortrack.training.model import start_of
    from tumortrack.training.presets import clinic
    from tumortrack.training.train import TrainingRun, train

    anatomy = surfaces(phantom_labels(PhantomParameters(), _VOXEL_MM))[0]
    config = clinic(anatomy)
    start = start_of(config.network, None)
    run = TrainingRun(anatomy, _UP_LPS, "none", config, steps=0, device=device, start=start)
    with TemporaryDirectory() as folder:
        return train(run, Path(folder), lambda _: None)


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
        if not (out.is_file() and self.overwrite):
            store.check_place(out, "ONNX", self.overwrite)
        if not out.parent.is_dir():
            raise InputError(f"{out.parent} is not a folder; make it first.")
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
