"""The models of the study: trained by a preset's rules for a fixed number of steps, kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.models.config import TrainConfig
from tumortrack.models.folder import is_finished
from tumortrack.sense.clutter import ClutterConfig
from tumortrack.sense.noise import CalibrationConfig
from tumortrack.sense.occlusion import OcclusionConfig
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.deform.drag import CONFIGURATIONS
from tumortrack.training.train import TrainingRun, TrainingStatus, train
from tumortrack_lab.study.methods import Network, StudyCase

# A preset: anatomy and rotations (limited, full) -> training configuration.
Preset = Callable[[Anatomy, str], TrainConfig]
Report = Callable[[str, TrainingStatus], None]
MODELS = {"M_lim": "limited", "M_full": "full"}  # of the preset quick
CLINIC = "clinic"
UNREFINED = "_unrefined"  # how the names of models end whose warps are not laid on the cloud
ABLATED = ("clinic_drags", "clinic_clean", "clinic_pointnet", "quick_elastic")
_DRAGS = 10  # kinds of drags beside one elastic kind, all with equal chance


class Presets(NamedTuple):
    """Those that the study's models are made of."""

    quick: Preset
    clinic: Preset


def train_config(name: str, case: StudyCase, presets: Presets) -> TrainConfig:
    """How the model of a name is trained.

    - M_lim, M_full: the preset ``quick`` as it is; ``clinic``: that preset, limited rotations.
    - configuration_n: M_lim with the paper's drags n as the only deformation.
    - clinic_drags: ``clinic`` with the paper's drags 3 and 6 in 10 of 11 scenes; the others stay
      elastic, for the body's modes and its library of states must be known all the same.
    - clinic_clean: ``clinic`` without occlusion, background and calibration errors.
    - clinic_pointnet: ``clinic`` with the encoder of ``quick``.
    - quick_elastic: M_lim's network on the scenes of ``clinic``.

    Raises InputError: no such model.
    """
    quick = presets.quick(case.anatomy_ct, MODELS.get(name, "limited"))
    if name in MODELS:
        return quick
    drags = {number: DragConfig(steps=steps) for number, steps in CONFIGURATIONS.items()}
    if name.startswith("configuration_"):
        return _with_scene(quick, deform=(drags[int(name.rpartition("_")[2])],))
    own = presets.clinic(case.anatomy_ct, "limited")
    match name:
        case "clinic":
            return own
        case "clinic_drags":
            both = (drags[3], drags[6]) * (_DRAGS // 2)
            return _with_scene(own, deform=(*both, *own.scene.deform))
        case "clinic_clean":
            clean = {"occlusion": OcclusionConfig(), "clutter": ClutterConfig()}
            return _with_scene(own, **clean, calibration=CalibrationConfig())
        case "clinic_pointnet":
            return replace(own, network=replace(own.network, encoder=quick.network.encoder))
        case "quick_elastic":
            return replace(quick, scene=replace(own.scene, occupancy=quick.scene.occupancy))
    raise InputError(
        f"model {name!r} is unknown. Allowed: {', '.join((*MODELS, CLINIC, *ABLATED))}, each "
        f"warp also with {UNREFINED}, and configuration_1 to {max(CONFIGURATIONS)}."
    )


def _with_scene(config: TrainConfig, **changed: object) -> TrainConfig:
    return replace(config, scene=replace(config.scene, **changed))


@dataclass(frozen=True)
class Trainer:
    """Trains what is not trained yet; a training that was killed is taken up again.

    Steps decide the end, not minutes: a loaded machine gives the same model, only later.
    """

    folder: Path
    presets: Presets
    device: str = "auto"
    workers: int | None = None
    report: Report = lambda *_: None

    def steps_for(self, case: StudyCase, name: str, scenes: int) -> int:
        """Steps after which a model has seen so many scenes."""
        config = train_config(name.removesuffix(UNREFINED), case, self.presets)
        return max(1, scenes // config.batch_size)

    def model(self, case: StudyCase, name: str, seed: int, steps: int) -> Network:
        """The model under FOLDER/CASE/NAME-seed-steps; an unrefined one is the refined one's.
        Raises InputError: no such model; ArtifactError: what lies there belongs to another case or
        configuration; StorageError: the disk refused; Interrupted: Ctrl-C, the state is saved."""
        import torch

        trained = name.removesuffix(UNREFINED)
        folder = self.folder / case.name / f"{trained}-seed{seed}-{steps}steps"
        run = TrainingRun(
            anatomy_ct=case.anatomy_ct,
            up_lps=case.up_lps,
            case_sha256=store.sha256_of(case.folder / store.MANIFEST),
            config=train_config(trained, case, self.presets),
            seed=seed,
            steps=steps,
            device=self.device,  # type: ignore[arg-type]
            workers=self.workers,
        )
        # A finished model of another run is refused by training, with a clear text.
        about = store.read_json(folder / store.MANIFEST) if is_finished(folder) else {}
        if about.get("provenance", {}).get("run_sha256") != run.identity:
            threads = torch.get_num_threads()
            label = f"{case.name} {trained} seed {seed}"
            train(run, folder, lambda status: self.report(label, status))
            torch.set_num_threads(threads)  # training leaves some cores to its workers
        return Network(name, folder, self.device, unrefined=trained != name)
