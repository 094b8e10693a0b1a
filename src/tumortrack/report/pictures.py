"""Pictures without a display: surfaces, slices, and sheets of them under words.

Every part has its own colour (core/colours.py); the truth is outlined. Drawn by Pillow: to import
matplotlib takes as long as to locate.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from tumortrack.core import colours
from tumortrack.core.camera import deproject
from tumortrack.core.colours import Colour, name_colour, structure_colour
from tumortrack.core.estimate import Estimate, verdict_words
from tumortrack.core.geometry import DIRECTIONS_LPS, Points, transform_points
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import is_tumor
from tumortrack.core.process import parallel_map
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Anatomy, DepthFrame, LabelVolume, Mesh, SensorCloud, Volume
from tumortrack.report.renderer import Body, ParallelView, corner_normals, render, rgb
from tumortrack.report.seen import Seen, spots
from tumortrack.report.slices import ORIENTATIONS, SlicePlane, outlined, plane_through
from tumortrack.report.wrapping import wrapped
from tumortrack.segmentation.working_image import ORGAN, sampled_pixels

if TYPE_CHECKING:
    from tumortrack.io.scene_folder import Scene

Panel = tuple[str, Image.Image]  # with its caption
Plane = tuple[tuple[float, ...], tuple[float, ...]]  # directions of columns and rows
# A case's slices in LPS. Radiological convention: the patient's right is on the picture's left
# (axial seen from the feet, coronal from the front); sagittal with anterior on the left.
PLANES: dict[str, Plane] = {
    "axial": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "coronal": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "sagittal": ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
}
_SIDES = {"coronal": "the front", "sagittal": "the left", "axial": "the feet"}
_SOFT_TISSUE_HU = (-160.0, 240.0)
_SLICE, _EDGE, _GAP = 480, 24, 16  # pixels
_GROUND, _INK = 20, (20, 20, 20)
_RLE = 3  # zlib's strategy: compresses flat colours as well as the default, in less time
_MOST_POINTS = 6000
_MOST_TUMORS = 6  # with slices
_NEAR_MM = 1.0  # points this near to a slice are shown in it
_BAR_MM = 20.0
_OPACITY = 0.36  # of the organ


# --- sheets ---


def in_fours(panels: Sequence[Panel]) -> list[Sequence[Panel]]:
    return [panels[n : n + 4] for n in range(0, len(panels), 4)]


def write_sheet(
    path: Path,
    banners: Sequence[tuple[str, Colour]],
    lines: Iterable[str],
    legend: Mapping[str, Colour],
    rows: Iterable[Sequence[Panel]],
    width: int = 1600,
) -> None:
    """Write a PNG, atomically: words on their colour, words on white, a legend, and panels. No word
    is cut. Raises StorageError: the disk refused."""
    blocks = [_words(text, width, 30, colour) for text, colour in banners]
    blocks += [_words(line, width, 22) for line in lines]
    blocks += [_legend(legend, width)] if legend else []
    blocks += [_row(row, width) for row in rows if row]
    tops = np.cumsum([0, *(block.height for block in blocks)]).tolist()
    picture = Image.new("RGB", (width, tops[-1] + _GAP), "white")
    for block, top in zip(blocks, tops, strict=False):
        picture.paste(block, (0, top))
    stream = io.BytesIO()
    picture.save(stream, "PNG", compress_level=1, compress_type=_RLE)
    write_atomically(path, stream.getvalue())


def ink_on(colour: Colour) -> Colour:
    """White, or near black where white could not be read on the colour."""
    red, green, blue = colour
    return _INK if 0.3 * red + 0.6 * green + 0.1 * blue > 130 else (255, 255, 255)


def _words(text: str, width: int, size: int, paper: Colour = colours.WHITE) -> Image.Image:
    lines = wrapped(text, width - 2 * _EDGE, ImageFont.load_default(size).getlength)
    step = round(1.3 * size)
    block = Image.new("RGB", (width, step * len(lines) + size // 2), paper)
    draw = ImageDraw.Draw(block)
    for n, line in enumerate(lines):
        at = _EDGE, size // 4 + step * n
        draw.text(at, line, fill=ink_on(paper), font_size=size)
    return block


def _legend(entries: Mapping[str, Colour], width: int) -> Image.Image:
    length, places, x, y = ImageFont.load_default(20).getlength, [], _EDGE, 8
    for name in entries:
        if x > _EDGE and x + 30 + length(name) > width - _EDGE:
            x, y = _EDGE, y + 30
        places.append((x, y))
        x += 56 + round(length(name))
    block = Image.new("RGB", (width, y + 34), "white")
    draw = ImageDraw.Draw(block)
    for (name, colour), (x, y) in zip(entries.items(), places, strict=True):
        draw.rectangle((x, y + 3, x + 22, y + 18), fill=colour, outline=_INK)
        draw.text((x + 30, y), name, fill=_INK, font_size=20)
    return block


def _row(panels: Sequence[Panel], width: int) -> Image.Image:
    """As wide as the sheet, but none of few is larger than its picture; captions below."""
    room = width - 2 * _EDGE - _GAP * (len(panels) - 1)
    height = round(room / sum(image.width / image.height for _, image in panels))
    height = min(height, *(image.height for _, image in panels), height)
    images = [
        image.resize((round(image.width * height / image.height), height)) for _, image in panels
    ]
    length = ImageFont.load_default(20).getlength
    captions = [
        wrapped(caption, image.width, length)
        for (caption, _), image in zip(panels, images, strict=True)
    ]
    block = Image.new("RGB", (width, height + 24 + 26 * max(map(len, captions))), "white")
    draw, x = ImageDraw.Draw(block), _EDGE
    for image, lines in zip(images, captions, strict=True):
        block.paste(image, (x, 8))
        for n, line in enumerate(lines):
            draw.text((x, height + 12 + 26 * n), line, fill=_INK, font_size=20)
        x += image.width + _GAP
    return block


# --- panels ---


def solid(
    plane: Plane,
    meshes: Mapping[str, Mesh],
    points_mm: Points,
    *,
    structures: Mapping[str, Mesh] | None = None,
    truth: Sequence[Mesh] = (),
    marks: Iterable[tuple[Sequence[float], Colour]] = (),
    aspect: float = 1.25,
) -> Image.Image:
    """Surfaces seen along a plane's normal (the organ translucent), the truth's outlines, points
    over them, and marked places."""
    view = ParallelView("", *plane)  # type: ignore[arg-type]  # three numbers
    shown = [points_mm, *(mesh.vertices_mm for mesh in (*meshes.values(), *truth))]
    frame = view.frame_around(np.concatenate(shown), 6.0).widened(aspect)
    pixel_mm = (frame.bottom - frame.top) / 440
    bodies = [
        Body(mesh, rgb(name_colour(name)), 1.0 if is_tumor(name) else _OPACITY)
        for name, mesh in meshes.items()
    ]
    bodies += [
        Body(mesh, rgb(structure_colour(n))) for n, mesh in enumerate((structures or {}).values())
    ]
    width, height = frame.size(pixel_mm)
    picture = render(bodies, view.viewpoint(frame, pixel_mm), (width, height)).copy()

    def place(points_mm: Points) -> Float[np.ndarray, "n 2"]:
        return (view.project(points_mm)[:, :2] - (frame.left, frame.top)) / pixel_mm

    _dots(picture, place(points_mm), colours.SEEN)
    for mesh in truth:
        inside = Image.fromarray(np.isfinite(view.depth_of(mesh, frame, pixel_mm)))
        inner = inside.convert("L").filter(ImageFilter.MinFilter(5))
        picture[np.asarray(inside) & ~(np.asarray(inner) > 0)] = colours.TRUTH
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    style: dict[str, Any] = {"anchor": "mm", "font_size": 22, "stroke_width": 3}
    for name, mesh in meshes.items():
        if is_tumor(name):
            ((x, y),) = place(mesh.box_mm.mean(0)[None]).tolist()
            number = name.removeprefix("tumor_")
            draw.text((x, y), number, "black", stroke_fill="white", **style)
    for place_mm, colour in marks:
        ((x, y),) = place(np.array([place_mm])).tolist()
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=colour, outline="black")
    foot, long = height - 20, _BAR_MM / pixel_mm
    draw.line((20, foot, 20 + long, foot), fill="black", width=4)
    draw.text((20, foot - 22), f"{_BAR_MM:g} mm", fill="black", font_size=15)
    return image


def _section(
    plane: SlicePlane,
    ground: UInt8[np.ndarray, "n 3"] | None,
    meshes: Mapping[str, Mesh],
    structures: Mapping[str, Mesh],
    truth: Sequence[Mesh] = (),
    cloud: SensorCloud | None = None,
) -> Image.Image:
    """Outlines of parts (in their colours) and of the truth (white), and near points, over a
    picture of half as many pixels; None: what is inside the parts is tinted."""
    half = _SLICE // 2
    if ground is None:
        places_mm = plane.points(half)
        ground = np.full((len(places_mm), 3), _GROUND, np.uint8)
        for name, mesh in meshes.items():  # tumors come later, and win
            ground[contains(mesh, places_mm)] = np.array(name_colour(name)) // 2
    lines = [(mesh, name_colour(name), 3) for name, mesh in meshes.items()]
    lines += [(mesh, structure_colour(n), 2) for n, mesh in enumerate(structures.values())]
    lines += [(mesh, colours.WHITE, 2) for mesh in truth]
    image = outlined(ground.reshape(half, half, 3), plane, lines, _SLICE).copy()
    if cloud is not None:
        away = cloud.points_mm.astype(float) - plane.centre_mm
        near = away[np.abs(away @ np.cross(plane.across, plane.down)) < _NEAR_MM]
        flat = near @ np.stack([plane.across, plane.down], axis=1)
        _dots(image, (flat / plane.side_mm + 0.5) * _SLICE, colours.ORGAN)
    return Image.fromarray(image)


def depth_picture(
    frame: DepthFrame, pixel_class: UInt8[np.ndarray, "h w"] | None = None
) -> Image.Image:
    """Near is bright, no return is black; what was taken for the organ has its colour."""
    depth_mm = frame.depth_mm if pixel_class is None else frame.depth_mm[sampled_pixels(frame)]
    (height, width), known = depth_mm.shape, np.isfinite(depth_mm)
    grey = np.zeros((height, width))
    if known.any():
        low, high = np.quantile(depth_mm[known], (0.01, 0.95))
        grey[known] = 235 - 190 * np.clip((depth_mm[known] - low) / max(high - low, 1.0), 0, 1)
    picture: np.ndarray = np.repeat(grey[..., None], 3, axis=2)
    if pixel_class is not None:
        organ = known & (pixel_class == ORGAN)
        picture[organ] = 0.5 * picture[organ] + 0.5 * np.array(colours.part_colour(1))
    image = Image.fromarray(picture.astype(np.uint8))
    return image.resize((round(440 * width / height), 440))


def _dots(picture: np.ndarray, places: Float[np.ndarray, "n 2"], colour: Colour) -> None:
    """Paint dots of 2 x 2 pixels at (column, row)."""
    height, width = picture.shape[:2]
    for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = (np.floor(places).astype(int) + shift).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        picture[row[inside], column[inside]] = colour


# --- of a run of `locate` ---


def run_panels(estimate: Estimate | None, seen: Seen) -> tuple[list[Panel], list[Panel]]:
    """What the camera saw and the surfaces from three sides; and two slices through each tumor."""
    views, slices = list[Panel](), list[Panel]()
    if isinstance(seen.content, DepthFrame):
        tint = "; tinted: taken for the organ" if seen.pixel_class is not None else ""
        size = f"{seen.content.intrinsics.width} x {seen.content.intrinsics.height} pixels"
        caption = f"depth image, {size}, near is bright{tint}"
        views.append((caption, depth_picture(seen.content, seen.pixel_class)))
    points_mm = _thinned(seen.cloud if estimate and seen.cloud else seen.content)
    meshes, structures = ({}, {}) if estimate is None else (estimate.meshes, estimate.structures)
    for mesh in (*meshes.values(), *structures.values()):
        corner_normals(mesh)  # kept, for all views
    if meshes or len(points_mm):
        marks = [] if estimate is None else list(spots(estimate))
        images = parallel_map(
            lambda plane: solid(plane, meshes, points_mm, structures=structures, marks=marks),
            list(ORIENTATIONS.values()),
        )
        views += zip(ORIENTATIONS, images, strict=True)
    if estimate is None:
        return views, slices
    of_ct = seen.ct is not None and estimate.motion is not None
    what = "CT at its present place" if of_ct else "section"
    tumors = [name for name in meshes if is_tumor(name)][:_MOST_TUMORS]
    planes = [(part, way) for part in tumors for way in list(ORIENTATIONS)[:2]]
    images = parallel_map(lambda plane: _slice(estimate, seen, *plane), planes)
    for (part, way), image in zip(planes, images, strict=True):
        slices.append((f"{part.replace('_', ' ')}: {what}, {way}", image))
    return views, slices


def _slice(estimate: Estimate, seen: Seen, part: str, way: str) -> Image.Image:
    plane = plane_through(estimate.meshes, part, way)
    assert plane is not None  # an estimate with that part, and its organ
    ground = None
    if seen.ct is not None and estimate.motion is not None:
        back = estimate.motion.inverse(plane.points(_SLICE // 2))
        ground = None if back is None else seen.ct.picture(back)
    return _section(plane, ground, estimate.meshes, estimate.structures, cloud=seen.cloud)


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


# --- of a scene of an evaluation ---


def scene_views(scene: Scene, meshes: Mapping[str, Mesh]) -> list[Panel]:
    """The estimate's surfaces, the truth's outlines and the observed points."""
    points_mm, truth = scene.cloud.points_mm.astype(float), scene.reference.parts
    return [
        (way, solid(ORIENTATIONS[way], meshes, points_mm, truth=truth, aspect=1.7))
        for way in list(ORIENTATIONS)[:2]
    ]


def scene_picture(
    scene: Scene, shown: Mapping[str, Mesh], entry: dict[str, Any], path: Path
) -> None:
    """Write a PNG: the estimate's meshes over the truth in two views, and in two slices through
    each true tumor. ``entry``: of the scene in the report."""
    from tumortrack.report.summary import scene_note, words

    slices = []
    for name, mesh in list(zip(scene.reference.names, scene.reference.parts, strict=True))[1:]:
        part = entry["parts"][name]
        off = f"centre {part['center_mm']:.1f} mm off" if part["found"] else "not found"
        for way in list(ORIENTATIONS)[:2]:
            side_mm = mesh.longest_mm + 24.0
            across, down = np.array(ORIENTATIONS[way])
            plane = SlicePlane(mesh.box_mm.mean(0), across, down, side_mm)
            image = _section(plane, None, shown, {}, scene.reference.parts, scene.cloud)
            slices.append((f"{words(name)}: {way}; {off}", image))
    verdict, failed = entry["quality"], entry["failed"]
    said = f"{entry['name']}: {verdict_words(verdict, entry['reason'])}"
    banners = [(said, colours.VERDICTS[verdict])]
    if failed is not None and verdict != "none":  # else it is the reason
        banners.insert(0, (f"FAILED: {failed}", colours.NONE))
    legend = {f"{words(name)}, estimated": name_colour(name) for name in shown}
    legend |= {
        "truth (outline; white in slices)": colours.TRUTH,
        "observed points": colours.SEEN,
    }
    rows = [scene_views(scene, shown), *in_fours(slices)]
    write_sheet(path, banners, [scene_note(entry)], legend, rows)


# --- of a prepared case ---


def qc_picture(
    case_labels: LabelVolume,
    ct: Volume | None,
    anatomy: Anatomy,
    path: Path,
    patient: str = "",
    warnings: Sequence[str] = (),
) -> None:
    """Write a PNG: orthogonal slices with outlines and a 3-D view in a row for each tumor: is
    everything outlined, and on the right side?

    All in the patient's frame (LPS, mm). Without a CT the labels are shown in grey. Of more than
    six tumors the six largest have rows.
    """
    parts = dict(zip(anatomy.names, anatomy.parts, strict=True))
    tumors = sorted(list(parts)[1:], key=lambda name: -abs(parts[name].volume_mm3))
    largest = [name for name in parts if name in tumors[:_MOST_TUMORS]]
    shown: LabelVolume | Volume = ct if ct is not None else case_labels
    window, rows = _window(shown, anatomy), list[list[Panel]]()
    for name in largest or anatomy.names[:1]:
        row = []
        for way, plane in PLANES.items():
            through_mm = in_voxels(parts[name].box_mm.mean(0), shown.lps_from_index)
            axis = int(np.argmax(np.abs(np.cross(*plane))))
            letter = ("LPS" if through_mm[axis] >= 0 else "RAI")[axis]
            caption = f"{name.replace('_', ' ')}: {way}, {letter} {abs(through_mm[axis]):.1f} mm"
            row.append((caption, _ct_slice(shown, window, anatomy, plane, through_mm)))
        way, side = list(_SIDES.items())[len(rows) % len(_SIDES)]
        view = solid(
            PLANES[way], parts, np.zeros((0, 3)), structures=anatomy.structures, aspect=1.0
        )
        row.append((f"3-D, seen from {side}", _lettered(view, PLANES[way], "black")))
        rows.append(row)
    dropped = len(tumors) > len(largest)
    note = f" (slices of the {_MOST_TUMORS} largest of {len(tumors)} tumors)" if dropped else ""
    title = f"Prepared case over its {'label map' if ct is None else 'CT'}{note}"
    banners = [(f"WARNING: {text}", colours.NONE) for text in warnings]
    legend = {
        f"{name.replace('_', ' ')} {part.volume_ml:.1f} ml": name_colour(name)
        for name, part in parts.items()
    }
    legend |= {
        name.replace("_", " "): structure_colour(n) for n, name in enumerate(anatomy.structures)
    }
    write_sheet(path, banners, [": ".join(filter(None, (title, patient)))], legend, rows)


def _ct_slice(
    shown: Volume | LabelVolume,
    window: tuple[float, float],
    anatomy: Anatomy,
    plane: Plane,
    through_mm: Float[np.ndarray, " 3"],
) -> Image.Image:
    """At the same scale in all planes, with the organ in the middle."""
    across, down = np.array(plane)
    normal, middle = np.cross(across, down), anatomy.organ.box_mm.mean(0)
    centre = middle + normal * (normal @ (through_mm - middle))
    square = SlicePlane(centre, across, down, anatomy.organ.longest_mm + 24.0)
    array = shown.hu if isinstance(shown, Volume) else shown.labels
    values = sampled(array, shown.lps_from_index, square.points(_SLICE // 2))
    low, high = window
    grey = np.nan_to_num(255 * np.clip((values - low) / (high - low), 0, 1)).astype(np.uint8)
    parts = dict(zip(anatomy.names, anatomy.parts, strict=True))
    image = _section(square, np.repeat(grey[:, None], 3, axis=1), parts, anatomy.structures)
    return _lettered(image, plane, "white")


def in_voxels(
    point_mm: Float[np.ndarray, " 3"], lps_from_index: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " 3"]:
    """The centre of the nearest voxel: a plane through it cuts voxels in their middle, so that the
    slice and the outlines match."""
    index = np.rint(transform_points(np.linalg.inv(lps_from_index), point_mm[None]))
    return transform_points(lps_from_index, index)[0]


def sampled(
    array: Shaped[np.ndarray, "i j k"], lps_from_index: Float[np.ndarray, "4 4"], lps_mm: Points
) -> Float[np.ndarray, " n"]:
    """A volume's values at points: of the nearest voxel, NaN outside."""
    index = np.floor(transform_points(np.linalg.inv(lps_from_index), lps_mm) + 0.5).astype(int)
    inside = ((index >= 0) & (index < array.shape)).all(1)
    values = np.full(len(index), np.nan)
    values[inside] = array[tuple(index[inside].T)]
    return values


def _window(shown: Volume | LabelVolume, anatomy: Anatomy) -> tuple[float, float]:
    """Grey range: soft tissue, extended upwards to the organ's and tumors' values."""
    if isinstance(shown, LabelVolume):
        return 0.0, float(shown.labels.max()) * 1.6 + 1e-6
    low, high = _SOFT_TISSUE_HU
    inner = np.concatenate([0.7 * p.vertices_mm + 0.3 * p.box_mm.mean(0) for p in anatomy.parts])
    values = sampled(shown.hu, shown.lps_from_index, inner)
    values = values[np.isfinite(values)]
    brightest = float(np.percentile(values, 98)) if len(values) else high
    return low, max(high, 1.15 * brightest)


def border_letters(plane: Plane) -> dict[str, str]:
    """The picture's left, right, top, bottom -> the patient's side there: L R A P S I."""
    right, down = np.array(plane)
    towards = {"right": right, "left": -right, "bottom": down, "top": -down}
    names = {tuple(np.array(v)): n[0].upper() for n, v in DIRECTIONS_LPS.items()}
    return {border: names[tuple(v)] for border, v in towards.items()}


def _lettered(image: Image.Image, plane: Plane, ink: str) -> Image.Image:
    width, height = image.size
    places = {
        **{"left": (16, height / 2), "right": (width - 16, height / 2)},
        **{"top": (width / 2, 18), "bottom": (width / 2, height - 18)},
    }
    draw = ImageDraw.Draw(image)
    for border, letter in border_letters(plane).items():
        draw.text(places[border], letter, fill=ink, anchor="mm", font_size=26)
    return image
