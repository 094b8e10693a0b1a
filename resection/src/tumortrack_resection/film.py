"""A film of what the arms do: an animated GIF, drawn without a display.

MP4 is not offered: no encoder among the Python packages comes under a permissive licence.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import shapely
from jaxtyping import Float, Float64, UInt8
from PIL import Image, ImageDraw, ImageFont
from trimesh.creation import sweep_polygon

from tumortrack.core.colours import ARMS, BACKGROUND, ENERGISED, NONE, WHITE, Colour, part_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.store import write_atomically
from tumortrack.core.types import ORGAN, Mesh
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.live.values import Polyline, TrackingResult, Workcell
from tumortrack.report.drawing import SIGN
from tumortrack.report.renderer import Body, Viewpoint, render, rgb
from tumortrack.report.wrapping import wrapped
from tumortrack_resection.facets import TOOLS
from tumortrack_resection.motions import LIFT, PULL, RELEASE, Motions
from tumortrack_resection.pictures import organ_surfaces
from tumortrack_resection.strokes import trimmed
from tumortrack_resection.values import Located, ResectionPlan, name_of

FPS = 10  # a GIF counts hundredths of a second
_FROM = np.array([-0.36, -0.8, 0.48])  # where the viewer is: to the left, in front, above
_CLOSE_FROM = np.array([-0.36, -0.72, 0.6])
_AWAY = 2.6  # the viewer's distance in radii of what is seen: a natural perspective
_CLOSE = 0.47, 0.42  # the close-up's share of width and height, in the lower right corner
_ARMS = 0.97, 0.62  # the arms' share, above it
_CLOSE_MM = 40.0  # the close-up hides what is nearer to the viewer than the organ by this
_ORGAN_OPACITY = 0.42
_FRAME = (90, 96, 106)
_BACKDROP = rgb((238, 241, 244))
_LEAST_PIXELS = 2.0  # width of a line
_COLOURS = 255  # and one for what did not change
_SAMPLES = 8  # frames from which the colours are chosen
_SHADES = 24  # rows
_SAMPLED, _EVERY = 40, 3  # the viewpoint is chosen by so many frames, and every third vertex
_LEAST_FRAMES = 2  # of a stage
_KEPT_EVERY_NS = 200_000_000  # of a live run, at first
_MOST_KEPT = 60  # moments of a stage: some 15 MB of surfaces
_LAST_S = 1.5  # the last picture stays
_PLAYBACK = "PLAYBACK of a stored plan, SIMULATED: nothing is tracked"
_CUTS = ": the electrode is energised"
_MEANING = {
    PULL: ": the holder pulls at the tumor",
    LIFT: ": the holder lifts the piece out",
    RELEASE: ": a person takes the piece from the cup",
}


class Tracked(NamedTuple):
    """What a film of a live run says of itself, and the organ's parts in each of its frames."""

    title: str
    seen: Sequence[Mapping[str, Mesh]]


def film(
    frames: Iterable[Workcell],
    located: Located,
    path: Path,
    size: tuple[int, int] = (640, 480),
    progress: Callable[[], None] = lambda: None,
    plan: ResectionPlan | None = None,
    tracked: Tracked | None = None,
) -> None:
    """Write the frames as an animated GIF that loops.

    Above every frame, never cut off: what it is; the plan's warnings; the state and why the arms
    halt; the patient. The piece moves with the holder once that lifts, and disappears after the
    release.

    The view is obliquely from the front, and contains whatever has a slash in its name (the parts
    of arms) in all frames; an inset shows the organ from near by. The same frames give the same
    bytes. Raises InputError: no frame, nothing in them, or another kind of file; StorageError: the
    disk refused.

    Args:
        frames, located: table frame, mm; ``FPS`` frames a second.
        path: ``.gif``, written atomically.
        size: of the scene without the text, pixels.
        plan: for its warnings and its piece; None: the organ stays whole.
        tracked: of a live run; None: it is a simulated playback, in which the organ lies still.
        progress: called after each frame.
    """
    if path.suffix.lower() != ".gif":
        raise InputError(f"{path}: a film is an animated GIF; give a name that ends in .gif.")
    if not (cells := list(frames)):
        raise InputError("there is no frame to film: the arms did nothing.")
    painter = _FramePainter(cells, located, size, plan, tracked)
    chosen = np.linspace(0, len(cells) - 1, min(_SAMPLES, len(cells))).astype(int).tolist()
    some = [np.asarray(painter.picture(n))[::2, ::2] for n in chosen]
    some.append(_shades(ENERGISED, some[0].shape[1]))  # too few pixels to be chosen otherwise
    sheet, plain = Image.fromarray(np.concatenate(some)), Image.Dither.NONE
    palette = sheet.quantize(_COLOURS, Image.Quantize.MEDIANCUT, kmeans=2, dither=plain)

    def indexed() -> Iterator[Image.Image]:
        for n in range(len(cells)):
            yield painter.picture(n).quantize(palette=palette, dither=plain)
            progress()

    pictures = indexed()
    each_ms = round(1000 / FPS)
    buffer = io.BytesIO()
    next(pictures).save(
        buffer,
        format="GIF",
        save_all=True,
        append_images=pictures,
        duration=[each_ms] * (len(cells) - 1) + [each_ms + round(1000 * _LAST_S)],
        loop=0,
        palette=bytes(palette.getpalette() or ()),
        transparency=_COLOURS,
        disposal=1,
        optimize=True,
    )
    write_atomically(path, buffer.getvalue())


def _shades(colour: Colour, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """From half as bright to as it is; rows of a picture."""
    row = np.outer(np.linspace(0.5, 1.0, width), colour).round().astype(np.uint8)
    return np.repeat(row[None], _SHADES, axis=0)


def moments_s(motions: Motions, frames: int) -> Float64[np.ndarray, " n"]:
    """About so many times since the beginning, the end included, that show every stage."""
    return _moments(np.array([stage.seconds for stage in motions.stages]), frames)


def _moments(lengths: np.ndarray, frames: int) -> Float64[np.ndarray, " n"]:
    """Frames go by the square root of a stage's length, as sweeps take minutes and the grasp
    seconds."""
    share = np.sqrt(lengths) / max(float(np.sqrt(lengths).sum()), 1e-9)
    counts = np.maximum(np.rint(frames * share).astype(int), _LEAST_FRAMES)
    starts = np.cumsum(lengths) - lengths
    stages = zip(starts, lengths, counts.tolist(), strict=True)
    each = [start + length * np.arange(n) / n for start, length, n in stages]
    return np.append(np.concatenate(each), lengths.sum())


class Reel:
    """A sink that keeps what a film of a live run shows, some moments of each stage. Without an
    estimate the organ is as it was seen last; before the first one nothing is kept."""

    def __init__(self) -> None:
        self._stages: list[list[tuple[Workcell, Mapping[str, Mesh]]]] = []
        self._last_ns = self._every_ns = 0

    def publish(self, result: TrackingResult) -> None:
        """Called by the sink's thread."""
        last = self._stages[-1][-1] if self._stages else None
        seen = result.transformed.meshes if result.transformed else last and last[1]
        if result.workcell is None or seen is None:
            return
        if last is None or _stage(last[0]) != _stage(result.workcell):
            self._stages.append([])
            self._every_ns = _KEPT_EVERY_NS
        elif result.stamp_ns - self._last_ns < self._every_ns:
            return
        stage, self._last_ns = self._stages[-1], result.stamp_ns
        stage.append((result.workcell, seen))
        if len(stage) > _MOST_KEPT:
            stage[:] = stage[::2]
            self._every_ns *= 2

    def close(self) -> None:
        """Nothing is open."""

    def frames(self, count: int) -> tuple[list[Workcell], list[Mapping[str, Mesh]]]:
        """About so many of every stage's. Raises InputError: nothing was tracked."""
        if not self._stages:
            raise InputError("there is nothing to film: the organ was never located.")
        kept = [moment for stage in self._stages for moment in stage]
        moments = _moments(np.array([len(stage) for stage in self._stages], float), count)
        chosen = np.unique(moments.astype(int).clip(max=len(kept) - 1)).tolist()
        return [kept[n][0] for n in chosen], [kept[n][1] for n in chosen]


def _stage(cell: Workcell) -> str:
    """The state without its note."""
    return cell.state.partition(" (")[0]


def _organ_bodies(located: Located) -> list[Body]:
    return [
        Body(mesh, rgb(part_colour(label)), _ORGAN_OPACITY if label == ORGAN else 1.0)
        for label, mesh in sorted(organ_surfaces(located).items())
    ]


class _FramePainter:
    """Draws frame by frame, with fixed viewpoints and text size."""

    def __init__(
        self, frames: list[Workcell], located: Located, size: tuple[int, int],
        plan: ResectionPlan | None, tracked: Tracked | None,
    ) -> None:  # fmt: skip
        self._frames, self._size = frames, size
        self._organ = _organ_bodies(located)
        title, seen = (_PLAYBACK, ()) if tracked is None else tracked
        self._title = title
        self._seen = [replace(located, meshes=dict(meshes)) for meshes in seen]
        self._close_size = round(_CLOSE[0] * size[0]), round(_CLOSE[1] * size[1])
        self._far = _viewpoint_of(_reach(frames), _FROM, size, _ARMS)
        organ_mm = self._organ[0].mesh.vertices_mm
        radius = float(np.linalg.norm(organ_mm - self._organ[0].mesh.box_mm.mean(0), axis=1).max())
        near = _viewpoint_of(organ_mm, _CLOSE_FROM, self._close_size)
        target = near.place_mm + near.distance_mm * near.axes[2]
        place, before_mm = target + 10 * (near.place_mm - target), radius + _CLOSE_MM
        self._near = Viewpoint.towards(target, place, near.width_mm, True, before_mm)
        flat = self._far.project(organ_mm, size)[:, :2]
        self._spot = (*(flat.min(0) - 4).round().tolist(), *(flat.max(0) + 4).round().tolist())
        self._tubes: dict[tuple[int, float], tuple[Polyline, Mesh]] = {}
        self._warnings = () if plan is None else plan.warnings
        self._patient_words = str(located.patient)
        shown = {(cell.state, cell.halted, cell.cutting): cell for cell in frames}
        self._room = max(words_strip(self._words(cell), size)[0].height for cell in shown.values())
        lifted = (n for n, cell in enumerate(frames) if _stage(cell) == LIFT)
        self._lifted_from = next(lifted, len(frames))
        self._stays, self._goes = self._organ, list[Body]()
        if plan is not None and self._lifted_from < len(frames):
            self._stays, self._goes = divided(located, plan)

    def _words(self, cell: Workcell) -> list[Paragraph]:
        """The text above a frame, most important first."""
        return [
            Paragraph(self._title, WHITE, ARMS),
            *(Paragraph(f"{SIGN} WARNING: {text}", WHITE, NONE) for text in self._warnings),
            Paragraph(cell.state + (_CUTS if cell.cutting else _MEANING.get(_stage(cell), "")),
                      BACKGROUND, large=True),
            *([Paragraph(f"halted: {cell.halted}", NONE)] if cell.halted else []),
            Paragraph(self._patient_words, BACKGROUND),
        ]  # fmt: skip

    def _bodies(self, n: int) -> list[Body]:
        """Organ, tumors and the piece, which moves with the holder."""
        if n < self._lifted_from:
            return _organ_bodies(self._seen[n]) if self._seen else self._organ
        before, now = (_holder(self._frames[k]) for k in (max(self._lifted_from - 1, 0), n))
        gone = all(_stage(cell) not in (LIFT, RELEASE) for cell in self._frames[n:])
        if gone or before is None or now is None:
            return self._stays
        moved = now @ np.linalg.inv(before)
        return [*self._stays, *(replace(body, world_from_mesh=moved) for body in self._goes)]

    def picture(self, n: int) -> Image.Image:
        """Frame n, in full colour."""
        cell = self._frames[n]
        scene = Image.fromarray(self._shown(n, self._far, self._size))
        close = Image.fromarray(self._shown(n, self._near, self._close_size))
        left, top = (whole - part - 8 for whole, part in zip(self._size, close.size, strict=True))
        top -= 10
        scene.paste(close, (left, top))
        draw = ImageDraw.Draw(scene)
        draw.rectangle(self._spot, outline=_FRAME)  # what is shown from near
        draw.rectangle((left - 1, top - 1, left + close.width, top + close.height), outline=_FRAME)
        self._draw_progress(draw, n)
        out = Image.new("RGB", (self._size[0], self._room + self._size[1]), WHITE)
        out.paste(words_strip(self._words(cell), self._size)[0], (0, 0))
        out.paste(scene, (0, self._room))
        return out

    def _shown(
        self, n: int, viewpoint: Viewpoint, size: tuple[int, int]
    ) -> UInt8[np.ndarray, "h w 3"]:
        cell = self._frames[n]
        shapes = [
            Body(s.mesh, rgb(s.colour), s.opacity, s.published_from_shape) for s in cell.shapes
        ]
        least_mm = _LEAST_PIXELS * viewpoint.width_mm / size[0]
        lines = [
            Body(self._tube(line, max(line.width_mm, least_mm)), rgb(line.colour))
            for line in cell.drawn_lines
        ]
        return render(shapes + lines + self._bodies(n), viewpoint, size, _BACKDROP)

    def _tube(self, line: Polyline, width_mm: float) -> Mesh:
        key = id(line.points_mm), width_mm  # the line is kept, so its points' id stays theirs
        if key not in self._tubes:
            self._tubes[key] = line, tube(line.points_mm, width_mm / 2)
        return self._tubes[key][1]

    def _draw_progress(self, draw: ImageDraw.ImageDraw, n: int) -> None:
        """A progress bar of all states, red where the arms stand."""
        cell, (width, height) = self._frames[n], self._size
        done = 0
        for state, group in groupby(self._frames, lambda cell: cell.state):
            first, done = done, done + len(list(group))
            x = [8 + (width - 16) * k / len(self._frames) for k in (first, min(done, n + 1), done)]
            box = height - 11, height - 6
            draw.rectangle((x[0], box[0], max(x[2] - 2, x[0]), box[1]), fill=(205, 209, 214))
            if n >= first:
                colour = NONE if cell.halted and state == cell.state else (60, 110, 190)
                draw.rectangle((x[0], box[0], max(x[1] - 2, x[0]), box[1]), fill=colour)


class Paragraph(NamedTuple):
    """Text in a colour, perhaps on a background."""

    text: str
    ink: Colour
    paper: Colour | None = None
    large: bool = False


def words_strip(
    paragraphs: Sequence[Paragraph], size: tuple[int, int]
) -> tuple[Image.Image, list[tuple[float, float, float, float]]]:
    """The paragraphs, wrapped, on white: as wide as a scene of this size, as high as needed; and
    each line's box (left, top, right, bottom), pixels."""
    file = f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf"
    lines, y = [], 6
    for paragraph in paragraphs:
        share, least = (20, 15) if paragraph.large else (30, 11)  # of the height; pixels
        font = ImageFont.truetype(file, max(least, size[1] // share))
        for text in wrapped(paragraph.text, size[0] - 24, font.getlength):
            lines.append((paragraph, text, font, y))
            y += round(1.35 * font.size)
        y += 6
    strip = Image.new("RGB", (size[0], y), WHITE)
    draw, boxes = ImageDraw.Draw(strip), []
    for paragraph, _, font, top in lines:  # first, so that none covers text
        if paragraph.paper is not None:
            around = 6, top - 2, size[0] - 7, top + round(1.35 * font.size) + 1
            draw.rectangle(around, fill=paragraph.paper)
    for paragraph, text, font, top in lines:
        draw.text((12, top), text, fill=paragraph.ink, font=font)
        boxes.append(draw.textbbox((12, top), text, font=font))
    return strip, boxes


def divided(located: Located, plan: ResectionPlan) -> tuple[list[Body], list[Body]]:
    """What stays, and what comes away; between them is a gap as wide as the electrode."""
    surfaces = organ_surfaces(located)
    whole = solid_of(surfaces.pop(ORGAN), "the located organ")
    if len(plan.facets):
        rest = whole - trimmed(whole, plan.facets, -TOOLS.radius_mm)
    else:
        rest = whole - solid_of(plan.piece, "the piece")
    shade = rgb(part_colour(ORGAN))
    halves = [Body(mesh_of(rest), shade, _ORGAN_OPACITY)], [Body(plan.piece, shade, _ORGAN_OPACITY)]
    for label, mesh in surfaces.items():
        halves[name_of(label) in plan.taken].append(Body(mesh, rgb(part_colour(label))))
    return halves


def _holder(cell: Workcell) -> Float64[np.ndarray, "4 4"] | None:
    """Where the holder's cup is."""
    places = (s.published_from_shape for s in cell.shapes if s.name == "holder/cup")
    return next(places, None)


def _reach(frames: list[Workcell]) -> Float[np.ndarray, "n 3"]:
    """Points of the arms' parts in frames of all stages; without arms, of everything."""
    some = frames[:: max(1, len(frames) // _SAMPLED)]
    shapes = [shape for cell in some for shape in cell.shapes]
    if not shapes:
        raise InputError("the frames show no arms and no table: nothing to film.")
    points = [
        transform_points(shape.published_from_shape, shape.mesh.vertices_mm[::_EVERY])
        for shape in [shape for shape in shapes if "/" in shape.name] or shapes
    ]
    return np.concatenate(points)


def _viewpoint_of(
    points_mm: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, " 3"],
    size: tuple[int, int],
    share: tuple[float, float] = (0.9, 0.9),
) -> Viewpoint:
    """From this direction, with all points as large as possible in the image's uppermost
    ``share``."""
    target = (points_mm.min(0) + points_mm.max(0)) / 2
    radius = float(np.linalg.norm(points_mm - target, axis=1).max())
    away = _AWAY * radius * direction / np.linalg.norm(direction)
    viewpoint = Viewpoint.towards(target, target + away, 2 * radius)
    room = np.array(size) * share
    middle = np.array([size[0] / 2, (room[1] + (1 - max(share)) * size[1]) / 2])
    for _ in range(6):  # moved and widened until it fits
        flat = viewpoint.project(points_mm, size)[:, :2]
        low, high = flat.min(0), flat.max(0)
        off = ((low + high) / 2 - middle) * viewpoint.width_mm / size[0]
        target = target + off @ viewpoint.axes[:2]
        width = viewpoint.width_mm * float(((high - low) / room).max())
        viewpoint = Viewpoint.towards(target, target + away, width)
    return viewpoint


def tube(points_mm: Float[np.ndarray, "n 3"], radius_mm: float, sides: int = 6) -> Mesh:
    """A polyline as a thin closed tube; its joints are mitred."""
    turn = 2 * np.pi * np.arange(sides) / sides
    ring = shapely.Polygon(radius_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    solid = sweep_polygon(ring, points_mm)
    return Mesh(solid.vertices, solid.faces)
