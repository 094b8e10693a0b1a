"""HTML pages in one file each, which work offline: of an evaluation, and of a run of `locate`."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from html import escape
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from tumortrack.core import colours
from tumortrack.core.assessment import Quality
from tumortrack.core.estimate import Estimate, verdict_words
from tumortrack.core.evidence import CAMERA
from tumortrack.core.geometry import plane_section
from tumortrack.core.mesh_query import thinned
from tumortrack.core.organ import is_tumor
from tumortrack.core.patient import patient_in
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.io.model_folder import training_words
from tumortrack.report import pictures, seen

if TYPE_CHECKING:
    from tumortrack.io.scene_folder import Scene

_ORGAN_CELL_MM, _TUMOR_CELL_MM = 2.5, 2.0
_MAX_POINTS, _AROUND_MM = 2000, 12.0  # of the cloud, in a box so much larger than the organ's
_SCRIPTS = "vendored/three.min.js", "view.js"
_RULES = {
    "verdicts": "Good: no check failed; the place is not verified. Poor: do not rely on it. "
    "None: no estimate. {counts}.",
    "view": "Solid: estimated surfaces. White lines: the true surfaces, cut by three planes "
    "through their middles. Grey points: what the camera saw. Seen from the camera, a little from "
    "the side. Drag to turn, wheel to zoom, double click to reset; a legend entry hides or shows "
    "its part. Typical: the scene whose farthest tumor is as far off as that of the median scene.",
    "errors": "Pooled over all scenes, tumors (without one: the organ) and targets. Centre: how "
    "far a tumor's middle is off. Surface: the largest distance between estimated and true surface "
    "(Hausdorff). Targets: points inside organ and tumors whose true places are known.",
}


def _write(
    path: Path,
    title: str,
    words: str,
    body: Iterable[str],
    banner: colours.Colour | None = None,
    data: dict[str, Any] | None = None,
) -> None:
    """Write a page atomically. ``data``: for view.js; a page without it runs no script."""
    folder = resources.files("tumortrack.report")
    scripts = ""
    if data is not None:
        embedded = json.dumps(data, allow_nan=False).replace("</", "<\\/")
        three, view = (folder.joinpath(n).read_text("utf-8") for n in _SCRIPTS)
        scripts = f'<script id="data" type="application/json">{embedded}</script>'
        scripts += f"<script>{three}</script><script>{view}</script>"
    style = ""
    if banner is not None:
        ink = colours.css(pictures.ink_on(banner))
        style = f' style="background: {colours.css(banner)}; color: {ink}"'
    cells = {
        "@POLICY@": "; script-src 'unsafe-inline'" if scripts else "",
        "@TITLE@": escape(title),
        "@COLOURS@": style,
        "@WORDS@": escape(words),
        "@BODY@": "".join(body),
        "@SCRIPTS@": scripts,
    }
    page = folder.joinpath("page.html").read_text("utf-8")
    page = re.sub("@[A-Z]+@", lambda name: cells[name[0]], page)
    write_atomically(path, page.encode())


def _section(title: str, *content: str, rule: str = "", name: str = "") -> str:
    head = f"<h2>{title}</h2>" if title else ""
    below = f'<p class="rule">{escape(rule)}</p>' if rule else ""
    return f'<section id="{name}">{head}{"".join(content)}{below}</section>'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], dots: Sequence[str] = ()) -> str:
    """In a box that scrolls where the page is too narrow; the first cell names the row. ``dots``:
    colours before the names."""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    body = ""
    for n, (first, *cells) in enumerate(rows):
        dot = f'<i style="background:{dots[n]}"></i>' if dots else ""
        body += f"<tr><th>{dot}{escape(first)}</th>"
        body += "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
    table = f"<table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


# --- of an evaluation ---


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
        image.save(webp, "WEBP", quality=82, method=2)
    box = [lower.round(1).tolist(), upper.round(1).tolist()]
    return {"layers": layers, "box": box, "picture": _base64(webp.getvalue())}


def _surface(part: str, mesh: Mesh) -> dict[str, Any]:
    small = thinned(mesh, _TUMOR_CELL_MM if is_tumor(part) else _ORGAN_CELL_MM)
    color, name = colours.css(colours.name_colour(part)), f"{part.replace('_', ' ')}, estimated"
    about = {"kind": "surface", "name": name, "color": color, "tumor": is_tumor(part)}
    faces = _base64(small.faces.astype("<u4").tobytes())
    return {**about, "v": _packed(small.vertices_mm), "f": faces}


def _outline(part: str, mesh: Mesh) -> dict[str, Any]:
    """The true surface cut by three planes through its centre: a line for each pair of points."""
    middle_mm = mesh.box_mm.mean(0)
    cuts = [plane_section(mesh.vertices_mm, mesh.faces, axis, middle_mm) for axis in np.eye(3)]
    name = f"{part.replace('_', ' ')}, true (cuts)"
    about = {"kind": "outline", "name": name, "tumor": is_tumor(part)}
    return {**about, "v": _packed(np.concatenate(cuts).reshape(-1, 3))}


def _packed(points_mm: Float[np.ndarray, "n 3"]) -> str:
    """Little-endian float32, rounded to 0.01 mm, in base64."""
    return _base64(np.round(points_mm, 2).astype("<f4").tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def write_page(report: dict[str, Any], scenes: list[dict[str, Any]], path: Path) -> None:
    """``report``: of ``evaluate_scenes``; ``scenes``: of ``page_scene``, in its order."""
    from tumortrack.report import summary as said

    entries, summary = report["scenes"], report["summary"]
    errors = [(said.worst_center(entry)[0], n) for n, entry in enumerate(entries)]
    answers = sorted((mm, n) for mm, n in errors if entries[n]["quality"] != "none") or errors[:1]
    data = {
        "typical": answers[(len(answers) - 1) // 2][1],
        "worst": answers[-1][1],
        "scenes": [
            {**scene, **_about(entry), "note": said.scene_note(entry)}
            for entry, scene in zip(entries, scenes, strict=True)
        ],
    }
    cards = ""
    for verdict in said.VERDICTS:
        lines = said.measures(summary["errors"].get(verdict, {}).get("estimate", {}))
        meaning = "no estimate, so nothing to measure" if summary[verdict] else "no scene"
        text = "".join(f"<p>{escape(line)}</p>" for line in lines or [meaning])
        color = colours.css(colours.VERDICTS[verdict])
        cards += f'<div class="card" style="border-left-color: {color}"><h3>'
        cards += f"<b>{summary[verdict]}</b> {verdict}</h3>{text}</div>"
    buttons = "".join(
        f'<button id="{name}">{name}</button>' for name in ("previous", "next", "typical", "worst")
    )
    of_errors, of_parts = said.error_table(summary), said.part_table(summary)
    of_scenes, conclusions = said.scene_table(entries), said.conclusions(entries)
    body = [
        _section(
            "Verdicts: how many answers, and how far off",
            f'<div class="cards">{cards}</div>',
            rule=_RULES["verdicts"].format(counts=_sentence(conclusions[0])),
        ),
        _section(
            "",
            '<div class="bar"><label for="scene"><b>Scene</b></label><select id="scene"></select>',
            f'{buttons}</div><p><span id="verdict" class="badge"></span> ',
            '<span id="reason"></span><br><span id="note"></span></p>',
            '<div id="view"></div>',
            f'<p class="rule">{_RULES["view"]}</p><div id="table"></div>',
        ),
        _section("Views and slices of this scene", '<img id="picture" alt="estimate over truth">'),
        _section(
            "Errors by verdict, beside rigid registration, mm: median / 95 % within / worst",
            _table(of_errors.head, of_errors.rows),
            rule=f"{_RULES['errors']} {_baselines(report)}",
        ),
        _section(
            "All scenes",
            _table(of_scenes.head, of_scenes.rows),
            rule=f"{of_scenes.caption}; targets: their mean error, mm.",
            name="all",
        ),
        _section(
            "By part: medians over the scenes, and the worst",
            _table(of_parts.head, of_parts.rows),
            rule=" ".join(filter(None, (of_parts.title + ".", of_parts.caption, report["rule"]))),
        ),
        _section(
            "What was good, what was wrong, and why",
            f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in conclusions)}</ul>",
        ),
    ]
    whose = patient_in(report.get("patient"), "report")
    words = f"Estimate against truth. {whose}. {said.verdict_counts(summary)}. {_made_by(report)}."
    _write(path, "Tumors located from one depth image", words, body, data=data)


def _made_by(report: dict[str, Any]) -> str:
    """Method, version and date."""
    origin = report.get("model", {})
    method = "The default method" if "validation_tre_mm" in origin else "Another method"
    if "steps" in origin:
        method = f"The paper's method, an occupancy network: {training_words(origin)}"
    return f"{method}; tumortrack {report['tumortrack']}, {date.today().isoformat()}"


def _about(entry: dict[str, Any]) -> dict[str, Any]:
    """A scene's name, verdict, reason, and metrics by part."""
    from tumortrack.report.summary import COLUMNS, number

    reason = verdict_words(entry["quality"], entry["reason"]).partition(": ")[2]
    rows = [
        [
            name.replace("_", " "),
            "yes" if part["found"] else "no",
            *(number(part[key]) if key in part else "-" for key in COLUMNS),
        ]
        for name, part in entry["parts"].items()
    ]
    return {
        "name": ": ".join(filter(None, (entry["name"], entry.get("message")))),
        "verdict": entry["quality"],
        "color": colours.css(colours.VERDICTS[entry["quality"]]),
        "reason": reason,
        "rows": _table(["part", "found", *COLUMNS.values()], rows),
    }


def _baselines(report: dict[str, Any]) -> str:
    from tumortrack.report.summary import BASELINES

    meaning = report["baselines"]
    if "not_available" in meaning:
        return str(meaning["not_available"])
    sentences = [f"{BASELINES[name].capitalize()}: {meaning[name]}." for name in BASELINES]
    missing = {
        entry["name"]: baseline["not_available"]
        for entry in report["scenes"]
        for baseline in entry["baselines"].values()
        if "not_available" in baseline
    }
    return " ".join([*sentences, *(f"Not available of {n}: {why}." for n, why in missing.items())])


# --- of a run of `locate` ---


def write_run_page(
    folder: Path, report: dict[str, Any], estimate: Estimate | None, shown: seen.Seen
) -> None:
    """Write index.html and picture.png; without an estimate, the camera's view and the reason.

    ``report``: as in report.json. Raises StorageError: the disk refused.
    """
    verdict: Quality = "none" if estimate is None else estimate.quality
    views, slices = pictures.run_panels(estimate, shown)
    reason = report["quality"]["reason"] if estimate is None else estimate.reason
    words = verdict_words(verdict, reason)
    lines = list(_lines(report, estimate))
    body = ["".join(f"<p>{escape(line)}</p>" for line in lines)]
    legend: dict[str, colours.Colour] = {}
    if estimate is not None:
        rows = seen.part_rows(estimate.report, estimate.assessment)
        lines += map(seen.row_words, rows)
        legend = {name: colours.structure_colour(n) for n, name in enumerate(estimate.structures)}
        dots = [colours.css(colours.name_colour(row["part"])) for row in rows]
        dots += map(colours.css, legend.values())
        cells = [[*row.values()] for row in rows] + [[name, "", "", ""] for name in legend]
        cells = [[first.replace("_", " "), *others] for first, *others in cells]
        body.insert(0, _table(["part", "centre (x, y, z)", "bound", "volume"], cells, dots))
    body = [_section("", *body)]
    if estimate is not None and estimate.report.evidence:
        known = [
            [
                f"{each.name} {number}", each.tool, f"{each.off_mm:.1f} mm",
                f"{100 * each.information_gain:.0f} %",
                "left out: it contradicts the rest" if each.rejected else "",
            ]
            for number, each in enumerate(estimate.report.evidence, start=1)
        ]  # fmt: skip
        body.append(_section("", _table(["evidence", "tool", "off", "new", ""], known)))
    body += map(_figures, (views, slices))
    banner = colours.VERDICTS[verdict]
    rows_of_panels = [views, *pictures.in_fours(slices)]
    path = folder / seen.PICTURE
    pictures.write_sheet(path, [(words, banner)], lines, legend, rows_of_panels, width=2200)
    title = {"good": "GOOD", "poor": "POOR", "none": "NONE: no estimate"}[verdict]
    _write(folder / seen.PAGE, title, _sentence(words.partition(": ")[2]), body, banner)


def _lines(report: dict[str, Any], estimate: Estimate | None) -> Iterator[str]:
    patient = _sentence(str(patient_in(report.get("patient"), "report")))
    frame = report.get("frame", CAMERA)
    axes = "Camera frame: x right, y down, z away" if frame == CAMERA else f"Frame: {frame}"
    yield f"{patient}. {axes}."
    if estimate is not None and estimate.assessment.factor != 1.0:
        yield f"{_sentence(estimate.assessment.factor_words)}."
    yield from (view["message"] for view in report.get("input", ()))
    yield from (f"Note: {note}" for note in report.get("notes", ()))
    if estimate is not None:
        yield from map(_sentence, seen.other_lines(estimate))
        if any(seen.spots(estimate)):
            yield "Dots: white, evidence in use; red, left out; blue, the best to touch next."


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:]


def _figures(panels: Sequence[pictures.Panel]) -> str:
    figures = ""
    for caption, image in panels:
        stream = io.BytesIO()
        image.convert("RGB").save(stream, "JPEG", quality=92, subsampling=0)
        text, source = escape(caption), f"data:image/jpeg;base64,{_base64(stream.getvalue())}"
        figures += f'<figure><img alt="{text}" src="{source}">'
        figures += f"<figcaption>{text}</figcaption></figure>"
    return f'<section class="panels">{figures}</section>' if panels else ""
