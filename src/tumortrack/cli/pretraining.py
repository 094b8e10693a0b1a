"""`tumortrack pretrain`: random kidneys -> weights that every patient's training may start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.training.model import PretrainedWeights


@dataclass(frozen=True)
class PretrainOptions:
    anatomies: int = 40
    steps: int = 6000
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0


def pretrain(folder: Path, options: PretrainOptions) -> None:
    """Pretrained weights into ``folder``, resumed where a run was begun."""
    from tumortrack.cli.training import TrainingScreen
    from tumortrack.training.model import PRETRAINED
    from tumortrack.training.presets import pretraining
    from tumortrack.training.pretrain import Pretraining
    from tumortrack.training.pretrain import pretrain as fit

    run = Pretraining(
        pretraining(),
        options.anatomies,
        options.steps,
        options.seed,
        options.device,
        options.workers,
        options.checkpoint_every_s,
    )
    if (folder / store.MANIFEST).is_file():
        done = store.read_manifest(folder, PRETRAINED).get("provenance", {})
        if done.get("run_sha256") != run.identity:
            raise InputError(
                f"{folder} holds weights of other options or another seed. Choose another folder."
            )
        say(f"{folder} is pretrained already ({done['steps']} steps).")
        return
    with TrainingScreen() as screen:
        about = fit(run, folder, screen.show)
    say(
        f"weights written to {folder}: {about['steps']} steps over {about['anatomies']} random "
        f"kidneys in {about['training_s']:.0f} s. Use them: tumortrack train CASE MODEL --start "
        f"{folder}"
    )


def start_of(folder: Path | None) -> PretrainedWeights | None:
    """The weights that ``train --start`` names."""
    if folder is None:
        return None
    from tumortrack.training.model import load_start

    return load_start(folder)
