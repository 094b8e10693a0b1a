"""Training: `train`, and what is seen of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tumortrack.cli.console import Device, keep_loaded, live_line, say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.process import is_follower

if TYPE_CHECKING:
    from tumortrack.training.train import TrainingStatus


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a model for a case; the same command resumes after Ctrl-C or a crash.

    Attributes:
        case: folder that `prepare` wrote.
        model: folder to write.
        preset: network and rules of training: clinic places the organ of the CT (default), quick
            and paper label points.
        rotations: poses to learn: any turn about the camera's axis and tilts up to 15 degrees
            (clinic: 30), or every rotation.
        sensor: whose errors the scenes have: a RealSense D405's, or those of depth by matching a
            stereo endoscope's pictures.
        minutes: train for about so long, once kernels are compiled and the first step is done
            (default: to the preset's end). 0: learn nothing, take what training starts from.
        steps: stop after exactly so many steps.
        seed: of weights and scenes.
        device: auto takes CUDA if there is a GPU.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every: seconds; a crash loses at most the steps since.
        start: folder that `pretrain` wrote: learn the patient from there (preset clinic; default:
            what the package has learnt from random kidneys). none: from nothing.
    """

    case: Positional[Path]
    model: Positional[Path]
    preset: Literal["clinic", "quick", "paper"] = "clinic"
    rotations: Literal["limited", "full"] = "limited"
    sensor: Literal["d405", "stereo"] = "d405"
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every: float = 30.0
    start: Path | None = None

    def run(self) -> None:
        from tumortrack.imaging.case import load_case
        from tumortrack.models import folder

        if self.minutes is not None and not self.minutes >= 0:
            raise InputError(f"--minutes {self.minutes} must be 0 or more.")
        if self.steps is not None and self.steps < 0:
            raise InputError(f"--steps {self.steps} must be 0 or more.")
        if self.minutes is not None and self.steps is not None:
            raise InputError("--minutes and --steps both say when to stop; give one of them.")
        if self.workers is not None and self.workers < 0:
            raise InputError(f"--workers {self.workers} must be 0 or more.")
        case = load_case(self.case)  # report what is wrong so far before PyTorch's seconds
        folder.check_trainable(self.model)
        say("starting ...")

        from tumortrack.training.model import start_of
        from tumortrack.training.presets import PRESETS, seen_by
        from tumortrack.training.train import TrainingRun, train

        if case.anatomy.structures and self.preset != "clinic":
            say_notes([f"{self.preset} knows no motion: structures are left out; clinic has them"])
        keep_loaded()
        config = seen_by(PRESETS[self.preset](case.anatomy, self.rotations), self.sensor)
        run = TrainingRun(
            anatomy_ct=case.anatomy, up_lps=case.up_lps,
            case_sha256=store.sha256_of(self.case / store.MANIFEST),
            config=config, seed=self.seed, steps=self.steps, minutes=self.minutes,
            device=self.device, workers=self.workers, checkpoint_every_s=self.checkpoint_every,
            start=start_of(config.network, self.start), patient=case.patient,
        )  # fmt: skip
        if folder.is_finished(self.model):
            done = folder.read_model_manifest(self.model)["provenance"]
            if differ := run.differences(done.get("decided_by", {})):
                raise InputError(
                    f"{self.model} holds a finished model ({done['steps']} steps, seed "
                    f"{done['seed']}), whose command differs from this one in {differ}. A "
                    "finished training is not extended: choose another MODEL folder."
                )
            say(f"{self.model} is trained already ({done['steps']} steps).")
            say_notes(filter(None, [folder.weakness_of(done)]))
            return
        with training_screen() as show:
            about = train(run, self.model, show).provenance
        say(f"model written to {self.model}: {folder.training_words(about)}.")
        few = bool(self.minutes) and about["steps"] < config.schedule.warmup_steps
        hint = "so few steps teach nearly nothing; train longer, or on a machine with less to do"
        say_notes(filter(None, [hint if few else "", folder.weakness_of(about)]))


@contextmanager
def training_screen() -> Iterator[Callable[[TrainingStatus], None]]:
    """Yields a function that shows a status."""
    from tumortrack.training.distributed import ProcessLost
    from tumortrack.training.state import Diverged
    from tumortrack.training.train import Interrupted

    def show(status: TrainingStatus) -> None:
        end = f"/{status.end}" if status.end is not None else ""
        validated = "" if status.miou is None else f"validation mIoU {status.miou:.3f} | "
        if status.tre_mm is not None:
            validated = f"validation {status.tre_mm:.1f} mm off | "
        minutes, seconds = divmod(int(status.seconds_left), 60)
        line(
            f"step {status.step}{end} | {status.samples_per_s:.0f} samples/s | loss "
            f"{status.loss:.4f} | {validated}{minutes}:{seconds:02d} left | "
            f"{status.waiting:.0%} waiting for scenes",
            last=status.step == status.end,
        )

    try:
        with live_line("making labelled points, starting workers ...") as line:
            yield show
    except (Interrupted, Diverged, ProcessLost) as error:
        if is_follower():  # the first process reports the same
            raise SystemExit(error.exit_code) from error
        raise
