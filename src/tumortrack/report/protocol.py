"""The protocol: locate in every scene of a folder, compare with the truth, summarise."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import FAR_MM, Estimate
from tumortrack.core.store import write_json, writing
from tumortrack.core.types import SensorCloud
from tumortrack.models.model import Model
from tumortrack.report import metrics
from tumortrack.report.page import page_scene, write_page
from tumortrack.report.pictures import scene_picture
from tumortrack.report.place import clear
from tumortrack.report.rivals import rivals_of
from tumortrack.report.summary import SAID, summarise, worst_center
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.options import model_folder
from tumortrack.tracking.tracker import Tracker

RULE = f"{SAID.medians} {SAID.rule.format(far_mm=FAR_MM)}"
Locate = Callable[[SensorCloud], Estimate]
Compare = Callable[[Scene], dict[str, Any]]
_SCENES = 4  # are worth a process


class Asked(NamedTuple):
    """How a model is asked: see ``api.evaluate``. ``processes``: at most, for the model of a
    folder. Each begins with the program's main module, so a script without
    ``if __name__ == "__main__"`` can have but one."""

    grid: int = 160
    seed: int = 0
    device: str = "auto"
    processes: int = 1


_AS_USUAL = Asked()


class _Judged(NamedTuple):
    entry: dict[str, Any]
    shown: dict[str, Any]


def evaluate_model(
    model: Path | Tracker,
    scenes_dir: Path,
    out: Path,
    asked: Asked = _AS_USUAL,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """``evaluate_scenes`` with a tracker, or the model of a folder, which the report then names.
    Also raises InputError for scenes of another case."""
    folders, digest = list_scenes(scenes_dir), {}
    folder = None
    if isinstance(model, Tracker):
        tracker = model
    else:
        folder = model_folder(model)
        digest = {"model_sha256": store.sha256_of(folder / store.MANIFEST)}
        tracker = Tracker(load_model(folder, asked.device))
    check_case(tracker.model, folders)
    rivals = rivals_of(tracker.model)
    about = {
        "patient": to_builtins(tracker.model.patient),
        "model": tracker.model.provenance,
        **digest,
        "scenes_folder": str(scenes_dir),
        "grid": asked.grid,
        "seed": asked.seed,
    }
    processes = min(asked.processes, os.cpu_count() or 1, len(folders) // _SCENES)
    if folder is None or processes < 2:
        locate = partial(tracker.locate, grid=asked.grid, seed=asked.seed)
        return evaluate_scenes(locate, scenes_dir, out, progress, about, rivals)
    with ProcessPoolExecutor(processes, get_context("spawn"), _begin, (folder, asked, out)) as pool:
        try:
            return _report(_each(pool, folders), out, progress, {**about, **_said(rivals)})
        except BaseException:  # Ctrl-C, too
            pool.shutdown(cancel_futures=True)
            raise


_judge: list[Callable[[Path], _Judged]] = []  # of a process


def _begin(folder: Path, asked: Asked, out: Path) -> None:
    """Called once in a new process, which leaves Ctrl-C to the one that began it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tracker = Tracker(load_model(folder, asked.device))
    locate = partial(tracker.locate, grid=asked.grid, seed=asked.seed)
    _judge.append(partial(_judged, locate, rivals_of(tracker.model), out))


def _in_process(folder: Path) -> _Judged:
    return _judge[0](folder)


def _each(pool: ProcessPoolExecutor, folders: Sequence[Path]) -> Iterator[_Judged]:
    """Begun when the first is asked for: then the report's folder is there."""
    yield from pool.map(_in_process, folders)


def check_case(model: Model, folders: list[Path]) -> None:
    """Raises InputError for a scene that `simulate` made from another case than the model's. Scenes
    of other programs, which do not name their case, pass."""
    wanted = model.provenance.get("case_sha256")
    for folder in folders:
        path = folder / "meta.json"
        stated = store.read_json(path).get("case_sha256") if path.is_file() else None
        if wanted is not None and stated is not None and stated != wanted:
            raise InputError(
                f"{folder} shows another case than the one that this model is of, so the "
                "figures would mean nothing. Make scenes of the model's own case with: "
                "tumortrack simulate CASE DATASET. Another reader's case of the same organ may be "
                "the truth: take case_sha256 out of the scenes' meta.json."
            )


def evaluate_scenes(
    locate: Locate,
    scenes_dir: Path,
    out: Path,
    progress: Callable[[], None] = lambda: None,
    about: dict[str, Any] | None = None,
    rivals: Compare | None = None,
) -> dict[str, Any]:
    """Evaluate ``locate`` on every scene of a folder.

    Writes OUT/scenes/NAME.png, OUT/index.html and, last, OUT/report.json. Replaces a report that is
    there (``place.check_place`` says whether that is allowed), and removes an unfinished one.
    Raises InputError: no scenes, or a scene that cannot be read; StorageError: the disk refused.

    Args:
        locate: observed cloud (camera frame, mm) -> estimate; raises NoEstimate or InputError if it
            has none, which counts as a failed scene.
        progress: called after each scene.
        about: plain JSON for the report: the model and options behind ``locate``.
        rivals: rigid registration of a scene, see ``report.rivals.Rivals``.
    """
    judge = partial(_judged, locate, rivals, out)
    about = {**(about or {}), **_said(rivals)}
    return _report(map(judge, list_scenes(scenes_dir)), out, progress, about)


def _said(rivals: Compare | None) -> dict[str, Any]:
    return {"rivals": SAID.rivals if rivals is not None else {"not_available": SAID.no_rivals}}


def _judged(locate: Locate, rivals: Compare | None, out: Path, folder: Path) -> _Judged:
    """A scene's entry, and what the page shows of it; its picture is written."""
    scene = read_scene(folder)
    entry, estimate = evaluate_scene(locate, scene, folder.name, rivals)
    if isinstance(stated := scene.meta.get("registration"), dict):  # of a second CT
        entry["registration_mm"] = stated.get("tre_mm", {})
    picture = out / "scenes" / f"{folder.name}.png"
    scene_picture(scene, estimate, entry, picture)
    return _Judged(entry, page_scene(scene, estimate, picture))


def _report(
    judged: Iterable[_Judged], out: Path, progress: Callable[[], None], about: dict[str, Any]
) -> dict[str, Any]:
    """The report of scenes as they come."""
    clear(out)
    try:
        with writing(out):
            (out / "scenes").mkdir(parents=True, exist_ok=True)
        scenes = []
        for each in judged:
            scenes.append(each)
            progress()
        entries = [each.entry for each in scenes]
        report = {
            "tumortrack": tumortrack.__version__,
            "units": "mm",
            "frame": "camera",
            **about,
            "rule": RULE,
            "summary": summarise(entries),
            "scenes": entries,
        }
        write_page(report, [each.shown for each in scenes], out / "index.html")
        write_json(out / "report.json", report)
    except BaseException:  # Ctrl-C, too: an unfinished report would block the next command
        clear(out)
        raise
    return report


def evaluate_scene(
    locate: Locate, scene: Scene, name: str, rivals: Compare | None = None
) -> tuple[dict[str, Any], Estimate | None]:
    """One scene's entry: name, quality (good, poor or none) and its reason, parts -> metrics, miou,
    seconds, timings, and failed (or null).

    With ``tre_mm`` if the scene has targets and the estimate a motion; null if the scene has
    targets and nothing was found.
    """
    start = time.perf_counter()
    try:
        estimate = locate(scene.cloud)
    except (NoEstimate, InputError) as error:
        parts = {part: {"found": False, "iou": 0.0} for part in scene.reference.names}
        verdict = {"quality": "none", "reason": str(error), "failed": str(error)}
        entry = {"name": name, "parts": parts, "miou": 0.0, **verdict}
        entry |= {} if scene.targets is None else {"tre_mm": None}
        return entry | ({} if rivals is None else {"rivals": rivals(scene)}), None
    seconds = time.perf_counter() - start
    parts = compare(estimate, scene)
    entry = {
        "name": name,
        "parts": parts,
        "miou": metrics.mean_iou({name: part["iou"] for name, part in parts.items()}),
        "quality": estimate.quality,
        "reason": estimate.reason,
        "seconds": seconds,
        "timings": estimate.report.timings,
        "failed": failure(parts),
    }
    if estimate.motion is not None and scene.targets is not None:
        entry["tre_mm"] = metrics.target_errors(
            estimate.motion.carry(scene.targets.points_ct), scene.targets
        )
    entry |= {} if rivals is None else {"rivals": rivals(scene)}
    return entry, estimate


def failure(parts: dict[str, dict[str, Any]]) -> str | None:
    """Why an answer with these metrics counts as failed, if it does."""
    if missing := [name for name, part in parts.items() if not part["found"]]:
        return f"not found: {', '.join(missing)}"
    far_mm, name = worst_center({"parts": parts})
    return f"far off: the centre of {name} by {far_mm:.1f} mm" if far_mm > FAR_MM else None


def compare(estimate: Estimate, scene: Scene) -> dict[str, dict[str, Any]]:
    """Metrics of every true part; one that was not found has only ``found`` and ``iou``."""
    assert estimate.volume is not None
    ious = metrics.label_ious(estimate.volume, scene.reference)
    parts: dict[str, dict[str, Any]] = {}
    for name, reference in zip(scene.reference.names, scene.reference.parts, strict=True):
        mesh, distances = estimate.meshes.get(name), {}
        if found := mesh is not None and len(mesh.faces) > 0:
            distances = metrics.part_distances(mesh, reference)
        parts[name] = {"found": found, **distances, "iou": ious[name]}
    return parts
