"""The protocol: locate in every scene of a folder, compare with the truth, summarise."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

import tumortrack
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import FAR_MM, Estimate
from tumortrack.core.store import write_json, writing
from tumortrack.core.types import SensorCloud
from tumortrack.report import metrics
from tumortrack.report.page import counts, number, page_scene, part_rows, write_page
from tumortrack.report.pictures import scene_picture
from tumortrack.simulate.scene_folder import Scene, list_scenes, read_scene

DISTANCES = (*(field.name for field in fields(metrics.SurfaceDistances)), "center_mm")
MEDIANS = (
    "Medians over all scenes that have the part. A part that was not found counts as infinitely "
    "far and with IoU 0; a median that is infinite is written as null."
)
RULE = (
    f"{MEDIANS} A scene counts as failed where a part was not found, or where the centre of a "
    f"tumor (without one: of the organ) is over {FAR_MM:g} mm off, whether the answer is called "
    "good or poor; where nothing was found its mIoU is 0 and its target errors are infinite."
)
TARGET_ERRORS = ("mean", "rms", "median", "p95", "max")
Locate = Callable[[SensorCloud], Estimate]


def evaluate_scenes(
    locate: Locate,
    scenes_dir: Path,
    out: Path,
    progress: Callable[[], None] = lambda: None,
    about: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Evaluate ``locate`` on every scene of a folder.

    Writes OUT/scenes/NAME.png, OUT/index.html and, last, OUT/report.json (each atomically; a report
    that lies there is replaced). Raises InputError: no scenes, or a scene that cannot be read;
    StorageError: the disk refused.

    Args:
        locate: observed cloud (camera frame, mm) -> estimate; raises NoEstimate or InputError
            where it can say nothing, which counts as a failed scene.
        progress: called after each scene.
        about: plain JSON that the report repeats: the model and options behind ``locate``.
    """
    folders = list_scenes(scenes_dir)
    with writing(out):
        (out / "scenes").mkdir(parents=True, exist_ok=True)
        (out / "report.json").unlink(missing_ok=True)  # never an old table beside new pictures
    entries, shown = [], []
    for folder in folders:
        scene = read_scene(folder)
        entry, estimate = evaluate_scene(locate, scene, folder.name)
        if isinstance(stated := scene.meta.get("registration"), dict):  # of a second CT as truth
            entry["registration_mm"] = stated.get("tre_mm", {})
        picture = out / "scenes" / f"{folder.name}.png"
        scene_picture(scene, estimate, entry, picture)
        entries.append(entry)
        shown.append(page_scene(folder.name, scene, estimate, picture))
        progress()
    report = {
        "tumortrack": tumortrack.__version__,
        "units": "mm",
        "frame": "camera",
        **(about or {}),
        "rule": RULE,
        "summary": summarise(entries),
        "scenes": entries,
    }
    write_page(report, shown, out / "index.html")
    write_json(out / "report.json", report)
    return report


def evaluate_scene(
    locate: Locate, scene: Scene, name: str
) -> tuple[dict[str, Any], Estimate | None]:
    """One scene's entry: name, parts -> metrics, miou, seconds, timings, and failed (or null).

    ``tre_mm`` is there where the scene has targets and the estimate a motion; null where the scene
    has targets and nothing was found.
    """
    start = time.perf_counter()
    try:
        estimate = locate(scene.cloud)
    except (NoEstimate, InputError) as error:
        parts = {part: {"found": False, "iou": 0.0} for part in scene.reference.names}
        entry = {"name": name, "parts": parts, "miou": 0.0, "failed": str(error)}
        return (entry if scene.targets is None else {**entry, "tre_mm": None}), None
    seconds = time.perf_counter() - start
    parts = compare(estimate, scene)
    entry = {
        "name": name,
        "parts": parts,
        "miou": metrics.mean_iou({name: part["iou"] for name, part in parts.items()}),
        "quality": estimate.quality,
        "reason": estimate.reason,
        "seconds": seconds,
        "timings": estimate.report.get("timings", {}),
        "failed": failure(parts),
    }
    if estimate.motion is not None and scene.targets is not None:
        entry["tre_mm"] = metrics.target_errors(estimate.motion, scene.targets)
    return entry, estimate


def failure(parts: dict[str, dict[str, Any]]) -> str | None:
    """Why an answer with these metrics counts as failed; None: it does not."""
    if missing := [name for name, part in parts.items() if not part["found"]]:
        return f"not found: {', '.join(missing)}"
    name = max(list(parts)[1:] or parts, key=lambda part: parts[part]["center_mm"])
    far_mm = parts[name]["center_mm"]
    return f"far off: the centre of {name} by {far_mm:.1f} mm" if far_mm > FAR_MM else None


def compare(estimate: Estimate, scene: Scene) -> dict[str, dict[str, Any]]:
    """Metrics of every part of the truth; a part that was not found has only found and iou."""
    assert estimate.volume is not None
    ious = metrics.label_ious(estimate.volume, scene.reference)
    parts: dict[str, dict[str, Any]] = {}
    for name, reference in zip(scene.reference.names, scene.reference.parts, strict=True):
        mesh, distances = estimate.meshes.get(name), {}
        if found := mesh is not None and len(mesh.faces) > 0:
            distances = asdict(metrics.surface_distances(mesh, reference))
            distances["center_mm"] = metrics.box_center_distance(mesh, reference)
        parts[name] = {"found": found, **distances, "iou": ious[name]}
    return parts


def summarise(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians per part, ``miou`` (median over scenes), and counts: ``scenes``; of them ``good``,
    ``poor``, the others have no answer; and ``failed``; of these ``far`` have an answer that is far
    off, called good in ``far_good``.

    ``tre_mm`` holds the medians of the scenes' target errors and how many ``scenes`` count, where
    the method knows a motion. A part's ``registration_mm`` is the rms error that its truth is
    expected to have by its registration, where scenes state one. The rule for parts that were not
    found is ``RULE``.
    """
    summary: dict[str, Any] = {}
    for name in dict.fromkeys(part for entry in entries for part in entry["parts"]):
        rows = [entry["parts"][name] for entry in entries if name in entry["parts"]]
        medians = {key: _median([row.get(key, np.inf) for row in rows]) for key in DISTANCES}
        summary[name] = {
            **medians,
            "iou": _median([row["iou"] for row in rows]),
            "found": sum(row["found"] for row in rows),
            "scenes": len(rows),
        }
        shares = [e["registration_mm"].get(name) for e in entries if "registration_mm" in e]
        if shares and None not in shares:
            summary[name]["registration_mm"] = float(np.sqrt(np.mean(np.square(shares))))
    errors = [entry["tre_mm"] for entry in entries if "tre_mm" in entry]
    if any(errors):
        medians = {
            key: _median([(e or {}).get(key, np.inf) for e in errors]) for key in TARGET_ERRORS
        }
        summary["tre_mm"] = {**medians, "scenes": len(errors)}
    summary["miou"] = _median([entry["miou"] for entry in entries])
    summary["miou_mean"] = float(np.mean([entry["miou"] for entry in entries]))
    for quality in ("good", "poor"):
        summary[quality] = sum(entry.get("quality") == quality for entry in entries)
    failed = [entry for entry in entries if entry["failed"] is not None]
    far = [entry for entry in failed if entry["failed"].startswith("far off")]
    summary["failed"], summary["far"] = len(failed), len(far)
    summary["far_good"] = sum(entry["quality"] == "good" for entry in far)
    summary["scenes"] = len(entries)
    return summary


def summary_table(report: dict[str, Any]) -> Table:
    """The summary as a table for the terminal."""
    summary = report["summary"]
    errors = summary.get("tre_mm")
    targets = f", target error {number(errors['mean'], 1)} mm" if errors else ""
    table = Table(title=f"{counts(summary)}, mIoU {summary['miou']:.3f}{targets} (medians)")
    table.add_column("part")
    for head in ("found", "HD mm", "one-sided", "HD95", "surface", "centre", "IoU"):
        table.add_column(head, justify="right")
    rows = part_rows(summary)
    if registered := any("registration_mm" in part for part in rows.values()):
        table.add_column("± mm", justify="right")
        table.caption = "± mm: the expected error of the truth, by its registration"
    for name, part in rows.items():
        numbers = [number(part[key], 1 if key != "surface_mm" else 2) for key in DISTANCES]
        found = f"{part['found']}/{part['scenes']}"
        share = [number(part.get("registration_mm"))] if registered else []
        table.add_row(name, found, *numbers, number(part["iou"]), *share)
    return table


def _median(values: list[float]) -> float | None:
    """The median, None where it is infinite (more than half the scenes without the part)."""
    ordered = np.sort(np.array(values, float))
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return float((low + high) / 2) if np.isfinite(high) else None
