"""Thumbnails for the page of a fleet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from tumortrack.report.pictures import scene_picture
from tumortrack.report.protocol import evaluate_scene
from tumortrack.simulate.scene_folder import read_scene
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Tracker

_WIDTH = 720  # pixels


def thumbnail(source: Path, out: Path) -> None:
    """A picture, no wider than ``_WIDTH``, as WebP."""
    with Image.open(source) as image:
        size = min(_WIDTH, image.width), round(image.height * min(1, _WIDTH / image.width))
        image.convert("RGB").resize(size).save(out, "WEBP", quality=80)


def worst_picture(
    case: Path, groups: Sequence[Path], rows: Sequence[dict[str, Any]], out: Path
) -> None:
    """The estimate with the largest error, good ones first, over the truth; without estimates the
    first scene's truth; without scenes nothing."""

    def far(row: dict[str, Any]) -> tuple[int, float]:
        errors = [tumor.get("middle_mm", -np.inf) for tumor in row["tumors"]]
        return ["refused", "poor", "good"].index(row["verdict"]), max(errors, default=-np.inf)

    if not rows:
        return
    name = max(rows, key=far)["scene"]
    [folder] = [group / name for group in groups if (group / name).is_dir()]
    scene, tracker = read_scene(folder), Tracker(load_model(case))
    entry, estimate = evaluate_scene(
        lambda cloud: tracker.locate(cloud, seen=scene.depth), scene, name
    )
    with TemporaryDirectory() as aside:
        shown = estimate.meshes if estimate else {}
        scene_picture(scene, shown, entry, Path(aside) / "scene.png")
        thumbnail(Path(aside) / "scene.png", out)
