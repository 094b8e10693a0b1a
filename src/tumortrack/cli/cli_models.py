"""The command line of models: see ``cli.main``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def train(
    case: Positional[Path],
    model: Positional[Path],
    /,
    *,
    preset: Literal["clinic", "quick", "paper"] = "clinic",
    rotations: Literal["limited", "full"] = "limited",
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    workers: int | None = None,
    checkpoint_every: float = 30.0,
    start: Path | None = None,
) -> None:
    """Train a model for a case; the same command resumes after Ctrl-C or a crash.

    Args:
        case: folder that `prepare` wrote.
        model: folder to write.
        preset: network and rules of training: clinic places the organ of the CT (default), quick
            and paper label points.
        rotations: poses to learn: any turn about the camera's axis and tilts up to 15 degrees
            (clinic: 30), or every rotation.
        minutes: stop after about so long (default: the preset's end).
        steps: stop after exactly so many steps.
        seed: of weights and scenes.
        device: auto takes CUDA where it is.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every: seconds; a crash loses at most the steps since.
        start: folder that `pretrain` wrote: learn the patient from there (preset clinic).
    """
    from tumortrack.cli import commands

    commands.train(
        case,
        model,
        commands.TrainOptions(
            preset, rotations, minutes, steps, seed, device, workers, checkpoint_every, start
        ),
    )


def pretrain(
    out: Positional[Path],
    /,
    *,
    anatomies: int = 40,
    steps: int = 6000,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    workers: int | None = None,
    checkpoint_every: float = 30.0,
) -> None:
    """Teach a network on random kidneys, as a start for `train`; the same command resumes.

    Args:
        out: folder to write.
        anatomies: how many random kidneys.
        steps: stop after exactly so many steps.
        seed: of kidneys, weights and scenes.
        device: auto takes CUDA where it is.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every: seconds; a crash loses at most the steps since.
    """
    from tumortrack.cli.pretraining import PretrainOptions
    from tumortrack.cli.pretraining import pretrain as run

    run(out, PretrainOptions(anatomies, steps, seed, device, workers, checkpoint_every))


def evaluate(
    model: Positional[Path],
    variants: Positional[Path],
    report: Positional[Path],
    /,
    *,
    grid: int = 160,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Locate in every scene of a folder and compare with the truth.

    Args:
        model: folder that `train` wrote.
        variants: folder of scene folders.
        report: folder to write: report.json, index.html, pictures.
        grid: voxels along the longest side of the labelled volume.
        seed: of the random points and queries.
        device: auto takes CUDA where it is.
    """
    from tumortrack.cli import commands

    commands.evaluate(model, variants, report, grid, seed, device)


def compile(model: Positional[Path], /, *, device: Literal["auto", "cpu", "cuda"] = "auto") -> None:
    """Make a model as fast as this machine allows, before the first frame.

    Args:
        model: folder that `train` wrote; what is found fastest is kept in MODEL/compiled.
        device: auto takes CUDA where it is.
    """
    from tumortrack.cli.compiling import compile_model

    compile_model(model, device)


def onnx(model: Positional[Path], out: Positional[Path], /, *, overwrite: bool = False) -> None:
    """Write a model's network as an ONNX file, for other programs.

    Args:
        model: folder that `train` wrote.
        out: file to write, .onnx: clouds and queries in, logits out (quick, paper); clouds in,
            placements out (clinic). docs/method.md says what they mean.
        overwrite: replace OUT if it exists.
    """
    from tumortrack.cli.onnx_export import write_onnx

    write_onnx(model, out, overwrite)
