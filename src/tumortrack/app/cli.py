"""The command line: one function a command, its types are its options."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import tyro
from tyro.conf import Positional

from tumortrack.core.errors import TumortrackError


def prepare(
    input: Positional[Path],
    case: Positional[Path],
    /,
    *,
    kidney_hu: tuple[float, float] = (-300.0, 300.0),
    tumor_hu: tuple[float, float] = (300.0, 1000.0),
    labels: bool = False,
    side: Literal["left", "right"] | None = None,
    organ: int = 1,
    tumor: int | None = None,
    up: str = "anterior",
    series: str | None = None,
    unit: Literal["mm", "m"] | None = None,
    min_tumor_ml: float = 0.2,
    overwrite: bool = False,
) -> None:
    """Make a case from a CT, a label map or a folder of meshes.

    Args:
        input: DICOM folder, CT volume or label map (.nii, .nii.gz, .nrrd), or folder of meshes.
        case: folder to write.
        kidney_hu: HU window of the kidney in a CT: low (inclusive) and high.
        tumor_hu: HU window of the tumors in a CT.
        labels: INPUT is a label map (recognised by itself where that is plain).
        side: the patient's kidney to take; default: the one with the largest tumor.
        organ: label number of the kidney.
        tumor: label number of the tumors; default: every label from 2 up. 0: none.
        up: patient direction that faces the camera: anterior, left, ... or "x,y,z" in LPS.
        series: which DICOM series, if the folder holds several (UID or number in the list).
        unit: of mesh files.
        min_tumor_ml: smaller tumors are reported and dropped.
        overwrite: replace CASE if it exists.
    """
    from tumortrack.app import commands
    from tumortrack.imaging.prepare import PrepareOptions

    options = PrepareOptions(
        kidney_hu=kidney_hu,
        tumor_hu=tumor_hu,
        labels=labels,
        side=side,
        organ=organ,
        tumor=tumor,
        up=up,
        series=series,
        unit=unit,
        min_tumor_ml=min_tumor_ml,
    )
    commands.prepare(input, case, options, overwrite)


def export(
    case: Positional[Path],
    out: Positional[Path],
    /,
    *,
    dicom: Path | None = None,
    series: str | None = None,
) -> None:
    """Write a case's segmentation for 3D Slicer and, with its CT, as DICOM.

    Args:
        case: folder that `prepare` wrote.
        out: folder to write: case.seg.nrrd and, with --dicom, segmentation.dcm.
        dicom: folder of the CT's slices that the case's voxels come from.
        series: which of its series, if the folder holds several (UID or number in the list).
    """
    from tumortrack.app.export import export as run

    run(case, out, dicom, series)


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
    from tumortrack.app import commands

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
    from tumortrack.app.pretraining import PretrainOptions
    from tumortrack.app.pretraining import pretrain as run

    run(out, PretrainOptions(anatomies, steps, seed, device, workers, checkpoint_every))


def locate(
    model: Positional[Path],
    cloud: Positional[Path],
    out: Positional[Path],
    /,
    *,
    grid: int = 160,
    seed: int = 0,
    range: tuple[float, float] | None = None,
    unit: Literal["mm", "m"] = "mm",
    intrinsics: Path | None = None,
    map: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    overwrite: bool = False,
) -> None:
    """Locate kidney and tumors in one cloud or depth image.

    Args:
        model: folder that `train` wrote.
        cloud: .ply, .pcd or .npz in the camera frame, or a depth .png (with --intrinsics).
        out: folder to write.
        grid: voxels along the longest side of the labelled volume, up to 400.
        seed: of the random points and queries.
        range: keep depths between NEAR and FAR mm; a cloud is else used as it is, a depth image
            cropped by the range the model was trained for.
        unit: of the cloud's numbers.
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels.
        map: points of the CT, to be found before the camera (OUT/points.csv): a .csv with columns
            x,y,z (LPS, mm), or 3D Slicer's .mrk.json or .fcsv. Needs a model of preset clinic.
        device: auto takes CUDA where it is.
        overwrite: replace OUT if it exists.
    """
    from tumortrack.app import commands

    commands.locate(
        model,
        cloud,
        out,
        commands.LocateOptions(grid, seed, range, unit, intrinsics, map, device, overwrite),
    )


def track(
    model: Positional[Path],
    source: Positional[str],
    sinks: Positional[tuple[str, ...]] = (),
    /,
    *,
    range: tuple[float, float] | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    whole: bool = False,
    frame: Path | None = None,
    intrinsics: Path | None = None,
    smoothing: float = 0.0,
    rescan: float = 1.0,
    stale: float = 0.5,
    give_up: float = 60.0,
    seconds: float = 0.0,
    report: Path | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Follow kidney and tumors live, from a camera to viewers, recordings and robots.

    Sources and sinks are written kind:target?option=value&option=value. Sources: virtual:CASE,
    recording:PATH, realsense[:SERIAL|FILE], ros2:TOPIC, ros1:TOPIC. Sinks: viewer[:PORT],
    recording:FOLDER, ros2[:TOPIC], ros1[:TOPIC], openigtlink[:PORT]. A wrong one is answered with
    its options. docs/live.md has examples.

    Args:
        model: folder that `train` wrote.
        source: where frames come from.
        sinks: where estimates go; any number.
        range: keep depths between NEAR and FAR mm (default: those that the model has learned).
        box: keep what lies in a box: two opposite corners X Y Z X Y Z, camera frame, mm.
        whole: what is in range and box is the organ alone; do not look for it among other things.
        frame: JSON file that says where the camera is; results are then in the robot's frame.
        intrinsics: JSON with the camera's width, height, fx, fy, cx, cy in pixels, instead of what
            the source says.
        smoothing: time constant in s of a mean over past estimates; the lag is in the report.
        rescan: every so many s, look for the organ as in a first frame.
        stale: frames older than so many s are refused, and a pause so long is said.
        give_up: end after so many s without a frame.
        seconds: end so many s after the first frame; 0: never.
        report: file for latencies, counts and reasons (default: runs/track-TIME.json).
        seed: of the random points.
        device: auto takes CUDA where it is.
    """
    from tumortrack.app import live

    live.track(
        model,
        source,
        sinks,
        live.TrackOptions(
            range,
            box,
            whole,
            frame,
            intrinsics,
            smoothing,
            rescan,
            stale,
            give_up,
            seconds,
            report,
            seed,
            device,
        ),
    )


def plan(
    run: Positional[Path],
    plan: Positional[Path],
    /,
    *,
    method: Literal["margin", "published"] | None = None,
    tumor: str | None = None,
    margin: float | None = None,
    sigmas: float | None = None,
    config: Path | None = None,
    frame: Path | None = None,
    stand: float | None = None,
    cell: Path | None = None,
    arms: bool = True,
    overwrite: bool = False,
) -> None:
    """Plan how to cut a located tumor out, and how two arms do it.

    Args:
        run: folder that `locate` wrote.
        plan: folder to write: plan.json, strokes.ply, plan.png, motions, the cell as URDF.
        method: margin (default) keeps the margin in all directions; published is the paper's
            planner.
        tumor: which one (tumor_1, ...; default: the one that lies farthest out of the organ).
        margin: least distance between tumor and cut in mm (default 5).
        sigmas: add so many standard deviations of the estimate's own uncertainty to the margin
            (default 0).
        config: JSON file with these and all other choices of the planner (docs/resection.md).
        frame: JSON file that says where the camera is; the plan is then in the robot's frame, whose
            z must point up. Without, the camera looks straight down.
        stand: height of the organ's lowest point over the table in mm, where no frame is given.
        cell: JSON file with arms, tools, table and their places (docs/resection.md).
        arms: also plan the motions of both arms.
        overwrite: replace PLAN if it exists.
    """
    from tumortrack.app import planning

    given = {"method": method, "tumor": tumor, "margin_mm": margin, "sigmas": sigmas}
    choices = planning.choices(config, {k: v for k, v in given.items() if v is not None})
    planning.plan(run, plan, choices, planning.PlanOptions(frame, stand, cell, arms, overwrite))


def resect(
    plan: Positional[Path],
    sinks: Positional[tuple[str, ...]] = (),
    /,
    *,
    live: tuple[Path, str] | None = None,
    range: tuple[float, float] | None = None,
    box: tuple[float, float, float, float, float, float] | None = None,
    whole: bool = False,
    intrinsics: Path | None = None,
    speed: float = 1.0,
    moved: float = 2.0,
    film: Path | None = None,
    report: Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Carry a plan out with virtual arms, seen by sinks as those of `track`.

    Args:
        plan: folder that `plan` wrote.
        sinks: where arms, cuts and estimates go; see `track`. ur:ADDRESS is a real arm, and only
            says what it would do unless told execute=true.
        live: MODEL SOURCE: follow the organ meanwhile, as `track` does. Arms stand while there is
            no good estimate, and it is planned anew where the tumor has moved.
        range: of depths, as in `track`.
        box: as in `track`.
        whole: as in `track`.
        intrinsics: as in `track`.
        speed: of the arms' time; 2 is twice as fast.
        moved: the tumor has moved if its surface has by so many mm (root mean square).
        film: write an animated GIF of the stored plan instead.
        report: file for states, halts and what else there was (default: runs/resect-TIME.json).
        device: auto takes CUDA where it is.
    """
    from tumortrack.app import resection

    resection.resect(
        plan,
        sinks,
        resection.ResectOptions(
            live, range, box, whole, intrinsics, speed, moved, film, report, device
        ),
    )


def simulate(
    case: Positional[Path],
    dataset: Positional[Path],
    /,
    *,
    scenes: int = 20,
    seed: int = 0,
    configuration: tuple[Literal[1, 2, 3, 4, 5, 6], ...] = (3,),
    falloff: Literal["sigma", "variance"] = "sigma",
    rotations: Literal["limited", "full"] = "limited",
    squeeze: bool = False,
    noise: bool = True,
    elastic: bool = False,
) -> None:
    """Write deformed scenes of a case with their truth: what `evaluate` reads.

    Args:
        case: folder that `prepare` wrote.
        dataset: folder to write.
        scenes: how many.
        seed: of the scenes; they are never those that training sees.
        configuration: of the paper's deformation table; several are mixed.
        falloff: how the table's third number is read (docs/method.md).
        rotations: poses, as in `train`.
        squeeze: also squeeze and bend the organ as a whole.
        noise: with the depth sensor's noise.
        elastic: deform the organ as an elastic body in its bed does (plates, instruments, pulls,
            weight, swelling), instead of by the paper's table.
    """
    from tumortrack.app import commands

    commands.simulate(
        case,
        dataset,
        commands.SimulateOptions(
            scenes, seed, configuration, falloff, rotations, squeeze, noise, elastic
        ),
    )


def twin(
    case: Positional[Path],
    scenes: Positional[Path],
    /,
    *,
    seed: int = 0,
    states: tuple[
        Literal["D0", "D1", "D2", "D3", "Rot90", "Rot180", "Rot270", "G1", "P1"], ...
    ] = (),
    views: tuple[Literal["clean", "noise", "shaft", "clutter"], ...] = (),
) -> None:
    """Squeeze, turn, sink and poke a case by finite elements, and write the scenes with truth.

    Args:
        case: folder that `prepare` wrote.
        scenes: folder to write: what `evaluate` reads. The same command resumes.
        seed: of noise, instruments, background and target points.
        states: which of them; default: all.
        views: which of them; default: all.
    """
    from tumortrack.app.twin import write_twin

    write_twin(case, scenes, seed, states, views)


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
    from tumortrack.app import commands

    commands.evaluate(model, variants, report, grid, seed, device)


def demo(*, out: Path = Path("runs/demo"), minutes: float = 2.0, scenes: int = 20) -> None:
    """The whole story on the built-in phantom, in a few minutes.

    Args:
        out: folder for everything the demo makes; what an earlier demo left there is replaced.
        minutes: of training.
        scenes: unseen deformed scenes to locate tumors in.
    """
    from tumortrack.app.demo import run_demo

    run_demo(out, minutes, scenes)


def bench(
    *,
    only: tuple[
        Literal[
            "generator", "elastic-generator", "encoder", "decoder", "frame", "tracking", "volume",
            "command", "planning", "gpu", "training", "whole-training",
        ],
        ...,
    ] = (),
    quick: bool = False,
    curves: bool = False,
    model: Path | None = None,
    cloud: Path | None = None,
    out: Path = Path("runs/bench.json"),
    document: Path | None = None,
) -> None:  # fmt: skip
    """Measure the speed of every part on this machine, each beside its naive form, in turns.

    Args:
        only: which parts; default: all.
        quick: shorter measurements, about a minute in all once there are models.
        curves: also how time and memory grow with queries, points, tumors, voxels and batch.
        model: folder that `train` wrote, to be measured instead of the one that the bench trains
            (kept in runs/bench).
        cloud: of that model's organ, freed of its background; .ply, .pcd or .npz in mm.
        out: JSON file to write; curves lie beside it.
        document: Markdown file whose marked blocks are to be filled, such as docs/performance.md.
    """
    from tumortrack.app.benching import BenchOptions
    from tumortrack.app.benching import bench as run

    run(BenchOptions(only, quick, curves, model, cloud, out, document))


def compile(model: Positional[Path], /, *, device: Literal["auto", "cpu", "cuda"] = "auto") -> None:
    """Make a model as fast as this machine allows, before the first frame.

    Args:
        model: folder that `train` wrote; what is found fastest is kept in MODEL/compiled.
        device: auto takes CUDA where it is.
    """
    from tumortrack.app.compiling import compile_model

    compile_model(model, device)


def onnx(model: Positional[Path], out: Positional[Path], /, *, overwrite: bool = False) -> None:
    """Write a model's network as an ONNX file, for other programs.

    Args:
        model: folder that `train` wrote.
        out: file to write, .onnx: clouds and queries in, logits out (quick, paper); clouds in,
            placements out (clinic). docs/method.md says what they mean.
        overwrite: replace OUT if it exists.
    """
    from tumortrack.app.onnx_export import write_onnx

    write_onnx(model, out, overwrite)


def inspect(path: Positional[Path], /) -> None:
    """Say what a case, model, run, scene or report is.

    Args:
        path: folder or file.
    """
    from tumortrack.app import commands

    commands.inspect(path)


def doctor() -> None:
    """Say what works on this machine."""
    from tumortrack.app.doctor import examine

    examine()


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "prepare": prepare,
    "export": export,
    "train": train,
    "pretrain": pretrain,
    "locate": locate,
    "track": track,
    "plan": plan,
    "resect": resect,
    "simulate": simulate,
    "twin": twin,
    "evaluate": evaluate,
    "bench": bench,
    "compile": compile,
    "onnx": onnx,
    "inspect": inspect,
    "doctor": doctor,
}


_OBJECTS_A_COLLECTION = 20_000


def main() -> None:
    """Entry point."""
    # OpenMP's threads wait by spinning; where other programs want the cores that is several times
    # slower than giving them back soon, and no faster where they don't.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # NumPy's and SciPy's matrices here are small: more threads gain little, and lose much likewise.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # PyTorch and its kin make objects by the hundred thousand that live to the end: to look through
    # them for garbage again and again is a tenth of the time of their import.
    gc.set_threshold(_OBJECTS_A_COLLECTION)
    if code := run(sys.argv[1:]):
        sys.exit(code)


def run(arguments: list[str]) -> int:
    """One command: its exit code. A known error is one line, never a traceback."""
    try:
        _call(arguments)
    except TumortrackError as error:
        print(f"tumortrack: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("tumortrack: stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `tumortrack inspect X | head`
        sys.stderr.close()
        return 1
    return 0


def _call(arguments: list[str]) -> None:
    """Only the chosen command's options are made; all of them take several times as long."""
    if arguments and (command := COMMANDS.get(arguments[0])) is not None:
        tyro.cli(command, prog=f"tumortrack {arguments[0]}", args=arguments[1:])
        return
    tyro.extras.subcommand_cli_from_dict(
        COMMANDS,
        prog="tumortrack",
        description="Locate kidney and tumors under deformation from one depth image. "
        "Research software, not a medical device.",
        args=arguments,
    )


if __name__ == "__main__":
    main()
