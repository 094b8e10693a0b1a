"""`onnx`: a network for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install


@dataclass(frozen=True, kw_only=True)
class Onnx:
    """Write a model's network as an ONNX file, for other programs.

    Attributes:
        model: folder that `train --preset quick` or `paper` wrote.
        out: file to write, .onnx: clouds and queries in, logits out. docs/method.md says what
            they mean.
        overwrite: replace OUT if it exists.
    """

    model: Positional[Path]
    out: Positional[Path]
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack.io.case import holds_case
        from tumortrack.io.model_folder import has_shape, read_model_manifest

        out = self.out
        if out.suffix != ".onnx":
            raise InputError(f"{out} must end in .onnx.")
        if not (out.is_file() and self.overwrite):
            store.check_place(out, "ONNX", self.overwrite)
        if not out.parent.is_dir():
            raise InputError(f"{out.parent} is not a folder; make it first.")
        if holds_case(self.model) or has_shape(read_model_manifest(self.model)):
            raise InputError(
                f"{self.model} has no network; models of `train --preset quick` or paper have one."
            )
        if find_spec("onnx") is None:  # reported before PyTorch's seconds
            raise InputError(
                f"writing ONNX needs the package onnx: {to_install('tumortrack-occupancy[onnx]')}."
            )

        from tumortrack.tracking.model_files import load_model
        from tumortrack_occupancy.model import OccupancyModel, onnx_bytes

        model = load_model(self.model, "cpu")
        if not isinstance(model, OccupancyModel):
            raise InputError(f"{self.model} is no model of `train --preset quick` or paper.")
        content = onnx_bytes(model)
        store.write_atomically(out, content)
        points = model.config.scene.cloud.n_points
        say(f"written to {out} ({len(content) / 2**20:.1f} MB): clouds of {points} points, mm.")
