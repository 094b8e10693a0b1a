"""What a machine compiles once: `compile`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import Device, say
from tumortrack.core.errors import NoEstimate

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
