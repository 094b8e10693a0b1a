"""The public functions: everything that a script needs, in a few calls.

``import tumortrack as tt`` offers these names, each loaded when it is first used. Millimetres
everywhere; the CT frame is LPS, the camera frame x right, y down, z forward. All errors are in
``tt.errors`` and say what was wrong, what is allowed and what to do.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.types import DepthFrame, Intrinsics, Mesh, SensorCloud
from tumortrack.imaging.case import Case
from tumortrack.imaging.case import load_case as _load_case

if TYPE_CHECKING:
    from tumortrack.live.values import TrackingResult
    from tumortrack.models.config import TrainConfig
    from tumortrack.models.model import Model
    from tumortrack.plan.values import ResectionPlan
    from tumortrack.simulate.scene_folder import Scene
    from tumortrack.tracking.tracker import Tracker
    from tumortrack.training.train import TrainingStatus

__all__ = [
    "Case",
    "DepthFrame",
    "Estimate",
    "Intrinsics",
    "SensorCloud",
    "estimate_from_surfaces",
    "evaluate",
    "find_organ",
    "load_case",
    "load_model",
    "plan_resection",
    "prepare",
    "read_cloud",
    "save_estimate",
    "scan_phantom",
    "simulate_scenes",
    "track",
    "train",
]

StrPath = str | Path
Device = Literal["auto", "cpu", "cuda"]


def scan_phantom(folder: StrPath, seed: int = 1) -> Path:
    """Write a virtual CT of the built-in kidney phantom as a DICOM series, if none is there.

    Returns the folder, which ``prepare`` reads.

    Raises:
        StorageError: the disk refused.
    """
    from tumortrack.phantom.dicom import write_dicom_series
    from tumortrack.phantom.digital import PhantomParameters, phantom_labels
    from tumortrack.phantom.scanner import ScannerParameters, scan

    folder = Path(folder)
    if not folder.exists():
        scanner = ScannerParameters(spacing_mm=(1.2, 1.2, 1.5))
        write_dicom_series(scan(phantom_labels(PhantomParameters()), scanner, seed), folder)
    return folder


def prepare(
    source: StrPath, folder: StrPath | None = None, *, overwrite: bool = False, **options: Any
) -> Case:
    """A case from a DICOM folder, a CT volume, a label map or a folder of meshes.

    Args:
        source: what to read.
        folder: where to write the case with a picture to check it by (qc.png); None: nowhere.
        overwrite: replace a case that lies there.
        options: fields of ``imaging.prepare.PrepareOptions``: ``kidney_hu``, ``tumor_hu``,
            ``labels``, ``side``, ``organ``, ``tumor``, ``up``, ``series``, ``unit``,
            ``min_tumor_ml``.

    Returns:
        The case: anatomy as closed surfaces, labels and CT; CT frame, mm.

    Raises:
        InputError: the source cannot be used, or an option is unknown or not allowed.
        StorageError: the disk refused.
    """
    from tumortrack.imaging.case import KIND, save_case
    from tumortrack.imaging.prepare import PrepareOptions
    from tumortrack.imaging.prepare import prepare as make_case

    known = PrepareOptions.__dataclass_fields__
    if unknown := sorted(set(options) - set(known)):
        raise InputError(f"prepare knows no {unknown[0]!r}; allowed: {', '.join(known)}.")
    if folder is not None:
        store.check_place(Path(folder), KIND, overwrite)
    case = make_case(Path(source), PrepareOptions(**options))
    if folder is not None:
        from tumortrack.report.pictures import qc_picture

        with store.new_folder(Path(folder), overwrite) as aside:
            qc_picture(case.labels, case.ct, case.anatomy, aside / "qc.png")
            save_case(case, aside)
    return case


def load_case(folder: StrPath) -> Case:
    """Read a folder that ``prepare`` wrote.

    Raises:
        ArtifactError: missing, of another schema, or changed since.
    """
    return _load_case(Path(folder))


def simulate_scenes(
    case: Case, count: int = 1, *, seed: int = 0, elastic: bool = True, noise: bool = True
) -> list[Scene]:
    """Deformed scenes with their truth, as a D405 sees them; never those that training sees.

    Args:
        case: whose organ.
        count: how many.
        seed: of the scenes; the same seed gives the same scenes.
        elastic: deform the organ as an elastic body in its bed; else drag its surface as the paper
            does (its configuration 3).
        noise: with the depth sensor's noise.

    Returns:
        Scenes: ``cloud`` and ``depth`` (camera frame, mm), ``reference`` (the true surfaces),
        ``targets`` (inner points in both frames), ``meta`` (``camera_from_ct``, the recipe).
    """
    from tumortrack.sense.noise import CLEAN, D405_NOISE
    from tumortrack.simulate.deform import DragConfig, ElasticConfig
    from tumortrack.simulate.scene import SceneConfig, SceneRecipe, Simulator, body_for
    from tumortrack.simulate.scene_folder import Scene
    from tumortrack.simulate.targets import Targets, draw_targets

    deform = ElasticConfig() if elastic else DragConfig()
    config = SceneConfig(deform=(deform,), noise=D405_NOISE if noise else CLEAN)
    # Elastic states of another library than the one that training draws from.
    body = body_for(case.anatomy, case.up_lps, config, 2**20 + seed)
    simulator = Simulator(case.anatomy, case.up_lps, config, body)
    inner = draw_targets(case.anatomy, seed)
    scenes = []
    for index in range(count):
        made = simulator.render(SceneRecipe(seed, "test", index))
        meta = {
            "camera_from_ct": made.camera_from_ct.tolist(),
            "recipe": {"seed": seed, "stream": "test", "index": index},
        }
        targets = Targets(inner.points_ct, made.carry(inner.points_ct), inner.labels)
        scenes.append(Scene(made.cloud, simulator.reference(made), made.frame, meta, targets))
    return scenes


def train(
    case: StrPath,
    folder: StrPath,
    *,
    preset: Literal["clinic", "quick", "paper"] = "clinic",
    config: TrainConfig | None = None,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: Device = "auto",
    workers: int | None = None,
    report: Callable[[TrainingStatus], None] | None = None,
) -> Model:
    """Train a model for a case; the same call resumes after Ctrl-C or a crash.

    Args:
        case: folder that ``prepare`` wrote.
        folder: the model's, to write.
        preset: ``clinic`` registers the organ of the CT, ``quick`` and ``paper`` label points.
        config: a changed preset instead: ``msgspec.structs.replace(presets.clinic(anatomy), ...)``.
        minutes, steps: where to stop; at most one of them (default: the preset's end).
        seed: of weights and scenes.
        device: ``auto`` takes CUDA if it is available.
        workers: processes that make scenes (default: as the machine allows).
        report: called every few seconds.

    Raises:
        InputError: an option is not allowed, a part is too small to be learnt.
        ArtifactError: no case, or ``folder`` holds another run.
        StorageError: the disk is full; the last checkpoint is whole.
    """
    from tumortrack.training.presets import PRESETS
    from tumortrack.training.train import TrainingRun
    from tumortrack.training.train import train as fit

    if minutes is not None and steps is not None:
        raise InputError("minutes and steps both say when to stop; give one of them.")
    if preset not in PRESETS:
        raise InputError(f"there is no preset {preset!r}; allowed: {', '.join(PRESETS)}.")
    of = load_case(case)
    run = TrainingRun(
        anatomy_ct=of.anatomy,
        up_lps=of.up_lps,
        case_sha256=store.sha256_of(Path(case) / store.MANIFEST),
        config=config or PRESETS[preset](of.anatomy, "limited"),
        seed=seed,
        steps=steps,
        minutes=minutes,
        device=device,
        workers=workers,
    )
    return fit(run, Path(folder), report or (lambda status: None))


def load_model(folder: StrPath, device: Device = "auto") -> Model:
    """Read a folder that ``train`` wrote; ``Tracker(model)`` locates with it.

    Raises:
        ArtifactError: missing, unfinished, of another schema, damaged or changed.
        InputError: CUDA was asked for and is not available.
    """
    from tumortrack.training.model import load_model as load

    return load(Path(folder), device)


def read_cloud(path: StrPath, unit: Literal["mm", "m"] = "mm") -> SensorCloud:
    """A cloud in the camera frame from .ply, .pcd or .npz; what was dropped is a warning.

    Raises:
        InputError: missing, damaged, of another kind, in metres, or without any point.
    """
    from tumortrack.sense.cloud import check_cloud
    from tumortrack.sense.files import read_cloud as read

    cloud, notes = read(Path(path), unit)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    check_cloud(cloud)
    return cloud


def find_organ(
    content: DepthFrame | SensorCloud,
    *,
    model: Model | None = None,
    range_mm: tuple[float, float] | None = None,
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    picked_mm: Float[np.ndarray, " 3"] | None = None,
    seed: int = 0,
) -> SensorCloud:
    """The organ's points among table, drape, instruments and hands; camera frame, mm.

    Args:
        content: a whole depth image or cloud.
        model: whose organ; gives depths and sizes to expect.
        range_mm: nearest and farthest depth to keep.
        box_mm: two opposite corners of a region of interest.
        mask: of a depth image, True where the organ may be.
        picked_mm: a point on the organ: the piece that it lies on is taken.
        seed: of the draw of points.

    Raises:
        NoEstimate: nothing is left that may be the organ; says which step took the rest.
        InputError: an option that is not allowed.
    """
    from tumortrack.sense.region import Hints, organ_points
    from tumortrack.tracking.region import region_for

    region = region_for(model, range_mm=range_mm, box_mm=box_mm)
    hints = Hints(mask=mask, picked_mm=picked_mm)
    return organ_points(content, region, hints, np.random.default_rng(seed)).cloud


def save_estimate(estimate: Estimate, folder: StrPath, overwrite: bool = False) -> None:
    """Write what `tumortrack locate` writes: points, labelled volume, surfaces and report; camera
    frame, mm.

    Raises:
        InputError: the folder exists and ``overwrite`` is False.
        StorageError: the disk refused.
    """
    from tumortrack.tracking.files import write_estimate

    write_estimate(Path(folder), estimate, overwrite)


def estimate_from_surfaces(surfaces: Mapping[str, Mesh], grid: int = 160) -> Estimate:
    """What another method says, in the form that ``evaluate`` compares.

    Args:
        surfaces: closed surfaces by part (kidney, tumor_1, ...), camera frame, mm; the kidney's
            includes its tumors.
        grid: voxels along the longest side of the labelled volume.
    """
    from tumortrack.models.report import estimate_of

    return estimate_of(dict(surfaces), grid)


def evaluate(
    locate: Tracker | Callable[[SensorCloud], Estimate],
    scenes: StrPath | Sequence[Scene],
    report: StrPath | None = None,
) -> dict[str, Any]:
    """Locate in every scene and compare with the truth.

    Args:
        locate: a tracker, or any function from an observed cloud to an estimate.
        scenes: folder of scene folders, or scenes.
        report: folder for report.json, index.html and pictures (scenes of a folder only).

    Returns:
        The report: per scene and part Hausdorff distances, surface and centre distance (mm), IoU,
        target errors; ``summary`` has medians. docs/conventions.md defines each.

    Raises:
        InputError: no scenes, or a scene that cannot be read.
    """
    from tumortrack.report.protocol import evaluate_scene, evaluate_scenes, summarise

    call: Any = getattr(locate, "locate", None) or locate
    if isinstance(scenes, str | Path):
        if report is None:
            raise InputError("evaluating a folder of scenes writes a report: say where.")
        return evaluate_scenes(call, Path(scenes), Path(report))
    entries = [evaluate_scene(call, scene, f"{n:04d}")[0] for n, scene in enumerate(scenes)]
    return {"scenes": entries, "summary": summarise(entries)}


def track(
    tracker: Tracker,
    source: Any,
    sinks: Sequence[Any] = (),
    *,
    until: Callable[[TrackingResult], bool] | None = None,
    seconds: float = 0.0,
    range_mm: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Follow the organ live, from a source to sinks, until the source ends.

    Args:
        tracker: with the model.
        source: as on the command line (``"virtual:CASE"``, ``"realsense"``, ...), or a source's
            configuration.
        sinks: likewise, or objects with ``publish(result)`` and ``close()``.
        until: called with every result; True ends the loop.
        seconds: end after so long; 0: not.
        range_mm: depths to keep (default: those that training showed).

    Returns:
        The run's figures: counts, latencies, stage times (docs/conventions.md).

    Raises:
        InputError: a source or sink that cannot be opened.
    """
    from tumortrack.live.loop import Loop, LoopConfig, summary
    from tumortrack.live.spec import SINKS, SOURCES
    from tumortrack.live.values import PublishedFrame, SinkConfig, SinkContext
    from tumortrack.live.workers import SinkWorker, SourceWorker
    from tumortrack.tracking.region import region_for

    config = SOURCES.parse(source) if isinstance(source, str) else source
    made_sinks = [SINKS.parse(sink) if isinstance(sink, str) else sink for sink in sinks]
    context = SinkContext(tracker.model.parts, PublishedFrame(), tracker.anatomy_ct)
    region = region_for(tracker.model, range_mm=range_mm)
    loop = Loop(tracker, context, LoopConfig(region=region, seconds=seconds))
    loop.warm()

    def seen(result: TrackingResult) -> None:
        if until is not None and until(result):
            loop.stop()

    with ExitStack() as stack:
        workers = []
        for number, (sink, made) in enumerate(zip(sinks, made_sinks, strict=True)):
            name = sink if isinstance(sink, str) else f"sink {number}"
            waiting = made.queue_size if isinstance(made, SinkConfig) else 1
            opened = made.open(context) if isinstance(made, SinkConfig) else made
            workers.append(SinkWorker(name, opened, waiting))
            stack.callback(workers[-1].close)
        source_worker = SourceWorker(config.open)
        stack.callback(source_worker.close)
        loop.run(source_worker, workers, seen)
    return summary(loop, source_worker, workers)


def plan_resection(
    located: StrPath | Estimate,
    *,
    picture: StrPath | None = None,
    stand_mm: float | None = None,
    **options: Any,
) -> ResectionPlan:
    """Where to cut a tumor out; nothing moves. `tumortrack plan` also plans the arms' motions.

    Args:
        located: a folder that `tumortrack locate` wrote, or an estimate; camera frame, mm. The
            camera is taken to look straight down on the table.
        picture: PNG file to draw the plan into.
        stand_mm: height of the organ's lowest point over the table.
        options: fields of ``plan.values.ResectionConfig``: ``tumor``, ``method`` (``margin`` or
            ``published``), ``margin_mm``, ``sigmas`` and others.

    Returns:
        The plan: cuts, layers, grasp point; table frame, mm, z up.

    Raises:
        NoPlan: nothing to cut, or not as asked; says why.
        InputError: no such tumor, or an option that is not allowed.
    """
    from tumortrack.core.config import from_builtins
    from tumortrack.plan.located import STAND_MM, read_run, table_below
    from tumortrack.plan.located import located as in_table_frame
    from tumortrack.plan.resection import plan_resection as make_plan
    from tumortrack.plan.values import ResectionConfig

    config = from_builtins(options, ResectionConfig, "plan_resection")
    run = located if isinstance(located, Estimate) else read_run(Path(located))
    table_from_camera = table_below(run.cloud.points_mm, STAND_MM if stand_mm is None else stand_mm)
    if isinstance(run, Estimate):
        seen = in_table_frame(run.cloud, run.meshes, run.motion, table_from_camera)
    else:
        seen = run.located(table_from_camera)
    plan = make_plan(seen, config)
    if picture is not None:
        from tumortrack.report.plan_pictures import draw_plan

        draw_plan(plan, seen, Path(picture))
    return plan
