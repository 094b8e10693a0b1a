"""The protocol: locate in every scene of a folder, compare with the truth, summarise."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate, TumortrackError
from tumortrack.core.estimate import FAR_MM, Estimate
from tumortrack.core.process import undisturbed
from tumortrack.core.store import write_json, writing
from tumortrack.core.types import Mesh
from tumortrack.models.model import Model
from tumortrack.report import metrics
from tumortrack.report.place import clear
from tumortrack.report.rivals import rivals_of
from tumortrack.report.summary import SAID, summarise, worst_center
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.options import model_folder
from tumortrack.tracking.tracker import Tracker

RULE = f"{SAID.medians} {SAID.rule.format(far_mm=FAR_MM)}"
Locate = Callable[..., Estimate]  # of a cloud; where a scene has some, of ``evidence=``, too
Compare = Callable[[Scene], dict[str, Any]]
Judge = Callable[[Path, Path], dict[str, Any]]
Step = Callable[[], None]
_SCENES = 4  # are worth a process
_KILLED = (
    "a process that evaluated scenes was ended from outside, as the system does when memory runs "
    "out; no report was written. End other programs or choose a smaller --grid, and try again."
)


class Asked(NamedTuple):
    """How a model is asked: see ``api.evaluate``. ``processes``: at most, for the model of a
    folder. Each begins with the program's main module, so a script without
    ``if __name__ == "__main__"`` can have but one."""

    grid: int = 160
    seed: int = 0
    device: str = "auto"
    processes: int = 1


_AS_USUAL = Asked()


class _Work(NamedTuple):
    """``map``: over scenes, here or in other processes; ``stop`` ends those."""

    map: Callable[..., Iterable[dict[str, Any]]]
    judge: Judge
    stop: Step = lambda: None


def evaluate_model(
    model: Path | Tracker,
    scenes_dir: Path,
    out: Path,
    asked: Asked = _AS_USUAL,
    progress: Step = lambda: None,
    drawn: Step = lambda: None,
) -> dict[str, Any]:
    """``evaluate_scenes`` with a tracker, or the model of a folder, which the report then names.
    Also raises InputError for scenes of another case; TumortrackError: a process was killed."""
    folders, digest = list_scenes(scenes_dir), {}
    folder = None
    if isinstance(model, Tracker):
        loaded = model.model
    else:
        folder = model_folder(model)
        digest = {"model_sha256": store.sha256_of(folder / store.MANIFEST)}
        loaded = load_model(folder, asked.device)
    check_case(loaded, folders)
    rivals = rivals_of(loaded)
    about = {
        "patient": to_builtins(loaded.patient),
        "model": loaded.provenance,
        **digest,
        "scenes_folder": str(scenes_dir),
        "grid": asked.grid,
        "seed": asked.seed,
    }
    processes = min(asked.processes, os.cpu_count() or 1, len(folders) // _SCENES)
    if folder is None or processes < 2:
        tracker = model if isinstance(model, Tracker) else Tracker(loaded)
        locate = partial(tracker.locate, grid=asked.grid, seed=asked.seed)
        return evaluate_scenes(locate, scenes_dir, out, progress, drawn, about, rivals)
    about |= _said(rivals)
    others = {*active_children()}
    with ProcessPoolExecutor(processes, get_context("spawn"), _begin, (folder, asked)) as pool:

        def stop() -> None:  # what they do is not waited for
            for process in {*active_children()} - others:
                process.kill()
            pool.shutdown()

        work = _Work(partial(_mapped, pool), _in_process, stop)
        try:
            return _report(work, folders, out, (progress, drawn), about)
        except BrokenProcessPool as error:
            raise TumortrackError(_KILLED) from error


_judge: list[Judge] = []  # of a process


def _begin(folder: Path, asked: Asked) -> None:
    """Called once in a new process, which ends with the one that began it."""
    threading.Thread(target=_watch, daemon=True).start()
    tracker = Tracker(load_model(folder, asked.device))
    locate = partial(tracker.locate, grid=asked.grid, seed=asked.seed)
    _judge.append(partial(_judged, locate, rivals_of(tracker.model)))


def _watch() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _in_process(aside: Path, folder: Path) -> dict[str, Any]:
    return _judge[0](aside, folder)


def _mapped(
    pool: ProcessPoolExecutor, call: Callable[..., Any], items: Iterable[Any]
) -> Iterable[Any]:
    with undisturbed():  # processes begin here, and leave Ctrl-C to this one
        tasks = [pool.submit(call, item) for item in items]
    # Not by ``pool.map``: an exception would cancel the others, over which Python's pool stumbles
    # when its processes are killed.
    return (task.result() for task in tasks)


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
    progress: Step = lambda: None,
    drawn: Step = lambda: None,
    about: dict[str, Any] | None = None,
    rivals: Compare | None = None,
) -> dict[str, Any]:
    """Evaluate ``locate`` on every scene of a folder.

    Judges all scenes and writes OUT/report.json, then OUT/scenes/NAME.png and, last,
    OUT/index.html. Replaces a report that is there (``place.check_place`` says whether that is
    allowed), and removes one without all its pictures, even if its figures are complete.
    Raises InputError: no scenes, or a scene that cannot be read; StorageError: the disk refused.

    Args:
        locate: observed cloud (camera frame, mm) -> estimate; raises NoEstimate or InputError if it
            has none, which counts as a failed scene. Gets ``evidence=`` of scenes that have some.
        progress: called after each scene that was judged; drawn: after each picture.
        about: plain JSON for the report: the model and options behind ``locate``.
        rivals: rigid registration of a scene, see ``report.rivals.Rivals``.
    """
    work = _Work(map, partial(_judged, locate, rivals))
    about = {**(about or {}), **_said(rivals)}
    return _report(work, list_scenes(scenes_dir), out, (progress, drawn), about)


def _said(rivals: Compare | None) -> dict[str, Any]:
    return {"rivals": SAID.rivals if rivals is not None else {"not_available": SAID.no_rivals}}


def _judged(locate: Locate, rivals: Compare | None, aside: Path, folder: Path) -> dict[str, Any]:
    """A scene's entry; what its picture shows is put aside."""
    scene = read_scene(folder)
    entry, estimate = evaluate_scene(locate, scene, folder.name, rivals)
    if isinstance(stated := scene.meta.get("registration"), dict):  # of a second CT
        entry["registration_mm"] = stated.get("tre_mm", {})
    if isinstance(said := scene.meta.get("words"), str):
        entry["words"] = said
    with writing(aside):
        _put_aside(aside / f"{folder.name}.npz", estimate.meshes if estimate else {})
    return entry


def _put_aside(path: Path, meshes: Mapping[str, Mesh]) -> None:
    """For ``_put_there``, in another process."""
    arrays = {f"{part}/vertices": mesh.vertices_mm for part, mesh in meshes.items()}
    arrays |= {f"{part}/faces": mesh.faces for part, mesh in meshes.items()}
    np.savez(path, **arrays)  # type: ignore[arg-type]  # numpy's names of options are no parts


def _put_there(path: Path) -> dict[str, Mesh]:
    with np.load(path) as arrays:
        parts = [name.removesuffix("/faces") for name in arrays if name.endswith("/faces")]
        return {part: Mesh(arrays[f"{part}/vertices"], arrays[f"{part}/faces"]) for part in parts}


def _drawn(out: Path, aside: Path, judged: tuple[Path, dict[str, Any]]) -> dict[str, Any]:
    """What the page shows of a scene (its folder and entry); its picture is written."""
    from tumortrack.report.page import page_scene
    from tumortrack.report.pictures import scene_picture  # slow to import, like the page

    folder, entry = judged
    scene, meshes = read_scene(folder), _put_there(aside / f"{folder.name}.npz")
    picture = out / "scenes" / f"{folder.name}.png"
    scene_picture(scene, meshes, entry, picture)
    return page_scene(scene, meshes, picture)


def _report(
    work: _Work, folders: list[Path], out: Path, steps: tuple[Step, Step], about: dict[str, Any]
) -> dict[str, Any]:
    clear(out)
    with TemporaryDirectory(prefix="tumortrack-") as name:
        aside = Path(name)
        try:
            with writing(out):
                (out / "scenes").mkdir(parents=True, exist_ok=True)
            entries = _counted(work.map(partial(work.judge, aside), folders), steps[0])
            report = {
                "tumortrack": tumortrack.__version__,
                "units": "mm",
                "frame": "camera",
                **about,
                "rule": RULE,
                "summary": summarise(entries),
                "scenes": entries,
            }
            write_json(out / "report.json", report)
            shown = _counted(
                work.map(partial(_drawn, out, aside), zip(folders, entries, strict=True)), steps[1]
            )

            from tumortrack.report.page import write_page

            write_page(report, shown, out / "index.html")
        except BaseException:  # Ctrl-C, too: an unfinished report would block the next command
            with undisturbed():
                work.stop()
                clear(out)
            raise
    return report


def _counted(results: Iterable[dict[str, Any]], step: Step) -> list[dict[str, Any]]:
    done = []
    for result in results:
        done.append(result)
        step()
    return done


def evaluate_scene(
    locate: Locate, scene: Scene, name: str, rivals: Compare | None = None
) -> tuple[dict[str, Any], Estimate | None]:
    """One scene's entry: name, quality (good, poor or none) and its reason, parts -> metrics, miou,
    seconds, timings, and failed (or null).

    With ``tre_mm`` if the scene has targets and the estimate a motion; null if the scene has
    targets and nothing was found.
    """
    start, known = time.perf_counter(), {"evidence": scene.evidence} if scene.evidence else {}
    try:
        estimate = locate(scene.cloud, **known)
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
