"""Training: `train`, and what is seen of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tumortrack.cli.console import Device, keep_loaded, live_line, progress_of, say, say_notes
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.imaging.case import Case
    from tumortrack.occupancy.training.train import TrainingStatus


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a network as the paper does (quick, paper); the default method needs no training.

    A case holds its own model: give CASE wherever a command takes MODEL. The same command resumes
    a training after Ctrl-C or a crash.

    Attributes:
        case: folder that `prepare` wrote.
        model: folder to write.
        preset: clinic registers the organ of the CT and learns nothing (default): a model of other
            poses or another sensor than the case's. quick and paper label points by a network.
        rotations: how the organ may lie: turned about the line of sight and tilted, or in any way
            (default: as the case says; quick and paper: limited, tilts up to 15 degrees).
        sensor: whose errors the scenes have: a RealSense D405's, or those of depth by matching a
            stereo endoscope's pictures (default: as the case says).
        minutes: train for about so long, once kernels are compiled and the first step is done
            (default: to the preset's end).
        steps: stop after exactly so many steps.
        seed: of weights and scenes.
        device: of a network; auto takes CUDA if there is a GPU.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every: seconds; a crash loses at most the steps since.
    """

    case: Positional[Path]
    model: Positional[Path]
    preset: Literal["clinic", "quick", "paper"] = "clinic"
    rotations: Literal["limited", "full"] | None = None
    sensor: Literal["d405", "stereo"] | None = None
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every: float = 30.0

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
        case = load_case(self.case)
        folder.check_trainable(self.model)
        if self.preset == "clinic":
            self._make(case)
        else:
            self._train(case)

    def _make(self, case: Case) -> None:
        """A model of the default method."""
        from tumortrack.models import folder
        from tumortrack.tracking.model_files import write_model

        rotations, sensor = self.rotations or case.rotations, self.sensor or case.sensor
        case = replace(case, rotations=rotations, sensor=sensor)
        say("nothing needs to be learnt: the case itself can stand wherever a MODEL is asked for.")
        with progress_of("making the model") as progress:
            made = write_model(case, self.model, seed=self.seed, progress=progress)
        say(f"{self.model} holds the model: {folder.training_words(made.provenance)}.")
        say_notes(filter(None, [folder.weakness_of(made.provenance)]))

    def _train(self, case: Case) -> None:
        """A network."""
        from tumortrack.models import folder
        from tumortrack.tracking.presets import PRESETS, occupancy, seen_by

        training = occupancy("training.train")
        say("starting ...")
        if case.anatomy.structures:
            say_notes([f"{self.preset} knows no motion: structures are left out; clinic has them"])
        keep_loaded()
        config = PRESETS[self.preset](case.anatomy, self.rotations or "limited")
        run = training.TrainingRun(
            anatomy_ct=case.anatomy, up_lps=case.up_lps, case_sha256=case.sha256,
            config=seen_by(config, self.sensor or case.sensor), seed=self.seed, steps=self.steps,
            minutes=self.minutes, device=self.device, workers=self.workers,
            checkpoint_every_s=self.checkpoint_every, patient=case.patient,
        )  # fmt: skip
        if folder.is_finished(self.model):
            done = folder.read_model_manifest(self.model)["provenance"]
            if differ := run.differences(done.get("decided_by", {})):
                raise InputError(
                    f"{self.model} holds a finished model (seed {done['seed']}), whose command "
                    f"differs from this one in {differ}. A finished training is not extended: "
                    "choose another MODEL folder."
                )
            say(f"{self.model} is trained already ({done['steps']} steps).")
            say_notes(filter(None, [folder.weakness_of(done)]))
            return
        with training_screen() as show:
            about = training.train(run, self.model, show).provenance
        say(f"model written to {self.model}: {folder.training_words(about)}.")
        few = bool(self.minutes) and about["steps"] < config.schedule.warmup_steps
        hint = "so few steps teach nearly nothing; train longer, or on a machine with less to do"
        say_notes(filter(None, [hint if few else "", folder.weakness_of(about)]))


@contextmanager
def training_screen() -> Iterator[Callable[[TrainingStatus], None]]:
    """Yields a function that shows a status."""

    def show(status: TrainingStatus) -> None:
        end = f"/{status.end}" if status.end is not None else ""
        validated = "" if status.miou is None else f"validation mIoU {status.miou:.3f} | "
        minutes, seconds = divmod(int(status.seconds_left), 60)
        line(
            f"step {status.step}{end} | {status.samples_per_s:.0f} samples/s | loss "
            f"{status.loss:.4f} | {validated}{minutes}:{seconds:02d} left | "
            f"{status.waiting:.0%} waiting for scenes",
            last=status.step == status.end,
        )

    with live_line("making labelled points, starting workers ...") as line:
        yield show
