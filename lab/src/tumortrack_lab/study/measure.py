"""Measurements: one method on a case's scenes, kept as JSON, a row for each part."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.estimate import Estimate
from tumortrack.core.process import available_cores
from tumortrack.report.protocol import evaluate_scene
from tumortrack.simulate.scene_folder import read_scene
from tumortrack_lab.bench.machine import cpu_name
from tumortrack_lab.study import scripts
from tumortrack_lab.study.methods import Method, StudyCase

One = Callable[[StudyCase, Method, str, str, int], list[dict[str, Any]]]


def measured(
    case: StudyCase, method: Method, variants: Sequence[str], view: str, grid: int, folder: Path,
    measure_scene: One | None = None, **also: Any,
) -> list[dict[str, Any]]:  # fmt: skip
    """The rows that ``measure_scene`` (default: ``measure_one``) makes of each variant's scene.
    They are kept in ``folder``, and made again if a scene, the case, the method, the grid or
    ``also`` (JSON) has changed. Raises InputError: a scene is missing or cannot be read."""
    about = {
        "case": store.sha256_of(case.folder / store.MANIFEST),
        "scenes": {variant: store.sha256_of(case.scene(variant, view)) for variant in variants},
        "method": {"name": method.name, "seed": method.seed, **method.identity},
        "grid": grid,
        **also,
    }
    measure_scene = measure_scene or measure_one

    def measure() -> list[dict[str, Any]]:
        known = {"case": case.name, "method": method.name, "seed": method.seed, "view": view}
        known |= {"grid": grid}
        rows = []
        for variant in variants:
            made = measure_scene(case, method, variant, view, grid)
            rows += [{**known, "variant": variant, **_machine(), **row} for row in made]
        return rows

    name = f"{case.name}-{method.name}-{method.seed}-{view}-{measure_scene.__name__}.json"
    return scripts.kept(folder / name, about, measure)


def _machine() -> dict[str, Any]:
    return {
        "on": f"{cpu_name()} ({available_cores()} cores)",
        "when": time.strftime("%Y-%m-%d", time.gmtime()),
        "load": round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None,
    }


def measure_one(
    case: StudyCase, method: Method, variant: str, view: str, grid: int
) -> list[dict[str, Any]]:
    """One scene: the protocol's metrics and target errors; a row for each part."""
    scene = read_scene(case.scene(variant, view))

    def locate(_: object) -> Estimate:
        return method.locate(scene, grid)

    entry, _ = evaluate_scene(locate, scene, f"{variant}-{view}")
    targets = entry.get("tre_mm")
    whole = {
        "miou": entry["miou"],
        "failed": not all(part["found"] for part in entry["parts"].values()),
        "target_mm": targets["mean"] if targets else None,
    }
    return [
        {**whole, "part": name, **(part if part["found"] else {})}
        for name, part in entry["parts"].items()
    ]
