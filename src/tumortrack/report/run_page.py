"""Picture and self-contained page of a run of `locate`.

Without matplotlib, whose import would take as long as drawing both.
"""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from tumortrack.core import colours
from tumortrack.core.assessment import Quality
from tumortrack.core.estimate import Estimate, verdict_words
from tumortrack.core.evidence import CAMERA
from tumortrack.core.geometry import transform_points
from tumortrack.core.organ import is_tumor
from tumortrack.core.patient import patient_in
from tumortrack.core.process import parallel_map
from tumortrack.core.report import Point
from tumortrack.core.store import write_atomically
from tumortrack.core.types import DepthFrame, Mesh, SensorCloud
from tumortrack.report.renderer import Body, ParallelView, corner_normals, render, rgb
from tumortrack.report.seen import (
    PAGE,
    Seen,
    alternative_lines,
    next_evidence,
    next_lines,
    part_rows,
    row_words,
)
from tumortrack.report.wrapping import wrapped
from tumortrack.sense.camera import deproject
from tumortrack.sense.region.working_image import ORGAN, sampled_pixels
from tumortrack.tracking.slices import ORIENTATIONS, outlined, plane_through

PICTURE = "picture.png"
_VIEW_WIDTH, _ASPECT = 512, 1.25  # pixels
_SLICE = 480  # pixels
_ROW_HEIGHT, _PICTURE_WIDTH, _BORDER = 375, 2200, 24  # pixels
_RLE = 3  # zlib's strategy: compresses flat colours as well as the default, in less time
_MOST_POINTS = 6000
_MOST_TUMORS = 6  # with slices
_NEAR_MM = 1.0  # points this near to a slice are shown in it
_BAR_MM = 20.0
_TITLES = {"good": "GOOD", "poor": "POOR", "none": "NONE: no estimate"}
_TABLE_TITLES = {"part": "", "centre": "centre (x, y, z)", "bound": "bound"}
Panel = tuple[str, Image.Image]  # with its caption


def write_run_page(
    folder: Path, report: dict[str, Any], estimate: Estimate | None, seen: Seen
) -> None:
    """Write index.html and picture.png; without an estimate, the camera's view and the reason.

    ``report``: as in report.json. Raises StorageError: the disk refused.
    """
    verdict: Quality = "none" if estimate is None else estimate.quality
    views = list(_views(estimate, seen))
    slices = [] if estimate is None else list(_slices(estimate, seen))
    reason = report["quality"]["reason"] if estimate is None else estimate.reason
    words = verdict_words(verdict, reason)
    rows = [] if estimate is None else part_rows(estimate.report, estimate.assessment)
    known = [] if estimate is None else _evidence_rows(estimate)
    lines = list(_lines(report, estimate))
    picture = _picture(verdict, [words, *lines, *map(row_words, rows)], views + slices)
    png = _encoded(picture, "PNG", compress_level=1, compress_type=_RLE)
    write_atomically(folder / PICTURE, png)
    page = resources.files("tumortrack.report").joinpath("run_page.html").read_text("utf-8")
    cells = {
        "@COLOUR@": colours.css(colours.VERDICTS[verdict]),
        "@TEXT@": colours.css(_text_colour(verdict)),
        "@VERDICT@": _TITLES[verdict],
        "@WORDS@": html.escape(_sentence(words.partition(": ")[2])),
        "@LINES@": "".join(f"<p>{html.escape(line)}</p>" for line in lines),
        "@TABLE@": (_table(rows) if rows else "") + _legend(estimate),
        "@EVIDENCE@": f"<section>{_table(known)}</section>" if known else "",
        "@PANELS@": _figures(views) + _figures(slices),
    }
    page = re.sub("@[A-Z]+@", lambda name: cells[name[0]], page)
    write_atomically(folder / PAGE, page.encode())


def _figures(panels: list[Panel]) -> str:
    figures = ""
    for caption, image in panels:
        text, jpeg = html.escape(caption), _encoded(image, "JPEG", quality=92, subsampling=0)
        source = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
        figures += f'<figure><img alt="{text}" src="{source}">'
        figures += f"<figcaption>{text}</figcaption></figure>"
    return f'<section class="panels">{figures}</section>' if panels else ""


def _lines(report: dict[str, Any], estimate: Estimate | None) -> Iterator[str]:
    patient = _sentence(str(patient_in(report.get("patient"), "report")))
    frame = report.get("frame", CAMERA)
    axes = "Camera frame: x right, y down, z away" if frame == CAMERA else f"Frame: {frame}"
    yield f"{patient}. {axes}."
    if estimate is not None and estimate.assessment.factor != 1.0:
        yield f"{_sentence(estimate.assessment.factor_words)}."
    yield from (view["words"] for view in report.get("input", ()))
    yield from (f"Note: {note}" for note in report.get("notes", ()))
    yield from map(_sentence, (*alternative_lines(estimate), *next_lines(estimate)))
    if estimate is not None and any(_spots(estimate)):
        yield "Dots: white, evidence in use; red, left out; blue, the best places to touch next."


def _sentence(words: str) -> str:
    return words[:1].upper() + words[1:]


def _evidence_rows(estimate: Estimate) -> list[dict[str, str]]:
    return [
        {
            "evidence": f"{each.name} {number}",
            "tool": each.tool,
            "off": f"{each.off_mm:.1f} mm",
            "news": f"{100 * each.news:.0f} %",
            "": "left out: it contradicts the rest" if each.left_out else "",
        }
        for number, each in enumerate(estimate.report.evidence, start=1)
    ]


def _table(rows: list[dict[str, str]]) -> str:
    """The first column names the rows; those of parts have their colours."""
    titles = {key: _TABLE_TITLES.get(key, key) for key in rows[0] if any(row[key] for row in rows)}
    head = "".join(f"<th>{title}</th>" for title in titles.values())
    (first, _), *others = titles.items()
    body = ""
    for number, row in enumerate(rows, start=1):
        dot = f'<i style="background:{colours.css(colours.part_colour(number))}"></i>'
        name = html.escape(row[first].replace("_", " "))
        body += f"<tr><th>{dot if first == 'part' else ''}{name}</th>" + "".join(
            f'<td data-title="{title}">{html.escape(row[key])}</td>' for key, title in others
        )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _structures(estimate: Estimate | None) -> list[tuple[str, Mesh, colours.Colour]]:
    """Name, surface and colour of each."""
    known = () if estimate is None else estimate.structures.items()
    return [(name, mesh, colours.structure_colour(n)) for n, (name, mesh) in enumerate(known)]


def _legend(estimate: Estimate | None) -> str:
    return "".join(
        f'<p><i style="background:{colours.css(colour)}"></i>{html.escape(name)}</p>'
        for name, _, colour in _structures(estimate)
    )


def _views(estimate: Estimate | None, seen: Seen) -> Iterator[Panel]:
    if isinstance(seen.content, DepthFrame):
        taken = "; tinted: taken for the organ" if seen.taken is not None else ""
        size = f"{seen.content.intrinsics.width} x {seen.content.intrinsics.height} pixels"
        yield (
            f"depth image, {size}, near is bright{taken}",
            _depth_picture(seen.content, seen.taken),
        )
    points_mm = _thinned(seen.cloud if estimate and seen.cloud else seen.content)
    if estimate is None and not len(points_mm):
        return
    parts = () if estimate is None else estimate.meshes.values()
    for mesh in (*parts, *(mesh for _, mesh, _ in _structures(estimate))):
        corner_normals(mesh)  # kept, for all views
    views = [ParallelView(name, *axes) for name, axes in ORIENTATIONS.items()]  # type: ignore[arg-type]
    images = parallel_map(lambda view: _view(view, estimate, points_mm), views)
    yield from zip(ORIENTATIONS, images, strict=True)


def _slices(estimate: Estimate, seen: Seen) -> Iterator[Panel]:
    """Two through each tumor."""
    of_ct = seen.ct is not None and estimate.motion is not None
    what = "CT at its present place" if of_ct else "section"
    tumors = [name for name in estimate.meshes if is_tumor(name)][:_MOST_TUMORS]
    planes = [(part, way) for part in tumors for way in list(ORIENTATIONS)[:2]]
    images = parallel_map(lambda plane: _slice(estimate, seen, *plane), planes)
    for (part, way), image in zip(planes, images, strict=True):
        yield f"{part.replace('_', ' ')}: {what}, {way}", image


def _thinned(content: DepthFrame | SensorCloud | None) -> Float[np.ndarray, "n 3"]:
    """Some of its points, without outliers."""
    if content is None:
        return np.zeros((0, 3))
    all_mm = content.points_mm if isinstance(content, SensorCloud) else deproject(content)
    some = all_mm[:: len(all_mm) // _MOST_POINTS + 1].astype(float)
    if not len(some):
        return some
    low, high = np.quantile(some, (0.01, 0.99), axis=0)
    room = 0.2 * (high - low) + 1
    return some[((some >= low - room) & (some <= high + room)).all(axis=1)]


def _view(
    view: ParallelView, estimate: Estimate | None, points_mm: Float[np.ndarray, "n 3"]
) -> Image.Image:
    """Surfaces (the organ translucent), and points over them."""
    meshes = {} if estimate is None else estimate.meshes
    shown = [points_mm, *(mesh.vertices_mm for mesh in meshes.values())]
    frame = view.frame_around(np.concatenate(shown), 6.0).widened(_ASPECT)
    pixel_mm = frame.width_mm / _VIEW_WIDTH
    bodies = [
        Body(mesh, rgb(colours.name_colour(name)), 1.0 if is_tumor(name) else 0.36)
        for name, mesh in meshes.items()
    ]
    bodies += [Body(mesh, rgb(colour)) for _, mesh, colour in _structures(estimate)]
    width, height = frame.size(pixel_mm)
    picture = np.full((height, width, 3), 255, np.uint8)
    if bodies:
        picture = render(bodies, view.viewpoint(frame, pixel_mm), (width, height)).copy()
    corner = np.array([frame.left, frame.top])
    _dots(picture, (view.project(points_mm)[:, :2] - corner) / pixel_mm, colours.SEEN)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    style: dict[str, Any] = {"anchor": "mm", "font_size": 22, "stroke_width": 3}
    for name, mesh in meshes.items():
        if is_tumor(name):
            at = (view.project(mesh.box_mm.mean(0)[None])[0, :2] - corner) / pixel_mm
            number = name.removeprefix("tumor_")
            draw.text(tuple(at.tolist()), number, "black", stroke_fill="white", **style)
    for place_mm, colour in () if estimate is None else _spots(estimate):
        x, y = (view.project(np.array([place_mm]))[0, :2] - corner) / pixel_mm
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour, outline="black")
    foot, long = height - 20, _BAR_MM / pixel_mm
    draw.line((20, foot, 20 + long, foot), fill="black", width=4)
    draw.text((20, foot - 22), f"{_BAR_MM:g} mm", fill="black", font_size=15)
    return image


def _spots(estimate: Estimate) -> Iterator[tuple[Point, colours.Colour]]:
    """Where evidence lies, and where to touch next."""
    for each in estimate.report.evidence:
        colour = colours.NONE if each.left_out else colours.WHITE
        yield from ((place_mm, colour) for place_mm in each.places_mm)
    touches = (each for each in next_evidence(estimate) if each.kind == "touch")
    yield from ((each.place_mm, colours.TO_CUT) for each in touches)


def _slice(estimate: Estimate, seen: Seen, part: str, orientation: str) -> Image.Image:
    """The CT moved to the organ, or else the labels, through a part's centre, with outlines."""
    plane = plane_through(estimate.meshes, part, orientation)
    assert plane is not None  # there is an organ, and this part
    half = _SLICE // 2
    places_mm, back = plane.points(half), None
    if seen.ct is not None and estimate.motion is not None:
        back = estimate.motion.back(places_mm)
    if seen.ct is not None and back is not None:
        picture = seen.ct.picture(back)
    else:
        picture = _labelled(estimate, places_mm)
    lines = [(mesh, colours.name_colour(name), 3) for name, mesh in estimate.meshes.items()]
    lines += [(mesh, colour, 2) for _, mesh, colour in _structures(estimate)]
    image = outlined(picture.reshape(half, half, 3), plane, lines, _SLICE).copy()
    if seen.cloud is not None:
        away = seen.cloud.points_mm.astype(float) - plane.centre_mm
        near = away[np.abs(away @ np.cross(plane.across, plane.down)) < _NEAR_MM]
        flat = near @ np.stack([plane.across, plane.down], axis=1)
        _dots(image, (flat / plane.side_mm + 0.5) * _SLICE, (255, 255, 255))
    return Image.fromarray(image)


def _labelled(estimate: Estimate, places_mm: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Dim colours of the labels at places in the camera frame; dark outside."""
    picture = np.full((len(places_mm), 3), 20, np.uint8)
    if (volume := estimate.volume) is not None:
        at = np.rint(transform_points(np.linalg.inv(volume.camera_from_index), places_mm))
        inside = ((at >= 0) & (at < volume.labels.shape)).all(axis=1)
        labels = volume.labels[tuple(at[inside].astype(int).T)]
        tints = colours.label_colours(labels) // 2
        picture[inside] = np.where(labels[:, None] > 0, tints, np.uint8(20))
    return picture


def _depth_picture(frame: DepthFrame, taken: UInt8[np.ndarray, "h w"] | None) -> Image.Image:
    """Near is bright, no return is black; what was ``taken`` for the organ has its colour."""
    depth_mm = frame.depth_mm if taken is None else frame.depth_mm[sampled_pixels(frame)]
    (height, width), known = depth_mm.shape, np.isfinite(depth_mm)
    grey = np.zeros((height, width))
    if known.any():
        low, high = np.quantile(depth_mm[known], (0.01, 0.95))
        share = np.clip((depth_mm[known] - low) / max(high - low, 1.0), 0, 1)
        grey[known] = 235 - 190 * share
    picture: np.ndarray = np.repeat(grey[..., None], 3, axis=2)
    if taken is not None:
        organ = known & (taken == ORGAN)
        picture[organ] = 0.5 * picture[organ] + 0.5 * np.array(colours.part_colour(1))
    image = Image.fromarray(picture.astype(np.uint8))
    return image.resize((_VIEW_WIDTH, round(_VIEW_WIDTH * image.height / image.width)))


def _dots(picture: np.ndarray, places: Float[np.ndarray, "n 2"], colour: colours.Colour) -> None:
    """Paint dots of 2 x 2 pixels at (column, row)."""
    height, width = picture.shape[:2]
    for right in (0, 1):
        for down in (0, 1):
            column, row = (np.floor(places).astype(int) + (right, down)).T
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            picture[row[inside], column[inside]] = colour


def _picture(verdict: Quality, lines: list[str], panels: list[Panel]) -> Image.Image:
    """Verdict, lines of text, and the panels in rows; no line is cut."""
    room = _PICTURE_WIDTH - 2 * _BORDER
    head = _lines_of(lines[0], 36, room)
    below = [row for line in lines[1:] for row in _lines_of(line, 24, room)]
    images = [
        (caption, image.resize((round(image.width * _ROW_HEIGHT / image.height), _ROW_HEIGHT)))
        for caption, image in panels
    ]
    places, x, y = [], _BORDER, 60 + 46 * len(head) + 32 * len(below)
    for _, image in images:
        if x > _BORDER and x + image.width > _PICTURE_WIDTH - _BORDER:
            x, y = _BORDER, y + _ROW_HEIGHT + 64
        places.append((x, y))
        x += image.width + 16
    picture = Image.new("RGB", (_PICTURE_WIDTH, y + (_ROW_HEIGHT + 64 if images else 0)), "white")
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, 0, _PICTURE_WIDTH, 32 + 46 * len(head)), fill=colours.VERDICTS[verdict])
    for n, row in enumerate(head):
        draw.text((_BORDER, 14 + 46 * n), row, fill=_text_colour(verdict), font_size=36)
    for n, row in enumerate(below):
        draw.text((_BORDER, 44 + 46 * len(head) + 32 * n), row, fill="black", font_size=24)
    for (caption, image), (left, top) in zip(images, places, strict=True):
        picture.paste(image, (left, top))
        for n, row in enumerate(_lines_of(caption, 20, image.width)):
            draw.text((left, top + _ROW_HEIGHT + 4 + 26 * n), row, fill="black", font_size=20)
    return picture


def _lines_of(text: str, size: int, room: float) -> list[str]:
    return wrapped(text, room, ImageFont.load_default(size).getlength)


def _text_colour(verdict: Quality) -> colours.Colour:
    """White, or near black where white could not be read on the verdict's colour."""
    red, green, blue = colours.VERDICTS[verdict]
    return (20, 20, 20) if 0.3 * red + 0.6 * green + 0.1 * blue > 130 else (255, 255, 255)


def _encoded(image: Image.Image, kind: str, **how: int) -> bytes:
    stream = io.BytesIO()
    image.save(stream, format=kind, **how)
    return stream.getvalue()
