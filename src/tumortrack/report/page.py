"""One HTML file that shows a whole report, offline: table, 3-D view per scene, pictures."""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from tumortrack.core import colours
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED
from tumortrack.core.geometry import plane_section
from tumortrack.core.organ import is_tumor
from tumortrack.core.patient import patient_in
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.report.summary import (
    MEASURES,
    METHODS,
    RIVALS,
    SAID,
    VERDICTS,
    conclusions,
    error_rows,
    failures,
    measures,
    number,
    part_rows,
    rival_center,
    scene_note,
    verdict_counts,
    words,
    worst_center,
)
from tumortrack.simulate.scene_folder import Scene

_ORGAN_CELL_MM, _TUMOR_CELL_MM = 2.5, 2.0
_MAX_POINTS, _AROUND_MM = 2000, 12.0  # of the cloud, in a box so much larger than the organ's


def page_scene(scene: Scene, shown: Mapping[str, Mesh], picture: Path) -> dict[str, Any]:
    """The page's data of a scene (JSON types): ``layers``, simplified meshes, ``box`` around organ
    and tumors, and ``picture``, the PNG of ``scene_picture``, compressed."""
    meshes = [*scene.reference.parts, *shown.values()]
    lower = np.min([mesh.box_mm[0] for mesh in meshes], axis=0) - _AROUND_MM
    upper = np.max([mesh.box_mm[1] for mesh in meshes], axis=0) + _AROUND_MM
    points_mm = scene.cloud.points_mm
    points_mm = points_mm[((points_mm > lower) & (points_mm < upper)).all(1)]
    step = max(1, -(-len(points_mm) // _MAX_POINTS))
    points = {"kind": "points", "name": "observed points", "v": _packed(points_mm[::step])}
    layers = [{**points, "color": colours.css(colours.SEEN)}]
    layers += [_surface(part, mesh) for part, mesh in shown.items()]
    layers += map(_outline, scene.reference.names, scene.reference.parts)
    webp = io.BytesIO()
    with Image.open(picture) as image:
        image.convert("RGB").save(webp, "WEBP", quality=82, method=2)  # in half of 4's time
    box = [lower.round(1).tolist(), upper.round(1).tolist()]
    return {"layers": layers, "box": box, "picture": _base64(webp.getvalue())}


def write_page(report: dict[str, Any], scenes: list[dict[str, Any]], path: Path) -> None:
    """Write the self-contained page, atomically.

    ``report``: as ``evaluate_scenes`` returns it; ``scenes``: of ``page_scene``, in its order.
    """
    entries, summary = report["scenes"], report["summary"]
    data = {
        "scenes": [
            {**scene, **_about(entry), "rows": _part_table(entry["parts"])}
            for entry, scene in zip(entries, scenes, strict=True)
        ],
        **_typical_and_worst(entries),
    }
    embedded = json.dumps(data, allow_nan=False).replace("</", "<\\/")
    # Long texts, and those with braces, are inserted by position, not by a formatter.
    folder = resources.files("tumortrack.report")
    page = folder.joinpath("page.html").read_text("utf-8")
    texts = {
        "WHOSE": html.escape(str(patient_in(report.get("patient"), "report"))),
        "SCENES": html.escape(verdict_counts(summary)),
        "VERDICTS": _verdicts(summary),
        "FAILED": html.escape(failures(summary)),
        "ERRORS": _error_table(summary),
        "RIVALS": _rivals(report),
        "TABLE": _scene_table(entries),
        "CONCLUSIONS": "".join(f"<li>{html.escape(line)}</li>" for line in conclusions(entries)),
        "SUMMARY": _part_table(part_rows(summary)),
        "RULE": html.escape(report["rule"]),
        "VERDICT_COLOURS": " ".join(
            f".{verdict} {{ --verdict: {colours.css(c)}; }}"
            for verdict, c in colours.VERDICTS.items()
        ),
    }
    for name, text in texts.items():
        page = page.replace(f"@{name}@", text)
    head, script = page.split("@VIEW@")
    middle, tail = script.split("@DATA@")
    view = folder.joinpath("view.js").read_text("utf-8")
    write_atomically(path, "".join((head, view, middle, embedded, tail)).encode())


def thinned(mesh: Mesh, cell_mm: float) -> Mesh:
    """A coarser mesh for display: the vertices in a cubic cell are replaced by their mean."""
    group = _numbered(np.floor(mesh.vertices_mm / cell_mm).astype(np.int64))[0]
    count = np.bincount(group)
    means = [np.bincount(group, mesh.vertices_mm[:, axis]) / count for axis in range(3)]
    a, b, c = group[mesh.faces].T
    faces = group[mesh.faces][(a != b) & (b != c) & (c != a)]
    # A thin fold collapses to two sheets with the same corners: drop faces that occur in pairs.
    kind, times = _numbered(np.sort(faces, axis=1))
    return Mesh(np.stack(means, axis=1), faces[times[kind] % 2 == 1])


def _numbered(rows: Int[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
    """Each row's number among the different ones in order, and how often each of those occurs: as
    by ``np.unique``, in a fifth of the time."""
    offset = rows - rows.min(0, initial=0)
    _, sizes_j, sizes_k = (offset.max(0, initial=0) + 1).tolist()
    keys = (offset[:, 0] * sizes_j + offset[:, 1]) * sizes_k + offset[:, 2]
    _, kind, times = np.unique(keys, return_inverse=True, return_counts=True)
    return kind, times


def _surface(part: str, mesh: Mesh) -> dict[str, Any]:
    small = thinned(mesh, _TUMOR_CELL_MM if is_tumor(part) else _ORGAN_CELL_MM)
    faces = _base64(small.faces.astype("<u4").tobytes())
    color = colours.css(colours.name_colour(part))
    about = {"kind": "surface", "name": f"{words(part)}, estimated", "color": color}
    return {**about, "tumor": is_tumor(part), "v": _packed(small.vertices_mm), "f": faces}


def _outline(part: str, mesh: Mesh) -> dict[str, Any]:
    """The true surface cut by three planes through its centre: a line for each pair of points."""
    middle_mm = mesh.box_mm.mean(0)
    cuts = [plane_section(mesh.vertices_mm, mesh.faces, axis, middle_mm) for axis in np.eye(3)]
    lines = np.concatenate(cuts).reshape(-1, 3)
    about = {"kind": "outline", "name": f"{words(part)}, true (cuts)", "tumor": is_tumor(part)}
    return {**about, "v": _packed(lines)}


def _packed(points_mm: Float[np.ndarray, "n 3"]) -> str:
    """Little-endian float32, rounded to 0.01 mm, in base64."""
    return _base64(np.round(points_mm, 2).astype("<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _about(entry: dict[str, Any]) -> dict[str, Any]:
    """A scene's name, verdict, reason, and errors in one line."""
    reason = f"{NO_CHECK_FAILED}; {UNVERIFIED}" if entry["quality"] == "good" else entry["reason"]
    name = ": ".join(filter(None, (entry["name"], entry.get("words"))))
    about = {"name": name, "verdict": entry["quality"], "reason": reason}
    return {**about, "note": scene_note(entry)}


def _typical_and_worst(entries: list[dict[str, Any]]) -> dict[str, int]:
    """Indices of the scenes with the median and the largest error of a tumor's centre; without any
    answer, of the first scene."""
    errors = [(worst_center(entry)[0], n) for n, entry in enumerate(entries)]
    answers = sorted((mm, n) for mm, n in errors if entries[n]["quality"] != "none") or errors[:1]
    return {"typical": answers[(len(answers) - 1) // 2][1], "worst": answers[-1][1]}


def _verdicts(summary: dict[str, Any]) -> str:
    """A card for each verdict: the number of scenes, and their errors."""
    cards = []
    for verdict in VERDICTS:
        group = summary["errors"].get(verdict, {}).get("estimate", {})
        lines = [html.escape(line) for line in measures(group)]
        meaning = "no estimate, so nothing to measure" if summary[verdict] else "no scene"
        body = "".join(f"<p>{line}</p>" for line in lines or [meaning])
        head = f"<b>{summary[verdict]}</b> {verdict}"
        cards.append(f'<div class="card {verdict}"><h3>{head}</h3>{body}</div>')
    return "".join(cards)


def _rivals(report: dict[str, Any]) -> str:
    meaning = report["rivals"]
    if "not_available" in meaning:
        return html.escape(meaning["not_available"])
    sentences = [f"{RIVALS[name].capitalize()}: {meaning[name]}." for name in RIVALS]
    missing = {e["name"]: r["not_available"] for e in report["scenes"]
               for r in e["rivals"].values() if "not_available" in r}  # fmt: skip
    sentences += [f"Not available of {name}: {why}." for name, why in missing.items()]
    return html.escape(" ".join(sentences))


def _error_table(summary: dict[str, Any]) -> str:
    """By verdict and method: median, 95 % and worst, pooled over scenes, tumors and targets."""
    head = ["answers", "method", "scenes"]
    for measure in MEASURES.values():
        head += [f"{measure}: median, mm", "95 % within, mm", "worst, mm"]
    rows = []
    for verdict, method, group in error_rows(summary):
        cells = [verdict, METHODS[method], str(group["scenes"])]
        for key in MEASURES:
            spread = group.get(key)
            cells += [number(spread[k], 1) for k in ("median", "p95")] if spread else ["", ""]
            where = f" ({words(spread['part'])} of {spread['scene']})" if spread else ""
            cells.append(number(spread["worst"], 1) + where if spread else "")
        rows.append(cells)
    return _table(head, rows)


def _scene_table(entries: list[dict[str, Any]]) -> str:
    described = any("words" in entry for entry in entries)
    head = ["scene", "verdict", *(["organ"] * described), "tumor or organ farthest off"]
    head.append("centre off, mm")
    head += [f"{name}: centre off, mm" for name in RIVALS.values()]
    head += ["targets: mean, mm", "largest, mm"]
    rows = []
    for entry in entries:
        far_mm, part = worst_center(entry)
        centers = [rival_center(entry, name, part) for name in RIVALS]
        errors = entry.get("tre_mm") or {}
        far = [number(far_mm if np.isfinite(far_mm) else None, 1)]
        others = [number(mm, 1) if mm is not None else "-" for mm in centers]
        targets = [number(errors[key], 1) if errors else "-" for key in ("mean", "max")]
        done = [entry.get("words", "")] * described
        about = [entry["name"], entry["quality"], *done, words(part)]
        rows.append([*about, *far, *others, *targets])
    return _table(head, rows)


def _part_table(parts: dict[str, dict[str, Any]]) -> str:
    """Metrics of a scene's parts, or the summary's medians with the worst Hausdorff distance."""
    columns = dict(SAID.columns)
    if any("registration_mm" in part for part in parts.values()):
        columns["registration_mm"] = "expected error of the truth itself, mm"
    over_scenes = any("worst" in part for part in parts.values())
    head = ["part", "found", *columns.values(), *(["worst Hausdorff, mm"] if over_scenes else [])]
    rows = []
    for name, part in parts.items():
        found = "yes" if part["found"] else "no"
        found = f"{part['found']} of {part['scenes']}" if over_scenes else found
        cells = [number(part[key]) if key in part else "-" for key in columns]
        cells = [words(name), found, *cells]
        if over_scenes:
            worst = part["worst"]["hausdorff_mm"]
            cells.append(f"{number(worst['mm'])} ({worst['scene']})")
        rows.append(cells)
    return _table(head, rows)


def _table(head: list[str], rows: list[list[str]]) -> str:
    """In a box that scrolls where the page is too narrow; the first cell names the row."""
    titles = "".join(f"<th>{html.escape(title)}</th>" for title in head)
    body = "".join(
        f"<tr><th>{html.escape(first)}</th>"
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        + "</tr>"
        for first, *cells in rows
    )
    table = f"<table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'
