"""What each command does: read artifacts, call the library, write artifacts, tell the user."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from tumortrack.app.console import console, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.types import SensorCloud

if TYPE_CHECKING:
    from tumortrack.imaging.case import Case
    from tumortrack.imaging.prepare import PrepareOptions
    from tumortrack.learn.model import Model
    from tumortrack.simulate.scene import SceneConfig

Device = Literal["auto", "cpu", "cuda"]


def prepare(source: Path, folder: Path, options: PrepareOptions, overwrite: bool) -> None:
    """`tumortrack prepare`: input -> case folder with a picture to check it by."""
    from tumortrack.evaluate.pictures import qc_picture
    from tumortrack.imaging.case import save_case
    from tumortrack.imaging.prepare import prepare as make_case

    with store.new_folder(folder, overwrite) as aside:
        case = make_case(source, options)
        qc_picture(case.labels, case.ct, case.anatomy, aside / "qc.png")
        save_case(case, aside)
    for note in case.report.get("notes", []):
        say(f"note: {note}")
    for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
        say(f"{name}: {part.volume_mm3 / 1000:.1f} ml")
    say(f"case written to {folder}; look at {folder / 'qc.png'} before you rely on it.")


@dataclass(frozen=True)
class TrainOptions:
    preset: Literal["quick", "paper"] = "quick"
    rotations: Literal["limited", "full"] = "limited"
    minutes: float | None = None
    steps: int | None = None
    seed: int = 0
    device: Device = "auto"
    workers: int | None = None
    checkpoint_every_s: float = 30.0


def train(case_folder: Path, folder: Path, options: TrainOptions) -> None:
    """`tumortrack train`: case -> model folder, resumed where one was begun."""
    from tumortrack.app.presets import PRESETS
    from tumortrack.app.training import TrainingScreen
    from tumortrack.imaging.case import load_case
    from tumortrack.learn.model import is_finished, load_model
    from tumortrack.learn.train import Run, run_identity
    from tumortrack.learn.train import train as fit

    if options.minutes is not None and not options.minutes > 0:
        raise InputError(f"--minutes {options.minutes} must be more than 0.")
    if options.steps is not None and options.steps < 1:
        raise InputError(f"--steps {options.steps} must be at least 1.")
    if options.workers is not None and options.workers < 0:
        raise InputError(f"--workers {options.workers} must be 0 or more.")
    case = load_case(case_folder)
    run = Run(
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
    device: Device = "auto"
    overwrite: bool = False


def locate(model_folder: Path, source: Path, out: Path, options: LocateOptions) -> None:
    """`tumortrack locate`: one cloud or depth image -> run folder."""
    from tumortrack.learn.model import load_model
    from tumortrack.track.files import write_estimate
    from tumortrack.track.tracker import Tracker

    _check_grid(options.grid)
    if out.exists() and not options.overwrite:
        raise InputError(f"{out} exists already. Choose another path, or give --overwrite.")
    model = load_model(model_folder, options.device)
    cloud, notes = _observed(model, source, options)
    estimate = Tracker(model).locate(cloud, options.grid, options.seed)
    estimate.report.update(
        notes=list(notes),
        model=model.provenance,
        model_sha256=store.sha256_of(model_folder / store.MANIFEST),
        cloud_sha256=store.sha256_of(source),
    )
    write_estimate(out, estimate, options.overwrite)
    for note in notes:
        say(f"note: {note}")
    for name, part in estimate.report["parts"].items():
        if part["found"]:
            x, y, z = part["center_mm"]
            say(f"{name}: {part['volume_ml']:.1f} ml, centre ({x:.1f}, {y:.1f}, {z:.1f}) mm")
        else:
            say(f"{name}: not found")
    say(f"written to {out} (camera frame, mm) in {estimate.report['timings']['total']:.2f} s.")


def _observed(
    model: Model, source: Path, options: LocateOptions
) -> tuple[SensorCloud, tuple[str, ...]]:
    """The cloud of a cloud file or depth image, cropped as the options say."""
    from tumortrack.sense.cloud import CloudConfig, cloud_from_depth, crop_cloud
    from tumortrack.sense.files import read_cloud, read_depth_png

    trained = model.config.scene.cloud
    near, far = options.range_mm or (trained.near_mm, trained.far_mm)
    if source.suffix.lower() == ".png":
        if options.intrinsics is None:
            raise InputError(f"{source} is a depth image: give --intrinsics FILE.json with it.")
        frame = read_depth_png(source, options.intrinsics)
        crop = CloudConfig(near_mm=near, far_mm=far, n_points=trained.n_points)
        return cloud_from_depth(frame, crop, np.random.default_rng(options.seed)), ()
    cloud, notes = read_cloud(source, options.unit)
    return (crop_cloud(cloud, near, far) if options.range_mm else cloud), notes


@dataclass(frozen=True)
class SimulateOptions:
    scenes: int = 20
    seed: int = 0
    configurations: tuple[int, ...] = (3,)
    falloff: Literal["sigma", "variance"] = "sigma"
    rotations: Literal["limited", "full"] = "limited"
    squeeze: bool = False
    noise: bool = True

    def scene_config(self) -> SceneConfig:
        from tumortrack.sense.noise import CLEAN, D405_NOISE
        from tumortrack.simulate.deform import ChainConfig, DeformConfig, DragConfig, StretchConfig
        from tumortrack.simulate.deform.drag import CONFIGURATIONS
        from tumortrack.simulate.pose import PoseConfig
        from tumortrack.simulate.scene import SceneConfig

        drags = (
            DragConfig(steps=CONFIGURATIONS[n], falloff=self.falloff) for n in self.configurations
        )
        deform: tuple[DeformConfig, ...] = tuple(
            ChainConfig(links=(drag, StretchConfig())) if self.squeeze else drag for drag in drags
        )
        return SceneConfig(
            width=848,
            height=480,
            pose=PoseConfig(rotations=self.rotations),
            deform=deform,
            noise=D405_NOISE if self.noise else CLEAN,
        )


def simulate(case_folder: Path, dataset: Path, options: SimulateOptions) -> None:
    """`tumortrack simulate`: case -> folder of scenes, one folder each."""
    from tumortrack.imaging.case import load_case

    if options.scenes < 1:
        raise InputError(f"--scenes {options.scenes} must be at least 1.")
    case = load_case(case_folder)
    write_scenes(case, dataset, options)
    say(f"{options.scenes} scenes written to {dataset}.")


def write_scenes(case: Case, dataset: Path, options: SimulateOptions) -> None:
    """Scenes 0000, 0001, ... of the ``test`` stream; those that are there already stay.

    Raises:
        InputError: they are not scenes of this case, seed and options.
    """
    from tumortrack.simulate.scene import SceneRecipe, Simulator
    from tumortrack.simulate.scene_folder import Scene, write_scene

    config = options.scene_config()
    simulator = Simulator(case.anatomy, case.up_lps, config)
    volumes = [part.volume_mm3 for part in case.anatomy.parts]
    about = {"case_volumes_mm3": volumes, "config": to_builtins(config)}
    with progress_bar("simulate", options.scenes) as advance:
        for index in range(options.scenes):
            folder = dataset / f"{index:04d}"
            recipe = SceneRecipe(options.seed, "test", index)
            made_from = {**about, "recipe": asdict(recipe)}
            if folder.exists():
                _check_same(folder, made_from)
            else:
                stage = simulator.stage(recipe)
                meta = {
                    **made_from,
                    "camera_from_ct": stage.camera_from_ct.tolist(),
                    "deformation": stage.deformation.record(),
                }
                truth = simulator.reference(stage)
                write_scene(folder, Scene(stage.cloud, truth, stage.frame, meta))
            advance()


def _check_same(folder: Path, made_from: dict) -> None:
    """Refuse to continue a dataset of another case, seed or options."""
    meta = store.read_json(folder / "meta.json")
    if {key: meta.get(key) for key in made_from} != made_from:
        raise InputError(
            f"{folder} is a scene of another case, seed or option. Choose another DATASET folder."
        )


def evaluate(
    model_folder: Path, scenes: Path, report: Path, grid: int, seed: int, device: Device
) -> None:
    """`tumortrack evaluate`: model x scenes -> report folder."""
    from tumortrack.evaluate.protocol import evaluate_scenes, summary_table
    from tumortrack.learn.model import load_model
    from tumortrack.simulate.scene_folder import list_scenes
    from tumortrack.track.tracker import Tracker

    _check_grid(grid)
    tracker = Tracker(load_model(model_folder, device))
    with progress_bar("evaluate", len(list_scenes(scenes))) as advance:
        result = evaluate_scenes(
            lambda cloud: tracker.locate(cloud, grid, seed),
            scenes,
            report,
            lambda *_: advance(),
        )
    console.print(summary_table(result))
    say(f"written to {report / 'report.json'}; look at {report / 'index.html'}.")


def inspect(path: Path) -> None:
    """`tumortrack inspect`: what is this."""
    from tumortrack.app.inspection import describe

    for line in describe(path):
        say(line)


def _check_grid(grid: int) -> None:
    from tumortrack.track.tracker import LARGEST_GRID

    if not 8 <= grid <= LARGEST_GRID:
        raise InputError(f"--grid {grid} is not allowed; choose 8 to {LARGEST_GRID}.")
