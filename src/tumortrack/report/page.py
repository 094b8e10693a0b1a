"""One HTML file that shows a whole report, offline: table, 3-D view per scene, pictures."""

from __future__ import annotations

import base64
import html
import io
import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from tumortrack.core.colours import OBSERVED, ORGAN_PART, TRUTH, TUMORS
from tumortrack.core.estimate import Estimate
from tumortrack.core.organ import is_tumor
from tumortrack.core.patient import patient_in
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.simulate.scene_folder import Scene

_ORGAN_CELL_MM, _TUMOR_CELL_MM = 2.5, 2.0
_COLUMNS = {
    "hausdorff_mm": "Hausdorff mm",
    "hausdorff_one_sided_mm": "one-sided mm",
    "hausdorff_95_mm": "HD95 mm",
    "surface_mm": "mean surface mm",
    "center_mm": "centre mm",
    "iou": "IoU",
}
_SHOWN_POINTS = 4000


def page_scene(name: str, scene: Scene, estimate: Estimate | None, picture: Path) -> dict[str, Any]:
    """What the page shows of a scene, small (JSON types): ``layers``, thinned meshes, and
    ``picture``, the PNG that ``scene_picture`` wrote, compressed."""
    points_mm = scene.cloud.points_mm
    step = -(-len(points_mm) // _SHOWN_POINTS)
    layers = [{"kind": "points", "name": "observed points", "v": _packed(points_mm[::step])}]
    shown = estimate.meshes if estimate else {}
    for part, mesh in shown.items():
        layers.append(_layer("mesh", f"{part} (estimate)", part, mesh))
    for part, mesh in zip(scene.reference.names, scene.reference.parts, strict=True):
        kind = "wire" if is_tumor(part) else "truth"
        layers.append(_layer(kind, f"{part} (truth)", part, mesh))
    webp = io.BytesIO()
    with Image.open(picture) as image:
        image.convert("RGB").save(webp, "WEBP", quality=82)
    return {"name": name, "layers": layers, "picture": _base64(webp.getvalue())}


def write_page(report: dict[str, Any], scenes: list[dict[str, Any]], path: Path) -> None:
    """Write the page, atomically; it holds plotly itself and loads nothing from anywhere.

    ``report``: as ``evaluate_scenes`` returns it; ``scenes``: of ``page_scene``, in its order.
    """
    from plotly.offline import get_plotlyjs

    data = [
        {**scene, "rows": _table(entry["parts"]), "note": html.escape(_note(entry))}
        for entry, scene in zip(report["scenes"], scenes, strict=True)
    ]
    embedded = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    # The texts that are long or hold braces go in by position, never through a formatter.
    page = resources.files("tumortrack.report").joinpath("page.html").read_text("utf-8")
    page = page.replace("@SUMMARY@", _table(part_rows(report["summary"])))
    whose = f"{patient_in(report.get('patient'), 'report')}. "
    page = page.replace("@COUNTS@", html.escape(whose + _counts(report["summary"])))
    page = page.replace("@RULE@", html.escape(report["rule"]))
    shades = {"truth": TRUTH, "points": OBSERVED, "organ": ORGAN_PART, "tumors": TUMORS}
    page = page.replace("@COLOURS@", json.dumps(shades))
    head, script = page.split("@PLOTLY@")
    middle, tail = script.split("@DATA@")
    text = "".join((head, get_plotlyjs(), middle, embedded, tail))
    write_atomically(path, text.encode())


def thinned(mesh: Mesh, cell_mm: float) -> Mesh:
    """A coarser mesh for display: vertices of one cubic cell become their mean."""
    cells = np.floor(mesh.vertices_mm / cell_mm).astype(np.int64)
    _, group = np.unique(cells, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    means = [np.bincount(group, mesh.vertices_mm[:, axis]) / count for axis in range(3)]
    a, b, c = group[mesh.faces].T
    proper = (a != b) & (b != c) & (c != a)
    faces = np.stack([a, b, c], axis=1)[proper]
    # A thin fold collapses onto two sheets with the same corners: drop what occurs in pairs.
    _, kind, times = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return Mesh(np.stack(means, axis=1), faces[times[kind.reshape(-1)] % 2 == 1])


def _layer(kind: str, name: str, part: str, mesh: Mesh) -> dict[str, Any]:
    small = thinned(mesh, _TUMOR_CELL_MM if is_tumor(part) else _ORGAN_CELL_MM)
    about = {"kind": kind, "part": part, "name": name.replace("_", " ")}
    faces = _base64(small.faces.astype("<u4").tobytes())
    return {**about, "v": _packed(small.vertices_mm), "f": faces}


def _packed(points_mm: Float[np.ndarray, "n 3"]) -> str:
    """Little-endian float32, rounded to 0.01 mm, in base64."""
    return _base64(np.round(points_mm, 2).astype("<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def counts(summary: dict[str, Any]) -> str:
    """How many scenes there are, and how many answers are what, in words."""
    far = f"{summary['far']} far off, {summary['far_good']} of them called good"
    answers = f"{summary['good']} good, {summary['poor']} poor"
    return f"{summary['scenes']} scenes, {summary['failed']} failed ({far}), {answers}"


def _counts(summary: dict[str, Any]) -> str:
    text = f"{counts(summary)}. Median mIoU {summary['miou']:.3f}."
    if not (errors := summary.get("tre_mm")):
        return text
    mean, p95, largest = (number(errors[key]) for key in ("mean", "p95", "max"))
    return (
        f"{text} Target registration error, medians over {errors['scenes']} scenes: mean {mean} "
        f"mm, 95th percentile {p95} mm, largest {largest} mm."
    )


def _note(entry: dict[str, Any]) -> str:
    took = f", located in {entry['seconds']:.2f} s" if "seconds" in entry else ""
    failed = "" if entry["failed"] is None else f", FAILED: {entry['failed']}"
    errors = entry.get("tre_mm")
    targets = "" if not errors else f", {target_text(errors)}"
    return f"mIoU {entry['miou']:.3f}{targets}{took}{failed}"


def target_text(errors: dict[str, Any]) -> str:
    """A scene's target errors in a few words."""
    return (
        f"target error {errors['mean']:.1f} mm (mean of {errors['count']}, "
        f"largest {errors['max']:.1f} mm)"
    )


def part_rows(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What the summary says of parts, by name."""
    return {k: row for k, row in summary.items() if isinstance(row, dict) and "found" in row}


def _table(parts: dict[str, dict[str, Any]]) -> str:
    """Of a scene's parts, or the summary's."""
    columns = dict(_COLUMNS)
    if any("registration_mm" in part for part in parts.values()):
        columns["registration_mm"] = "registration mm"
    head = "".join(f"<th>{title}</th>" for title in ("part", "found", *columns.values()))
    rows = []
    for name, part in parts.items():
        found = "yes" if part["found"] else "no"
        found = f"{part['found']}/{part['scenes']}" if "scenes" in part else found
        cells = "".join(f"<td>{number(part.get(key))}</td>" for key in columns)
        label = html.escape(name.replace("_", " "))
        rows.append(f"<tr><th>{label}</th><td>{found}</td>{cells}</tr>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def number(value: float | None, digits: int = 2) -> str:
    return "none" if value is None else f"{value:.{digits}f}"
