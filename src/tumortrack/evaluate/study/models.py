"""The models of the study: trained by a preset's rules for a fixed number of steps, kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from tumortrack.core import store
from tumortrack.core.types import Anatomy
from tumortrack.evaluate.study.measure import StudyCase
from tumortrack.evaluate.study.methods import Network
from tumortrack.learn.config import TrainConfig
from tumortrack.learn.model import is_finished
from tumortrack.learn.train import Run, Status, run_identity, train
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.deform.drag import CONFIGURATIONS

# A preset: anatomy and rotations (limited, full) -> training configuration.
Preset = Callable[[Anatomy, str], TrainConfig]
Report = Callable[[str, Status], None]
MODELS = {"M_lim": "limited", "M_full": "full"}


def configuration_name(number: int) -> str:
    """Name of the model trained with one row of the paper's deformation table."""
    return f"configuration_{number}"


def train_config(name: str, case: StudyCase, preset: Preset) -> TrainConfig:
    """M_lim and M_full by the preset as it is; ``configuration_n`` by the preset with limited
    rotations and the paper's drags n as the only deformation."""
    if name in MODELS:
        return preset(case.anatomy_ct, MODELS[name])
    drags = DragConfig(steps=CONFIGURATIONS[int(name.rpartition("_")[2])])
    config = preset(case.anatomy_ct, "limited")
    return msgspec.structs.replace(
        config, scene=msgspec.structs.replace(config.scene, deform=(drags,))
    )


class Trainer:
    """Trains what is not trained yet; a training that was killed is taken up again.

    Steps decide the end, not minutes: a loaded machine gives the same model, only later.
    """

    def __init__(
        self,
        folder: Path,
        preset: Preset,
        steps: int,
        device: str = "auto",
        workers: int | None = None,
        report: Report | None = None,
    ) -> None:
        self.folder, self.steps = folder, steps
        self._preset, self._device, self._workers = preset, device, workers
        self._report = report

    def model(self, case: StudyCase, name: str, seed: int) -> Network:
        """The model under FOLDER/CASE/NAME-seed-steps.

        Raises:
            ArtifactError: what lies there belongs to another case or configuration.
            StorageError: the disk refused.
            Interrupted: Ctrl-C; the state is saved.
        """
        import torch

        folder = self.folder / case.name / f"{name}-seed{seed}-{self.steps}steps"
        run = Run(
            anatomy_ct=case.anatomy_ct,
            up_lps=case.up_lps,
            case_sha256=store.sha256_of(case.folder / store.MANIFEST),
            config=train_config(name, case, self._preset),
            seed=seed,
            steps=self.steps,
            device=self._device,  # type: ignore[arg-type]
            workers=self._workers,
        )
        if not is_finished(folder) or not _same(folder, run):
            threads = torch.get_num_threads()
            train(run, folder, lambda status: self._tell(f"{case.name} {name} seed {seed}", status))
            torch.set_num_threads(threads)  # training leaves some cores to its workers
        return Network(name, folder, self._device)

    def _tell(self, name: str, status: Status) -> None:
        if self._report:
            self._report(name, status)


def _same(folder: Path, run: Run) -> bool:
    """Whether a finished model is this run's; else training refuses it with a clear text."""
    manifest = store.read_json(folder / store.MANIFEST)
    return manifest["provenance"].get("run_sha256") == run_identity(run)
