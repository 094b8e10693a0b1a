"""What each command does: read artifacts, call the library, write artifacts, tell the user."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tumortrack.cli.console import console, progress_bar, say
from tumortrack.cli.loading import keep_loaded
from tumortrack.cli.pretraining import start_of
from tumortrack.cli.scenes import SimulateOptions, check_case, write_scenes
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy, DepthFrame, SensorCloud

if TYPE_CHECKING:
    from tumortrack.imaging.prepare import PrepareOptions
    from tumortrack.sense.cloud import CloudConfig
    from tumortrack.tracking.point_table import PointTable

Device = Literal["auto", "cpu", "cuda"]


def prepare(source: Path, folder: Path, options: PrepareOptions, overwrite: bool) -> None:
    """`tumortrack prepare`: input -> case folder with a picture to check it by."""
    from tumortrack.imaging.case import KIND, save_case
    from tumortrack.imaging.prepare import prepare as make_case
    from tumortrack.report.pictures import qc_picture

    store.check_place(folder, KIND, overwrite)
    case = make_case(source, options)
    with store.new_folder(folder, overwrite) as aside:
        qc_picture(case.labels, case.ct, case.anatomy, aside / "qc.png")
        save_case(case, aside)
    for note in case.report.get("notes", []):
        say(f"note: {note}")
    for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
        say(f"{name}: {part.volume_mm3 / 1000:.1f} ml")
    say(f"case written to {folder}; look at {folder / 'qc.png'} before you rely on it.")


@dataclass(frozen=True)
class TrainOptions:
    preset: Literal["clinic", "quick", "paper"] = "clinic"
    rotations: Literal["limited", "full"] = "limited"
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0
    start: Path | None = None


def train(case_folder: Path, folder: Path, options: TrainOptions) -> None:
    """`tumortrack train`: case -> model folder, resumed where one was begun."""
    from tumortrack.imaging.case import load_case

    if options.minutes is not None and not options.minutes > 0:
        raise InputError(f"--minutes {options.minutes} must be more than 0.")
    if options.steps is not None and options.steps < 1:
        raise InputError(f"--steps {options.steps} must be at least 1.")
    if options.minutes is not None and options.steps is not None:
        raise InputError("--minutes and --steps both say when to stop; give one of them.")
    if options.workers is not None and options.workers < 0:
        raise InputError(f"--workers {options.workers} must be 0 or more.")
    case = load_case(case_folder)  # what is wrong so far is said before PyTorch's seconds

    from tumortrack.cli.training import TrainingScreen
    from tumortrack.models.folder import is_finished
    from tumortrack.training.model import load_model
    from tumortrack.training.presets import PRESETS
    from tumortrack.training.train import TrainingRun, run_identity
    from tumortrack.training.train import train as fit

    keep_loaded()
    run = TrainingRun(
        anatomy_ct=case.anatomy,
        up_lps=case.up_lps,
        case_sha256=store.sha256_of(case_folder / store.MANIFEST),
        config=PRESETS[options.preset](case.anatomy, options.rotations),
        seed=options.seed,
        steps=options.steps,
        minutes=options.minutes,
        device=options.device,
        workers=options.workers,
        checkpoint_every_s=options.checkpoint_every_s,
        start=start_of(options.start),
    )
    if is_finished(folder):
        done = load_model(folder).provenance
        if done.get("run_sha256") != run_identity(run):
            raise InputError(
                f"{folder} holds a model of another case, preset, seed or option. Choose another "
                "MODEL folder."
            )
        say(f"{folder} is trained already ({done['steps']} steps).")
        return
    with TrainingScreen() as screen:
        model = fit(run, folder, screen.show)
    about = model.provenance
    say(
        f"model written to {folder}: {about['steps']} steps in {about['training_s']:.0f} s, "
        f"validation mIoU {about['validation_miou']:.3f}."
    )


@dataclass(frozen=True)
class LocateOptions:
    grid: int = 160
    seed: int = 0
    range_mm: tuple[float, float] | None = None
    unit: Literal["mm", "m"] = "mm"
    intrinsics: Path | None = None
    map_points: Path | None = None
    device: Device = "auto"
    overwrite: bool = False


def locate(model_folder: Path, source: Path, out: Path, options: LocateOptions) -> None:
    """`tumortrack locate`: one cloud or depth image -> run folder."""
    _check_grid(options.grid)
    store.check_place(out, "run", options.overwrite)
    points = _asked(options.map_points, model_folder)
    seen, notes = _read(source, options)  # what is wrong so far is said before PyTorch's seconds

    from tumortrack.tracking.files import write_estimate
    from tumortrack.tracking.tracker import Tracker
    from tumortrack.training.model import load_model

    keep_loaded()
    model = load_model(model_folder, options.device)
    tracker, notes = Tracker(model), (*notes, *model.notes)
    points = _near_organ(points, tracker.anatomy_ct, str(options.map_points))
    cloud = _observed(seen, model.config.scene.cloud, options)
    estimate = tracker.locate(cloud, options.grid, options.seed)
    if points is not None and options.map_points is not None:
        notes = (*notes, *points.notes)
        estimate.report["map"] = {
            "points": len(points.points_ct),
            "from": "lps",
            "to": "camera",
            "sha256": store.sha256_of(options.map_points),
        }
    estimate.report.update(
        notes=list(notes),
        model=model.provenance,
        model_sha256=store.sha256_of(model_folder / store.MANIFEST),
        cloud_sha256=store.sha256_of(source),
    )
    write_estimate(out, estimate, options.overwrite, points)
    for note in notes:
        say(f"note: {note}")
    for name, part in estimate.report["parts"].items():
        if part["found"]:
            x, y, z = part["center_mm"]
            say(f"{name}: {part['volume_ml']:.1f} ml, centre ({x:.1f}, {y:.1f}, {z:.1f}) mm")
        else:
            say(f"{name}: not found")
    if points is not None:
        say(f"{len(points.points_ct)} points of the CT: their places are in {out / 'points.csv'}")
    say(f"written to {out} (camera frame, mm) in {estimate.report['timings']['total']:.2f} s.")


def _asked(path: Path | None, model_folder: Path) -> PointTable | None:
    """The points of --map; model and points are checked before there is anything to wait for."""
    from tumortrack.models.folder import has_shape, read_model_manifest
    from tumortrack.tracking.points import read_points

    manifest = read_model_manifest(model_folder)
    if path is None:
        return None
    if not has_shape(manifest):
        raise InputError(
            f"--map: {model_folder} says what is where, but not which point of the CT lies there. "
            "A model of the preset clinic knows: tumortrack train CASE MODEL --preset clinic."
        )
    return read_points(path)


def _near_organ(
    points: PointTable | None, anatomy_ct: Anatomy | None, name: str
) -> PointTable | None:
    """The same, with notes about those far from the organ."""
    from tumortrack.tracking.points import check_near_organ

    if points is None:
        return None
    assert anatomy_ct is not None  # a model with a shape
    far = check_near_organ(points.points_ct, anatomy_ct.organ.box_mm, name)
    return replace(points, notes=(*points.notes, *far))


def _read(source: Path, options: LocateOptions) -> tuple[SensorCloud | DepthFrame, tuple[str, ...]]:
    """What the file holds, and notes."""
    from tumortrack.sense.cloud import check_cloud
    from tumortrack.sense.files import read_cloud, read_depth_png

    if source.suffix.lower() == ".png":
        if options.intrinsics is None:
            raise InputError(f"{source} is a depth image: give --intrinsics FILE.json with it.")
        if options.unit != "mm":
            raise InputError(
                "--unit is for clouds; a depth image's unit stands in its intrinsics file as "
                "depth_unit_mm (mm per step)."
            )
        return read_depth_png(source, options.intrinsics), ()
    if options.intrinsics is not None:
        raise InputError(f"--intrinsics is for depth images (.png); {source} is a cloud.")
    cloud, notes = read_cloud(source, options.unit)
    check_cloud(cloud)  # before the crop, which would only say that nothing lies in range
    return cloud, notes


def _observed(
    seen: SensorCloud | DepthFrame, trained: CloudConfig, options: LocateOptions
) -> SensorCloud:
    """The cloud, cropped as the options say."""
    from tumortrack.sense.cloud import CloudConfig, cloud_from_depth, crop_cloud

    near, far = options.range_mm or (trained.near_mm, trained.far_mm)
    if isinstance(seen, SensorCloud):
        return crop_cloud(seen, near, far) if options.range_mm else seen
    crop = CloudConfig(near_mm=near, far_mm=far, n_points=trained.n_points)
    return cloud_from_depth(seen, crop, np.random.default_rng(options.seed))


def simulate(case_folder: Path, dataset: Path, options: SimulateOptions) -> None:
    """`tumortrack simulate`: case -> folder of scenes, one folder each."""
    write_scenes(case_folder, dataset, options)
    say(f"{options.scenes} scenes written to {dataset}.")


def evaluate(
    model_folder: Path, scenes: Path, report: Path, grid: int, seed: int, device: Device
) -> None:
    """`tumortrack evaluate`: model x scenes -> report folder."""
    from tumortrack.models.folder import read_model_manifest
    from tumortrack.simulate.scene_folder import list_scenes

    _check_grid(grid)
    if (report / store.MANIFEST).exists():
        raise InputError(f"{report} is a case, model or run; choose another REPORT folder.")
    read_model_manifest(model_folder)
    folders = list_scenes(scenes)  # what is wrong so far is said before PyTorch's seconds

    from tumortrack.report.protocol import evaluate_scenes, summary_table
    from tumortrack.tracking.tracker import Tracker
    from tumortrack.training.model import load_model

    keep_loaded()
    model = load_model(model_folder, device)
    check_case(model, folders)
    about = {
        "model": model.provenance,
        "model_sha256": store.sha256_of(model_folder / store.MANIFEST),
        "scenes_folder": str(scenes),
        "grid": grid,
        "seed": seed,
    }
    tracker = Tracker(model)
    for note in model.notes:
        say(f"note: {note}")
    with progress_bar("evaluate", len(folders)) as advance:
        result = evaluate_scenes(
            lambda cloud: tracker.locate(cloud, grid, seed),
            scenes,
            report,
            lambda *_: advance(),
            about,
        )
    console.print(summary_table(result))
    say(f"written to {report / 'report.json'}; look at {report / 'index.html'}.")


def inspect(path: Path) -> None:
    """`tumortrack inspect`: what is this."""
    from tumortrack.cli.inspection import describe

    for line in describe(path):
        say(line)


def _check_grid(grid: int) -> None:
    from tumortrack.core.estimate import LARGEST_GRID

    if not 8 <= grid <= LARGEST_GRID:
        raise InputError(f"--grid {grid} is not allowed; choose 8 to {LARGEST_GRID}.")
