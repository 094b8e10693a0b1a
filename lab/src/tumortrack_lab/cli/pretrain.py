"""`tumortrack pretrain`: a network taught on random kidneys."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from tumortrack.cli.console import Device, say
from tumortrack.cli.training import training_screen
from tumortrack.core import store
from tumortrack.core.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Teach a network on random kidneys, as a start for `train`; the same command resumes.

    Attributes:
        out: folder to write.
        anatomies: how many random kidneys.
        steps: stop after exactly so many steps.
        seed: of kidneys, weights and scenes.
        device: auto takes CUDA if there is a GPU.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every: seconds; a crash loses at most the steps since.
    """

    out: Positional[Path]
    anatomies: int = 400
    steps: int = 10_000
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every: float = 30.0

    def run(self) -> None:
        from tumortrack.training.model import PRETRAINED
        from tumortrack_lab.pretraining.pretrain import Pretraining, pretrain, pretraining

        run = Pretraining(
            config=pretraining(), anatomies=self.anatomies, steps=self.steps, seed=self.seed,
            device=self.device, workers=self.workers, checkpoint_every_s=self.checkpoint_every,
        )  # fmt: skip
        if (self.out / store.MANIFEST).is_file():
            done = store.read_manifest(self.out, PRETRAINED).get("provenance", {})
            if differences := run.differences(done.get("decided_by", {})):
                raise InputError(
                    f"{self.out} holds weights whose command differs from this one in "
                    f"{differences}. Choose another folder."
                )
            say(f"{self.out} is pretrained already ({done['steps']} steps).")
            return
        with training_screen() as show:
            about = pretrain(run, self.out, show)
        say(
            f"weights written to {self.out}: {about['steps']} steps over {about['anatomies']} "
            f"random kidneys in {about['training_s']:.0f} s. Use them: tumortrack train CASE MODEL "
            f"--start {self.out}"
        )
