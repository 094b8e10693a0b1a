"""Training: `train`, and what is seen of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from tumortrack.cli.console import Device, keep_loaded, live_line, progress_of, say, say_notes

if TYPE_CHECKING:
    from tumortrack.io.case import Case
    from tumortrack.registration.base_model import Model
    from tumortrack.registration.method import TrainingStatus


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a network as the paper does (quick, paper); the default method needs no training.

    A case holds its own model: give CASE wherever a command takes MODEL. The same command resumes
    a training after Ctrl-C or a crash.

    Attributes:
        case: folder that `prepare` wrote.
        model: folder to write.
        preset: elastic registers the organ of the CT and learns nothing (default): a model of other
            poses or another sensor than the case's. quick, quick-long (for hours) and paper
            label points by a network.
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
    preset: Literal["elastic", "quick", "quick-long", "paper"] = "elastic"
    rotations: Literal["limited", "full"] | None = None
    sensor: Literal["d405", "stereo"] | None = None
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every: float = 30.0

    def run(self) -> None:
        from tumortrack import api
        from tumortrack.io import model_folder as folder

        case = api.load_case(self.case)
        train = partial(
            api.train, case, self.model, preset=self.preset, rotations=self.rotations,
            sensor=self.sensor, minutes=self.minutes, steps=self.steps, seed=self.seed,
            device=self.device, workers=self.workers, checkpoint_every_s=self.checkpoint_every,
        )  # fmt: skip
        if self.preset == "elastic":
            self._make(train)
        elif folder.is_finished(self.model):
            done = train().provenance  # read, where it is of the same command
            say(f"{self.model} is trained already ({done['steps']} steps).")
            say_notes(filter(None, [folder.reliability_warning(done)]))
        else:
            self._train(train, case)

    def _make(self, make: Callable[..., Model]) -> None:
        """A model of the default method."""
        from tumortrack.io import model_folder as folder

        say("nothing needs to be learnt: the case itself can stand wherever a MODEL is asked for.")
        with progress_of("making the model") as progress:
            made = make(progress=progress)
        say(f"{self.model} holds the model: {folder.training_words(made.provenance)}.")
        say_notes(filter(None, [folder.reliability_warning(made.provenance)]))

    def _train(self, train: Callable[..., Model], case: Case) -> None:
        """A network."""
        from tumortrack.io import model_folder as folder
        from tumortrack.registration.method import method_of_preset

        method_of_preset(self.preset)  # what is missing is said first
        say("starting ...")
        if case.anatomy.structures:
            say_notes([f"{self.preset} knows no motion: structures are left out; elastic has them"])
        last: TrainingStatus | None = None

        with live_line("making labelled points, starting workers ...") as show:

            def report(status: TrainingStatus) -> None:
                nonlocal last
                if last is None:  # all is loaded
                    keep_loaded()
                last = status
                show(_progress(status), status.step == status.end)

            about = train(on_status=report).provenance
        say(f"model written to {self.model}: {folder.training_words(about)}.")
        few = self.minutes is not None and last is not None and last.warming_up
        hint = "so few steps teach nearly nothing; train longer, or on a machine with less to do"
        say_notes(filter(None, [hint if few else "", folder.reliability_warning(about)]))


def _progress(status: TrainingStatus) -> str:
    end = f"/{status.end}" if status.end is not None else ""
    validated = "" if status.miou is None else f"validation mIoU {status.miou:.3f} | "
    minutes, seconds = divmod(int(status.seconds_left), 60)
    return (
        f"step {status.step}{end} | {status.samples_per_s:.0f} samples/s | loss "
        f"{status.loss:.4f} | {validated}{minutes}:{seconds:02d} left | "
        f"{status.waiting:.0%} waiting for scenes"
    )
