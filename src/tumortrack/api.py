"""The public functions: everything that a script needs, in a few calls.

``import tumortrack as tt`` offers these names, each loaded when it is first used. Millimetres
everywhere; the CT frame is LPS, the camera frame x right, y down, z forward. All errors are in
``tt.errors`` and say what was wrong, what is allowed and what to do.
"""

from __future__ import annotations

import logging
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from jaxtyping import Bool, Float, UInt8

from tumortrack.core import store
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import CAMERA, Evidence
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud, View
from tumortrack.io.case import Case
from tumortrack.io.case import load_case as load_case
from tumortrack.tracking.keywords import (
    ExportKeywords,
    LocateKeywords,
    PrepareKeywords,
    RecordingKeywords,
    SessionKeywords,
    SimulateKeywords,
    StrPath,
    TrackKeywords,
)
from tumortrack.tracking.options import (
    Device,
    ExportOptions,
    LocateOptions,
    SimulateOptions,
    TrackOptions,
    options_from,
)

if TYPE_CHECKING:
    from tumortrack.core.ultrasound import ProbeRecording
    from tumortrack.io.scene_folder import Scene
    from tumortrack.live.cameras import CameraSetup
    from tumortrack.live.session import Session
    from tumortrack.live.values import Controller, TrackingResult
    from tumortrack.registration.base_model import Model, ModelConfig
    from tumortrack.registration.method import TrainingStatus
    from tumortrack.report.locating import Located
    from tumortrack.report.results import Evaluation, TrackSummary
    from tumortrack.segmentation.tissue import TissueClassifier
    from tumortrack.tracking.tracker import Tracker

_QC = "qc.png"


def scan_phantom(
    folder: StrPath, seed: int = 1, spacing_mm: tuple[float, float, float] = (1.2, 1.2, 1.5)
) -> Path:
    """Write a virtual CT of the built-in kidney phantom as a DICOM series, if none is there;
    returns the folder, which ``prepare`` reads."""
    from tumortrack.simulation.phantom import dicom, digital, scanner

    folder = Path(folder)
    if not folder.exists():
        phantom = digital.PhantomParameters()
        parameters = scanner.ScannerParameters(spacing_mm=spacing_mm)
        ct = scanner.scan(digital.phantom_labels(phantom), parameters, seed)
        dicom.write_dicom_series(ct, folder, side=phantom.side)
    return folder


def prepare(
    source: StrPath | Sequence[StrPath],
    folder: StrPath | None = None,
    *,
    overwrite: bool = False,
    segment: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[PrepareKeywords],
) -> Case:
    """A case (CT frame, mm) from a DICOM folder, a CT volume, a label map or segmentation, a folder
    of meshes or of label files with one structure each. Raises InputError: the source or an option
    cannot be used.

    Args:
        source: one, or several mesh or label files.
        folder: where to write the case with a picture to check it by (qc.png); None: nowhere.
        overwrite: replace a case that lies there.
        segment: of a CT: what segments it, as `prepare --segment`; FOLDER.labels.nii.gz is kept.
        progress: of making the case's model, as its last step: steps done, of how many.
        options: as `tumortrack prepare --help` explains them.
    """
    from tumortrack.case import prepare as preparing
    from tumortrack.case.options import PrepareOptions
    from tumortrack.io.case import KIND, save_case
    from tumortrack.io.model_folder import reliability_warning
    from tumortrack.tracking.model_files import case_model

    asked = options_from(PrepareOptions, {**options}, "prepare")
    given = [source] if isinstance(source, str | Path) else source
    sources = [Path(each) for each in given]
    if folder is not None:
        store.check_place(Path(folder), KIND, overwrite)
    if segment is None:
        case = preparing.prepare(sources, asked)
    elif folder is None or len(sources) != 1:
        raise InputError("segment needs a folder, beside which the one CT's label map is kept.")
    else:
        from tumortrack.case.segmentation_tool import segmented_case

        keep = Path(folder).with_name(f"{Path(folder).name}.labels.nii.gz")
        case = segmented_case(sources[0], segment, asked, keep)
    if folder is not None:
        with store.new_folder(Path(folder), overwrite) as aside:
            _draw_case(case, aside)
            save_case(case, aside)
        case = load_case(folder)
        model = case_model(case, progress=progress)
        if weakness := reliability_warning(model.provenance):
            case = _warning_in_picture(case, weakness, model)
    return case


def _draw_case(case: Case, folder: Path, weakness: str = "") -> None:
    """The picture that users check a case by. ``weakness``: of its model."""
    from tumortrack.report.pictures import qc_picture

    doubts = [
        *(found.message for found in case.warnings),
        case.report["half_turn"]["warning"],
        weakness,
    ]
    about = str(case.patient), [*filter(None, doubts)]
    qc_picture(case.labels, case.ct, case.anatomy, folder / _QC, *about)


def _warning_in_picture(case: Case, weakness: str, model: Model) -> Case:
    """The case in its folder's place, with the same files but for the picture, and the model."""
    from tumortrack.io.model_folder import save_model

    assert case.folder is not None
    manifest = store.read_json(case.folder / store.MANIFEST)
    with store.new_folder(case.folder, True) as aside:
        for name in manifest["files"]:
            shutil.copy2(case.folder / name, aside)
        _draw_case(case, aside, weakness)
        manifest["files"][_QC] = store.sha256_of(aside / _QC)
        store.write_json(aside / store.MANIFEST, manifest)
        about = {**model.provenance, "case_sha256": store.sha256_of(aside / store.MANIFEST)}
        (aside / case.MODEL).mkdir()
        save_model(replace(model, provenance=about), aside / case.MODEL)
    return load_case(case.folder)


def simulate_scenes(
    case: Case | StrPath, count: int = 1, *, seed: int = 0, elastic: bool = True, noise: bool = True
) -> list[Scene]:
    """Deformed scenes with their truth, as a D405 sees them; never those that training sees. The
    same seed gives the same scenes.

    Args:
        elastic: deform the organ as an elastic body in its bed; else drag its surface as the paper
            does (its configuration 3).

    Returns:
        Scenes: ``cloud`` and ``depth`` (camera frame, mm), ``reference`` (the true surfaces),
        ``targets`` (inner points in both frames), ``meta`` (``camera_from_ct``, the recipe).
    """
    from msgspec.structs import replace

    from tumortrack.simulation.dataset import scene_maker

    case = case if isinstance(case, Case) else load_case(case)
    config = SimulateOptions(elastic=elastic, noise=noise).scene_config()
    config = replace(config, width=424, height=240).seen_whole(case.anatomy)
    return list(map(scene_maker(case, config, seed), range(count)))


def write_scenes(
    case: StrPath,
    folder: StrPath,
    *,
    progress: Callable[[], None] | None = None,
    **options: Unpack[SimulateKeywords],
) -> None:
    """Write deformed scenes of a case with their truth, as `tumortrack simulate` does: what
    ``evaluate`` reads. Raises InputError: an option is not allowed, or a scene that is there was
    made otherwise.

    Args:
        case: folder that ``prepare`` wrote.
        folder: where to write scene folders 0000, 0001, ...; those that are there stay.
        progress: called after each scene.
        options: as `tumortrack simulate --help` explains them.
    """
    from tumortrack.simulation import dataset

    asked = options_from(SimulateOptions, {**options}, "write_scenes")
    made_of = load_case(case)
    inside = Path(folder).iterdir() if Path(folder).is_dir() else ()
    if foreign := [p.name for p in inside if p.name[0] != "." and not (p / "meta.json").is_file()]:
        raise InputError(
            f"{folder} also holds {', '.join(sorted(foreign)[:3])}, which are no scenes. Choose "
            "another folder, or an empty one."
        )
    config = asked.scene_config().seen_whole(made_of.anatomy)
    folders = [Path(folder) / f"{index:04d}" for index in range(asked.scenes)]
    for _ in dataset.write_scenes(made_of, config, asked.seed, folders):
        if progress is not None:
            progress()


def export(case: StrPath, folder: StrPath, **options: Unpack[ExportKeywords]) -> tuple[str, ...]:
    """Write a case, or what was located, as a scene for 3D Slicer, and a CT's as DICOM, or as a
    body for a simulator; returns what to know of what was written. Raises InputError,
    ArtifactError: folders or options that do not fit each other, or cannot be used.

    Args:
        case: folder that ``prepare`` wrote, or alone one that ``locate`` wrote.
        options: as `tumortrack export --help` explains them.
    """
    from tumortrack.report import bodies, slicer_scene

    asked = options_from(ExportOptions, {**options}, "export")
    write = slicer_scene.export if asked.format == "slicer" else bodies.export_body
    return write(Path(case), Path(folder), asked)


def train(
    case: StrPath | Case,
    folder: StrPath,
    *,
    preset: Literal["elastic", "quick", "quick-long", "paper"] = "elastic",
    config: ModelConfig | None = None,
    rotations: Literal["limited", "full"] | None = None,
    sensor: Literal["d405", "stereo"] | None = None,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: Device = "auto",
    workers: int | None = None,
    checkpoint_every_s: float = 30.0,
    on_status: Callable[[TrainingStatus], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Model:
    """A model of its own folder. The default preset, ``elastic``, has nothing to learn: a case
    holds its model. For ``quick`` and ``paper`` (of tumortrack-occupancy) the same call resumes
    after Ctrl-C or a crash. Raises InputError, ArtifactError: no case, an option is not allowed, a
    part is too small to be learnt, or ``folder`` holds another model or run.

    Args:
        case: or the folder that ``prepare`` wrote.
        folder: the model's, to write.
        preset: ``elastic`` registers the organ of the CT, the others label points.
        config: a changed preset instead: ``msgspec.structs.replace(presets.quick(anatomy), ...)``.
        rotations: of the preset: how the organ may lie (default: as the case says; ``quick`` and
            ``paper``: limited).
        sensor: of the preset: whose errors the scenes have (default: as the case says).
        minutes: of training, from the end of its first step (default: to the preset's end).
        steps: likewise; give at most one of the two.
        workers: processes that make scenes (default: as the machine allows).
        checkpoint_every_s: a crash loses at most the steps since.
        on_status: of a training: called every few seconds.
        progress: of making a model that learns nothing: steps done, of how many.
    """
    from tumortrack.core.renamed import hint
    from tumortrack.io.model_folder import check_trainable
    from tumortrack.registration.config import RegistrationConfig
    from tumortrack.registration.method import TrainOptions, method_of_config, method_of_preset
    from tumortrack.tracking.model_files import write_model
    from tumortrack.tracking.presets import PRESETS, seen_by

    if minutes is not None and steps is not None:
        raise InputError("--minutes and --steps both say when to stop; give one of them.")
    for name, value in (("minutes", minutes), ("steps", steps), ("workers", workers)):
        if value is not None and not value >= 0:
            raise InputError(f"--{name} {value} must be 0 or more.")
    if preset not in PRESETS:
        said = hint("choices", f"--preset {preset}")
        raise InputError(f"there is no preset {preset!r}{said}; allowed: {', '.join(PRESETS)}.")
    if config is not None and (rotations or sensor):
        raise InputError("rotations and sensor are a preset's; a configuration says them itself.")
    known = case if isinstance(case, Case) else load_case(case)
    check_trainable(Path(folder))
    if isinstance(config, RegistrationConfig) or (config is None and preset == "elastic"):
        known = replace(
            known, rotations=rotations or known.rotations, sensor=sensor or known.sensor
        )
        return write_model(known, Path(folder), config, seed, progress)
    if config is None:
        method = method_of_preset(preset)
        config = PRESETS[preset](known.anatomy, rotations or "limited")
        config = seen_by(config, sensor or known.sensor)
    else:
        method = method_of_config(config)
    options = TrainOptions(
        seed=seed, steps=steps, minutes=minutes, device=device, workers=workers,
        checkpoint_every_s=checkpoint_every_s,
    )  # fmt: skip
    return method.train(known, Path(folder), config, options, on_status or (lambda status: None))


def load_model(folder: StrPath, device: Device = "auto") -> Model:
    """Read a folder that ``train`` wrote, or the model of a case; ``Tracker(model)`` locates with
    it. Raises ArtifactError: missing, unfinished, of another schema, damaged or changed;
    PackageError: the method that made it is not installed."""
    from tumortrack.tracking import model_files

    return model_files.load_model(Path(folder), device)


def read_cloud(path: StrPath, unit: Literal["mm", "m"] = "mm") -> SensorCloud:
    """A cloud in the camera frame from .ply, .pcd or .npz; what was dropped is a warning. Raises
    InputError: missing, damaged, of another kind, in metres, or without any point."""
    from tumortrack.core.cloud import check_cloud
    from tumortrack.io import depth_files as files

    cloud, notes = files.read_cloud(Path(path), unit)
    for note in notes:
        warnings.warn(note, stacklevel=2)
    check_cloud(cloud)
    return cloud


def read_depth(path: StrPath, intrinsics: StrPath, unit_mm: float | None = None) -> DepthFrame:
    """A depth image: 16-bit PNG or TIFF, or a TIFF of floats; 0 is no return. Raises InputError:
    missing, damaged, of another kind or size.

    Args:
        intrinsics: JSON with width, height, fx, fy, cx, cy in pixels.
        unit_mm: of one step. Default: what that file says (depth_unit_mm), else 0.1 (a D405's), of
            floats 1000 (metres). Many cameras have 1.
    """
    from tumortrack.io import depth_files as files

    return files.read_depth(Path(path), Path(intrinsics), unit_mm)[0]


def read_ultrasound(
    path: StrPath,
    parts: Sequence[str] = ("kidney", "tumor_1"),
    **options: Unpack[RecordingKeywords],
) -> ProbeRecording:
    """Borders of parts in a tracked probe's images, and its poses: ``evidence`` of ``locate``.
    Raises InputError: a file is missing or damaged, a transform is missing, no mask has a pose.

    Args:
        path: a sequence (.mha, .mhd, .nrrd), or with ``poses`` a folder or pattern of masks.
        parts: names of labels 1 (the organ), 2, ...: ``case.anatomy.names``.
        options: as of ``io.ultrasound_files.RecordingOptions``.
    """
    from tumortrack.io.ultrasound_files import RecordingOptions, read_recording

    asked = options_from(RecordingOptions, {**options}, "read_ultrasound")
    return read_recording(Path(path), parts, asked)


def find_organ(
    content: DepthFrame | SensorCloud,
    *,
    model: Model | Case | None = None,
    range_mm: tuple[float, float] | None = None,
    box_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None,
    mask: Bool[np.ndarray, "h w"] | None = None,
    picked_mm: Float[np.ndarray, " 3"] | None = None,
    picture: UInt8[np.ndarray, "h w *rgb"] | None = None,
    tissue_classifier: TissueClassifier | None = None,
    seed: int = 0,
) -> SensorCloud:
    """The organ's points among table, drape, instruments and hands; camera frame, mm.

    Args:
        model: whose organ; gives depths and sizes to expect.
        range_mm: nearest and farthest depth to keep.
        box_mm: two opposite corners of a region of interest.
        mask: of a depth image, True where the organ may be.
        picked_mm: a point on the organ: the piece that it lies on is taken.
        picture: grey, or red, green and blue, in the depth image's pixels; for
            ``tissue_classifier``, what ``train_tissue_classifier`` says of organ and surroundings.

    Raises:
        NoEstimate: nothing is left that may be the organ, and which step took the rest; or what
            was trained cannot be used on this picture.
        InputError: an option that is not allowed.
    """
    from tumortrack.registration.base_model import Model
    from tumortrack.segmentation import Hints, organ_points
    from tumortrack.tracking.model_files import case_model
    from tumortrack.tracking.tracker import region_for

    if isinstance(model, Case):
        model = case_model(model)
    elif model is not None and not isinstance(model, Model):
        raise InputError(
            f"find_organ takes a model or a case, not {type(model).__name__}: "
            "find_organ(frame, model=load_case(FOLDER))."
        )
    region = region_for(model, range_mm=range_mm, box_mm=box_mm)
    hints = Hints(mask, picked_mm, None, picture, tissue_classifier)
    found = organ_points(content, region, hints, np.random.default_rng(seed))
    if found.doubt:
        raise NoEstimate(found.doubt)
    return found.cloud


def train_tissue_classifier(
    frame: DepthFrame,
    picture: UInt8[np.ndarray, "h w *rgb"],
    organ: Sequence[tuple[int, int]],
    beside: Sequence[tuple[int, int]],
) -> TissueClassifier:
    """What the organ looks like in colour and depth, from pixels (row, column) on it and beside it,
    two of each at least; for ``find_organ``. Raises InputError: a pixel shows too little, or organ
    and surroundings look alike."""
    from tumortrack.segmentation import tissue

    pixels = [(pixel, True) for pixel in organ] + [(pixel, False) for pixel in beside]
    return tissue.train_tissue_classifier(
        [tissue.sample_click(frame, picture, *pixel) for pixel in pixels]
    )


def locate(
    case: Case | Model | StrPath,
    points: SensorCloud | Float[np.ndarray, "n 3"],
    *,
    views: Sequence[View] = (),
    evidence: Sequence[Evidence] = (),
    full_view: DepthFrame | SensorCloud | None = None,
    grid: int = 160,
    seed: int = 0,
    frame: str = CAMERA,
    device: Device = "auto",
) -> Estimate:
    """Locate organ and tumors in one cloud; of many clouds ``Tracker`` loads the model once.

    Args:
        case: a case, a model, or the folder of one.
        points: of the organ, as the camera sees them: n x 3, camera frame, mm.
        device: of a folder's model.

    The others, and what is raised, are those of ``Tracker.locate``.
    """
    from tumortrack.tracking.tracker import Tracker, cloud_of

    cloud = cloud_of(points)  # what is wrong is said before a model is loaded
    tracker = Tracker(load_model(case, device) if isinstance(case, str | Path) else case)
    return tracker.locate(
        cloud,
        views=views,
        evidence=evidence,
        full_view=full_view,
        grid=grid,
        seed=seed,
        frame=frame,
    )


def locate_files(
    model: StrPath, clouds: StrPath | Sequence[StrPath], **options: Unpack[LocateKeywords]
) -> Located:
    """Locate organ and tumors in the file of a cloud or depth image, or in those of several views
    of the organ at rest, as `tumortrack locate` does; ``locate`` takes points in memory. Raises
    InputError, ArtifactError: a file or an option cannot be used, or the model is another patient's
    than stated.

    Args:
        model: folder of a case, or that ``train`` wrote.
        options: as `tumortrack locate --help` explains them; ``intrinsics``: one for each view.

    Returns:
        ``estimate``, which is None where nothing could be located; ``report``, as in report.json;
        ``save(folder, overwrite)`` writes all.
    """
    from tumortrack.report import locating

    if not isinstance(model, str | Path):
        raise InputError(
            f"locate_files takes the folder of a case or model, not {type(model).__name__}: "
            "locate_files(FOLDER, FILE), or locate(case, points)."
        )
    files = [clouds] if isinstance(clouds, str | Path) else clouds
    asked = options_from(LocateOptions, {**options}, "locate_files")
    return locating.locate(Path(model), [Path(file) for file in files], asked)


def load_estimate(folder: StrPath) -> Estimate:
    """Read a folder that ``Estimate.save`` or `tumortrack locate` wrote; its ``motion`` is None:
    only the model knows that. Raises ArtifactError: no such folder, damaged or changed, or nothing
    was located in it."""
    from tumortrack.io.run_folder import read_estimate

    return read_estimate(Path(folder))


def estimate_from_surfaces(surfaces: Mapping[str, Mesh], grid: int = 160) -> Estimate:
    """What another method says, in the form that ``evaluate`` compares: closed surfaces by part
    (kidney or the organ's name, tumor_1, ...), camera frame, mm; the organ's, which comes first,
    includes its tumors. They are taken as right: nothing judges them. ``grid``: voxels along the
    longest side of the labelled volume.
    """
    from tumortrack.registration.frame import estimate_of

    return estimate_of(dict(surfaces), grid).assessed(finding=None)


def evaluate(
    locate: Tracker | StrPath | Callable[[SensorCloud], Estimate],
    scenes: StrPath | Sequence[Scene],
    folder: StrPath | None = None,
    overwrite: bool = False,
    *,
    grid: int = 160,
    seed: int = 0,
    device: Device = "auto",
    progress: Callable[[], None] | None = None,
) -> Evaluation:
    """Locate in every scene and compare with the truth. Raises InputError: no scenes, one that
    cannot be read or is of another case than the model, or the folder exists and ``overwrite`` is
    False.

    Args:
        locate: a tracker, the folder of a case or model, or any function from an observed cloud to
            an estimate; it gets ``evidence=`` of scenes that have some.
        scenes: folder of scene folders, or scenes.
        folder: for report.json, index.html and pictures (scenes of a folder only).
        overwrite: replace an earlier report there.
        grid: voxels along the longest side of a tracker's labelled volume.
        seed: of its random points and queries.
        device: of the folder's model.
        progress: called after each scene of a folder.

    Returns:
        Per scene and part Hausdorff distances, surface and centre distance (mm), IoU, target
        errors, and for a tracker of an `elastic` model those of the best rigid pose and of a rigid
        fit; ``parts`` and ``errors`` have medians, and the worst with its scene.
        docs/conventions.md defines each.
    """
    from tumortrack.report import protocol
    from tumortrack.report.baselines import baselines_of
    from tumortrack.report.results import evaluation
    from tumortrack.report.summary import summarise
    from tumortrack.tracking.tracker import Tracker

    if isinstance(locate, str | Path):
        locate = Path(locate)
    elif not callable(getattr(locate, "locate", locate)):
        raise InputError(
            f"evaluate takes a tracker or a function, not {type(locate).__name__}: "
            "evaluate(Tracker(load_model(FOLDER)), scenes)."
        )
    if isinstance(scenes, str | Path):
        if folder is None:
            raise InputError("evaluating a folder of scenes writes a report: say where.")
        given, out, step = Path(scenes), Path(folder), progress or (lambda: None)
        protocol.check_place(out, overwrite)
        if isinstance(locate, Path | Tracker):
            written = protocol.evaluate_model(locate, given, out, grid, seed, device, step)
            return evaluation(written)
        call: Any = getattr(locate, "locate", locate)
        baselines = baselines_of(getattr(locate, "model", None))
        return evaluation(protocol.evaluate_scenes(call, given, out, step, baselines=baselines))
    if not scenes:
        raise InputError("there are no scenes to evaluate: simulate_scenes(case, 20) makes some.")
    if isinstance(locate, Path):
        locate = Tracker(load_model(locate, device))
    call, baselines = (
        getattr(locate, "locate", locate),
        baselines_of(getattr(locate, "model", None)),
    )
    if isinstance(locate, Tracker):
        call = partial(call, grid=grid, seed=seed)
    named = ((f"{n:04d}", scene) for n, scene in enumerate(scenes))
    entries = [protocol.evaluate_scene(call, scene, name, baselines)[0] for name, scene in named]
    return evaluation({"scenes": entries, "summary": summarise(entries)})


def track(
    tracker: Tracker | StrPath,
    source: Any,
    sinks: Sequence[Any] = (),
    *,
    until: Callable[[TrackingResult], bool] | None = None,
    seconds: float = 0.0,
    range_mm: tuple[float, float] | None = None,
    **options: Unpack[TrackKeywords],
) -> TrackSummary:
    """Follow the organ live, from a source to sinks, until the source ends; returns the run's
    figures: counts, latencies, stage times (docs/conventions.md).

    Args:
        tracker: or the folder of a case or model.
        source: as on the command line (``"virtual:CASE"``, ``"realsense"``, ...), or a source's
            configuration.
        sinks: likewise, or objects with ``publish(result)`` and ``close()``.
        until: called with every result; True ends the loop.
        seconds: end so many s after the first frame; 0: not.
        range_mm: depths to keep (default: those of the model's scenes).
        options: as `tumortrack track --help` explains them.

    Raises:
        InputError: an option, a source or a sink is not written as it must be, or cannot work.
        SourceLost: no frame came for a minute.
    """
    from tumortrack.report.results import track_summary

    run = session(tracker, source, sinks, seconds=seconds, range=range_mm, **options)
    run.loop.warm()

    def seen(result: TrackingResult) -> None:
        if until is not None and until(result):
            run.loop.stop()

    with run.opened():
        for worker in run.sinks:
            for note in worker.notes:  # a viewer's address, or that others can see it
                logging.getLogger("tumortrack").warning("sink %s: %s", worker.name, note)
        run.run(seen)
    return track_summary(run.summary())


def session(
    tracker: Tracker | StrPath,
    source: Any,
    sinks: Sequence[Any] = (),
    controller: Controller | None = None,
    setup: CameraSetup | None = None,
    **options: Unpack[SessionKeywords],
) -> Session:
    """``track``, ready to be opened: for programs that show what happens meanwhile, as the command
    does. ``controller`` and ``setup`` as of ``Session``."""
    from tumortrack.live.session import Session

    asked = options_from(TrackOptions, {**options}, "track")
    model = Path(tracker) if isinstance(tracker, str | Path) else tracker
    return Session(model, source, sinks, asked, controller, setup)
