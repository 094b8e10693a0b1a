"""The protocol: locate in every scene of a folder, compare with the truth, summarise."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import tumortrack
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import FAR_MM, Estimate
from tumortrack.core.process import available_cores, undisturbed
from tumortrack.core.store import read_json, write_json, writing
from tumortrack.io.scene_folder import Scene, list_scenes, read_scene
from tumortrack.registration.base_model import Model
from tumortrack.report import metrics
from tumortrack.report.baselines import baselines_of
from tumortrack.report.summary import MEANING, NO_BASELINES, RULE, summarise, worst_center
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.options import model_folder
from tumortrack.tracking.tracker import Tracker

Locate = Callable[..., Estimate]  # of a cloud; where a scene has some, of ``evidence=``, too
Compare = Callable[[Scene], dict[str, Any]]
_THREADS = 2  # scenes at once: what is Python alone runs in turns, and more gain little
_OURS = {"scenes", "index.html", "report.json"}


def evaluate_model(
    model: Path | Tracker,
    scenes_dir: Path,
    out: Path,
    grid: int = 160,
    seed: int = 0,
    device: str = "auto",
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """``evaluate_scenes`` with a tracker, or the model of a folder, which the report then names.
    Also raises InputError for scenes of another case."""
    digest = {}
    if not isinstance(model, Tracker):
        folder = model_folder(model)
        digest = {"model_sha256": store.sha256_of(folder / store.MANIFEST)}
        model = Tracker(load_model(folder, device))
    check_case(model.model, list_scenes(scenes_dir))
    about = {
        "patient": to_builtins(model.model.patient),
        "model": model.model.provenance,
        **digest,
        "scenes_folder": str(scenes_dir),
        "grid": grid,
        "seed": seed,
    }
    locate = partial(model.locate, grid=grid, seed=seed)
    baselines, threads = baselines_of(model.model), min(available_cores(), _THREADS)
    return evaluate_scenes(locate, scenes_dir, out, progress, about, baselines, threads)


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
    baselines: Compare | None = None,
    threads: int = 1,
) -> dict[str, Any]:
    """Evaluate ``locate`` on every scene of a folder; OUT gets report.json, scenes/NAME.png and
    index.html, in place of a report that is there (``check_place`` says whether that is allowed).
    If it is interrupted, no report is left.

    Args:
        locate: observed cloud (camera frame, mm) -> estimate; raises NoEstimate or InputError if it
            has none, which counts as a failed scene. Gets ``evidence=`` of scenes that have some.
        progress: called after each scene.
        about: plain JSON for the report: the model and options behind ``locate``.
        baselines: rigid registration of a scene, see ``report.baselines.Baselines``.
        threads: scenes at once; over 1 only if ``locate`` may be called by several.

    Raises:
        InputError: no scenes, or a scene that cannot be read.
        StorageError: the disk refused.
    """
    from tumortrack.report.page import page_scene, write_page
    from tumortrack.report.pictures import scene_picture

    folders, entries, shown = list_scenes(scenes_dir), list[dict[str, Any]](), []

    def judged(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
        scene = read_scene(folder)
        entry, estimate = evaluate_scene(locate, scene, folder.name, baselines)
        if isinstance(stated := scene.meta.get("registration"), dict):  # of a second CT
            entry["registration_mm"] = stated.get("tre_mm", {})
        if isinstance(said := scene.meta.get("words"), str):
            entry["message"] = said
        meshes = estimate.meshes if estimate else {}
        picture = out / "scenes" / f"{folder.name}.png"
        scene_picture(scene, meshes, entry, picture)
        return entry, page_scene(scene, meshes, picture)

    clear(out)
    pool = ThreadPoolExecutor(threads)
    try:
        with writing(out):
            (out / "scenes").mkdir(parents=True, exist_ok=True)
        for entry, seen in pool.map(judged, folders) if threads > 1 else map(judged, folders):
            entries.append(entry)
            shown.append(seen)
            progress()
        report = {
            "tumortrack": tumortrack.__version__,
            "units": "mm",
            "frame": "camera",
            **(about or {}),
            "baselines": MEANING if baselines is not None else {"not_available": NO_BASELINES},
            "rule": RULE,
            "summary": summarise(entries),
            "scenes": entries,
        }
        write_json(out / "report.json", report)
        write_page(report, shown, out / "index.html")
    except BaseException:  # Ctrl-C, too: an unfinished report would block the next command
        with undisturbed():
            pool.shutdown(cancel_futures=True)
            clear(out)
        raise
    pool.shutdown()
    return report


def check_place(out: Path, overwrite: bool) -> None:
    """Raises InputError if a report cannot be written there: ``overwrite`` replaces only an empty
    folder, or an earlier report without other files in it."""
    if not out.exists():
        return
    if not overwrite:
        raise InputError(f"{out} exists already. Choose another path, or give --overwrite.")
    if not out.is_dir():
        raise InputError(f"{out} is a file; --overwrite replaces only a report's folder.")
    if not (inside := {path.name for path in out.iterdir()}):
        return
    report = read_json(out / "report.json") if "report.json" in inside else {}
    if not ({"rule", "summary", "scenes"} <= report.keys()):
        raise InputError(
            f"{out} is not a report of `evaluate`, so --overwrite does not replace it. Choose "
            "another path, or move the folder away yourself."
        )
    entries = [entry for entry in report["scenes"] if isinstance(entry, dict)]
    pictures = {f"{entry.get('name')}.png" for entry in entries}
    drawn = {path.name for path in (out / "scenes").glob("*")}
    if foreign := sorted((inside - _OURS) | (drawn - pictures)):
        raise InputError(
            f"{out} also holds {', '.join(foreign[:3])}, which no report has; --overwrite would "
            "lose it. Move it away first, or choose another path."
        )


def clear(out: Path) -> None:
    """Remove a report's files, and the folders if nothing else is in them."""
    with writing(out):
        for path in (out / "report.json", out / "index.html", *(out / "scenes").glob("*.png")):
            path.unlink(missing_ok=True)
    for folder in (out / "scenes", out):
        with suppress(OSError):
            folder.rmdir()


def evaluate_scene(
    locate: Locate, scene: Scene, name: str, baselines: Compare | None = None
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
        return entry | ({} if baselines is None else {"baselines": baselines(scene)}), None
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
            estimate.motion.forward(scene.targets.points_ct), scene.targets
        )
    entry |= {} if baselines is None else {"baselines": baselines(scene)}
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
