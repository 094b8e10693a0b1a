"""The models of the study: trained by a preset's rules for a fixed number of steps, kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
from tumortrack_lab.study.cases import StudyCase
from tumortrack_lab.study.methods import Network

# A preset: anatomy and rotations (limited, full) -> training configuration.
Preset = Callable[[Anatomy, str], TrainConfig]
Report = Callable[[str, TrainingStatus], None]
MODELS = {"M_lim": "limited", "M_full": "full"}  # of the preset quick
CLINIC = "clinic"
UNREFINED = "_unrefined"  # how the names of models end whose warps are not laid on the cloud
ABLATED = ("clinic_drags", "clinic_clean", "clinic_pointnet", "quick_elastic")
_DRAGS = 10  # kinds of drags beside one elastic kind, all with equal chance


@dataclass(frozen=True)
class Presets:
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

    Raises:
        InputError: no such model.
    """
    quick = presets.quick(case.anatomy_ct, MODELS.get(name, "limited"))
    if name in MODELS:
        return quick
    if name.startswith("configuration_"):
        drags = DragConfig(steps=CONFIGURATIONS[int(name.rpartition("_")[2])])
        return _with_scene(quick, deform=(drags,))
    clinic = presets.clinic(case.anatomy_ct, "limited")
    if name == CLINIC:
        return clinic
    if name == "clinic_drags":
        both = tuple(DragConfig(steps=CONFIGURATIONS[n]) for n in (3, 6))
        return _with_scene(clinic, deform=(*both * (_DRAGS // 2), *clinic.scene.deform))
    if name == "clinic_clean":
        occlusion, clutter = OcclusionConfig(), ClutterConfig()
        calibration = CalibrationConfig()
        return _with_scene(clinic, occlusion=occlusion, clutter=clutter, calibration=calibration)
    if name == "clinic_pointnet":
        return replace(clinic, network=replace(clinic.network, encoder=quick.network.encoder))
    if name == "quick_elastic":
        return replace(quick, scene=replace(clinic.scene, occupancy=quick.scene.occupancy))
    raise InputError(
        f"model {name!r} is unknown. Allowed: {', '.join((*MODELS, CLINIC, *ABLATED))}, each "
        f"warp also with {UNREFINED}, and configuration_1 to {max(CONFIGURATIONS)}."
    )


def _with_scene(config: TrainConfig, **changed: object) -> TrainConfig:
    return replace(config, scene=replace(config.scene, **changed))


class Trainer:
    """Trains what is not trained yet; a training that was killed is taken up again.

    Steps decide the end, not minutes: a loaded machine gives the same model, only later.
    """

    def __init__(
        self,
        folder: Path,
        presets: Presets,
        device: str = "auto",
        workers: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.folder = folder
        self._presets, self._device, self._workers = presets, device, workers
        self._report = report

    def steps_for(self, case: StudyCase, name: str, scenes: int) -> int:
        """Steps after which a model has seen so many scenes."""
        config = train_config(name.removesuffix(UNREFINED), case, self._presets)
        return max(1, scenes // config.batch_size)

    def model(self, case: StudyCase, name: str, seed: int, steps: int) -> Network:
        """The model under FOLDER/CASE/NAME-seed-steps; an unrefined one is the refined one's.

        Raises:
            InputError: no such model.
            ArtifactError: what lies there belongs to another case or configuration.
            StorageError: the disk refused.
            Interrupted: Ctrl-C; the state is saved.
        """
        import torch

        trained = name.removesuffix(UNREFINED)
        folder = self.folder / case.name / f"{trained}-seed{seed}-{steps}steps"
        run = TrainingRun(
            anatomy_ct=case.anatomy_ct,
            up_lps=case.up_lps,
            case_sha256=store.sha256_of(case.folder / store.MANIFEST),
            config=train_config(trained, case, self._presets),
            seed=seed,
            steps=steps,
            device=self._device,  # type: ignore[arg-type]
            workers=self._workers,
        )
        if not is_finished(folder) or not _same(folder, run):
            threads = torch.get_num_threads()
            label = f"{case.name} {trained} seed {seed}"
            report = self._report or (lambda *_: None)
            train(run, folder, lambda status: report(label, status))
            torch.set_num_threads(threads)  # training leaves some cores to its workers
        return Network(name, folder, self._device, unrefined=trained != name)


def _same(folder: Path, run: TrainingRun) -> bool:
    """Whether a finished model is this run's; else training refuses it with a clear text."""
    manifest = store.read_json(folder / store.MANIFEST)
    return manifest["provenance"].get("run_sha256") == run.identity
