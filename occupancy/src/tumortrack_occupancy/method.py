"""The entry point in ``tumortrack.methods``, by which tumortrack finds the paper's method.

Importing this module does not import PyTorch, which takes seconds; its functions do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tumortrack.core.errors import PackageError
from tumortrack.core.packages import to_install
from tumortrack.core.types import Anatomy
from tumortrack.io.case import Case
from tumortrack.registration.base_model import Model
from tumortrack.registration.config import Rotations
from tumortrack.registration.method import Locator, Preset, TrainingStatus, TrainOptions

if TYPE_CHECKING:
    from tumortrack_occupancy.config import TrainConfig

if find_spec("torch") is None:
    raise PackageError(
        "tumortrack-occupancy is installed without PyTorch, which it needs: "
        f"{to_install('tumortrack-occupancy')}."
    )


def quick(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """See ``presets.quick``."""
    from tumortrack_occupancy import presets

    return presets.quick(anatomy, rotations)


def paper(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """See ``presets.paper``."""
    from tumortrack_occupancy import presets

    return presets.paper(anatomy, rotations)


def quick_long(anatomy: Anatomy, rotations: Rotations = "limited") -> TrainConfig:
    """See ``presets.quick_long``."""
    from tumortrack_occupancy import presets

    return presets.quick_long(anatomy, rotations)


class OccupancyMethod:
    """See ``tumortrack.registration.method.Method``."""

    presets: Mapping[str, Preset] = {"quick": quick, "quick-long": quick_long, "paper": paper}

    def has_config(self, config: object) -> bool:
        from tumortrack_occupancy.config import TrainConfig

        return isinstance(config, TrainConfig)

    def has_model(self, manifest: Mapping[str, Any]) -> bool:
        return "network" in manifest["config"]

    def train(
        self,
        case: Case,
        folder: Path,
        config: Any,
        options: TrainOptions,
        report: Callable[[TrainingStatus], None],
    ) -> Model:
        from tumortrack_occupancy.training.train import TrainingRun, train

        run = TrainingRun(
            anatomy_ct=case.anatomy, up_lps=case.up_lps, case_sha256=case.sha256, config=config,
            seed=options.seed, steps=options.steps, minutes=options.minutes,
            device=options.device, workers=options.workers,
            checkpoint_every_s=options.checkpoint_every_s, patient=case.patient,
        )  # fmt: skip
        return train(run, folder, report)

    def load(self, folder: Path, manifest: dict[str, Any], device: str, **known: Any) -> Model:
        from tumortrack_occupancy.model import OccupancyModel

        return OccupancyModel.from_folder(folder, manifest, device=device, **known)

    def phantom_model(self, preset: str, rotations: Rotations = "limited") -> Path | None:
        folder = Path(__file__).with_name("phantom") / rotations
        return folder if preset == "quick" else None

    def locator(self, model: Model) -> Locator:
        from tumortrack_occupancy.locator import OccupancyLocator
        from tumortrack_occupancy.model import OccupancyModel

        assert isinstance(model, OccupancyModel)
        return OccupancyLocator(model)

    def hardware(self) -> Sequence[str]:
        import torch

        from tumortrack_occupancy.hardware import has_fast_bfloat16

        capability = torch.cpu.get_capabilities()
        names = {"AVX2": "avx2", "AVX-512": "avx512_f", "AMX": "amx_tile"}
        units = [f"{'' if capability.get(key) else 'no '}{unit}" for unit, key in names.items()]
        fast = has_fast_bfloat16(torch.device("cpu"))
        bf16 = "in hardware, used" if fast else "not in hardware; fp32 is used (slower)"
        cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
        note = "" if torch.cuda.is_available() else "; everything runs on the CPU"
        return f"CPU: {', '.join(units)}; bf16: {bf16}", f"CUDA: {cuda}{note}"


METHOD = OccupancyMethod()
