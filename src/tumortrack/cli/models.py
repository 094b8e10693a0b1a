"""What a trained model is made into: `compile` and `onnx`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
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
        model: a case, or a folder that `train` wrote. Without one, what a new patient's model needs
            is compiled as well, on the built-in phantom.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path | None] = None
    device: Device = "auto"

    def run(self) -> None:
        """Fill numba's cache: one frame and one answer in full; models that place an organ are
        shown their own."""
        say("compiling ...")

        from tumortrack.core.types import SensorCloud
        from tumortrack.tracking.model_files import load_model
        from tumortrack.tracking.tracker import Tracker

        given = None if self.model is None else load_model(self.model, self.device)
        tracker = Tracker(given or _phantom_model())
        tracker.warm()
        if tracker.anatomy_ct is not None:
            organ = tracker.anatomy_ct.organ.vertices_mm
            cloud = SensorCloud(organ - organ.mean(0) + [0, 0, 150])
            with suppress(NoEstimate):  # seen from all sides at once it may fit nothing
                tracker.locate(cloud, _GRID)
        say("kernels: compiled and kept for every model of this machine.")


def _phantom_model() -> Model:
    """Of the built-in phantom; none of it stays."""
    from tumortrack.imaging.surface import surfaces
    from tumortrack.phantom.digital import PhantomParameters, phantom_labels
    from tumortrack.registration.build import build_model
    from tumortrack.tracking.presets import clinic

    anatomy = surfaces(phantom_labels(PhantomParameters(), _VOXEL_MM))[0]
    return build_model(anatomy, _UP_LPS, clinic(anatomy))


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
        from tumortrack.imaging.case import holds_case
        from tumortrack.models.folder import has_shape, read_model_manifest

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
            raise InputError("writing ONNX needs the package onnx: pip install 'tumortrack[onnx]'.")

        from tumortrack.tracking.model_files import load_model
        from tumortrack.tracking.presets import occupancy

        write = occupancy("model").onnx_bytes
        model = load_model(self.model, "cpu")
        content = write(model)
        store.write_atomically(out, content)
        points = model.config.scene.cloud.n_points
        say(f"written to {out} ({len(content) / 2**20:.1f} MB): clouds of {points} points, mm.")
