"""A film of a stored plan's motions, or as a sink, ``film:FILE.gif``, of what is followed: an
animated GIF, drawn by matplotlib without a display."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from tumortrack.core.colours import CUT, ENERGISED, NOW, ORGAN_PART, TO_CUT, name_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.organ import is_tumor
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.store import check_place, write_atomically
from tumortrack.core.types import Mesh
from tumortrack.live.values import Polyline, RigidShape, SinkConfig, SinkContext, TrackingResult
from tumortrack.report import drawing
from tumortrack_resection.facets import TOOLS
from tumortrack_resection.motions import Joints, Motions, MotionStage, Stage
from tumortrack_resection.pictures import Body, shaded
from tumortrack_resection.strokes import trimmed
from tumortrack_resection.values import ELECTRODE, Located, ResectionPlan
from tumortrack_resection.workcell import cut_lines

FPS, FRAMES = 10, 120  # a GIF counts hundredths of a second; about so many
_SIZE_IN = 6.4, 4.8  # of the scene, 100 pixels each
_OBLIQUE = np.array([[0.91, -0.41, 0.0], [-0.2, -0.44, -0.87], [0.36, 0.8, -0.48]])  # right, down
_INSET = 0.6, 0.02, 0.38, 0.5  # the close-up's place: left, bottom, width, height
_CLOSE_MM, _ROOM_MM = 70.0, 30.0  # half of what the close-up shows; beside the arms
_ORGAN_OPACITY = 0.42
_LEAST_FRAMES, _LAST_MS = 3, 1600  # of a stage; of the last picture
_TITLE = "PLAYBACK of a stored plan, SIMULATED: nothing is tracked"
TRUE = (70, 70, 75)  # colour of the truth
_MOST = 240  # pictures of a sink's film: from then on every second one is left out


class Moment(NamedTuple):
    """Of a film: the stage, both arms' joints, and whether the electrode is energised."""

    stage: MotionStage
    joints_rad: Joints
    cutting: bool


def moments(motions: Motions, frames: int) -> list[Moment]:
    """About so many that show every stage: by the square root of its length, as sweeps take minutes
    and the grasp seconds."""
    roots = np.sqrt([stage.seconds for stage in motions.stages])
    counts = np.maximum(np.rint(frames * roots / max(roots.sum(), 1e-9)), _LEAST_FRAMES).astype(int)
    found = []
    for stage, count in zip(motions.stages, counts.tolist(), strict=True):
        for time_s in np.linspace(0, stage.seconds, count):
            now = int(np.searchsorted(stage.times_s, time_s))
            found.append(Moment(stage, stage.at(time_s), bool(stage.cutting[now])))
    return found


def film(
    plan: ResectionPlan, located: Located, motions: Motions,
    draw: Callable[[Joints], tuple[RigidShape, ...]], path: Path,
    progress: Callable[[int, int], None] = lambda n, of: None,
) -> float:  # fmt: skip
    """Write an animated GIF that loops; returns its length in s. ``draw``: arms and table.

    Above every frame stand the plan's warnings, what it is and the state; below it the patient.
    From the lift on the piece moves with the holder; after the release it is gone. Raises
    InputError: another kind of file; StorageError: the disk refused.
    """
    _check_name(path)
    frames = moments(motions, FRAMES)
    arms = [shape for moment in frames[::6] for shape in draw(moment.joints_rad)]
    boxes = _boxes(arms, located.organ)
    stays, goes = divided(located, plan)
    pictures: list[Image.Image] = []
    lifted = np.eye(4)
    for name, group in groupby(frames, lambda moment: moment.stage.name):
        for moment in group:
            shapes = draw(moment.joints_rad)
            cup = next(s.published_from_shape for s in shapes if s.name == "holder/cup")
            lifted = cup if name not in (Stage.LIFT, Stage.RELEASE, "home") else lifted
            moved = cup @ np.linalg.inv(lifted)
            piece = [body._replace(world_from_mesh=moved) for body in goes]
            bodies = stays if name == "home" else [*stays, *piece]
            over = name in (Stage.LIFT, Stage.RELEASE)
            lines = cut_lines(plan.cuts, moment.stage.sweep or (plan.sweeps + 1) * over)
            state = name + ": the electrode is energised" * moment.cutting
            words = f"{_TITLE}\n{state}", plan.warnings, [str(located.patient)]
            lit = f"cutter/{ELECTRODE}" if moment.cutting else ""
            drawn = [replace(s, colour=ENERGISED) if s.name == lit else s for s in shapes]
            pictures.append(_picture(drawn, bodies, lines, boxes, located.organ, words))
            progress(len(pictures), len(frames))
    _write(pictures, path)
    return len(frames) / FPS


def _check_name(path: Path) -> None:
    if path.suffix.lower() != ".gif":
        raise InputError(f"{path}: a film is an animated GIF; give a name that ends in .gif.")


def _boxes(shapes: Sequence[RigidShape], organ: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Of what is shown: arms and organ."""
    ends = [
        transform_points(shape.published_from_shape, shape.mesh.box_mm)
        for shape in shapes
        if "/" in shape.name
    ]
    flat = np.concatenate([*ends, organ.vertices_mm]) @ _OBLIQUE[:2].T
    return flat.min(0) - _ROOM_MM, flat.max(0) + _ROOM_MM


def _write(pictures: Sequence[Image.Image], path: Path) -> None:
    height, buffer = max(picture.height for picture in pictures), io.BytesIO()
    sheets = [Image.new("RGB", (picture.width, height), "white") for picture in pictures]
    for sheet, picture in zip(sheets, pictures, strict=True):
        sheet.paste(picture, (0, height - picture.height))
    some = [np.asarray(sheet)[::3, ::3] for sheet in sheets[:: max(1, len(sheets) // 8)]]
    some.append(
        np.resize(np.array([ENERGISED, NOW, TO_CUT, CUT], np.uint8), (12, *some[0].shape[1:]))
    )
    palette = Image.fromarray(np.concatenate(some)).quantize(256, Image.Quantize.MEDIANCUT)
    indexed = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    lasting = [round(1000 / FPS)] * (len(sheets) - 1) + [_LAST_MS]
    more: dict[str, Any] = {"append_images": indexed[1:], "duration": lasting, "loop": 0}
    indexed[0].save(buffer, format="GIF", save_all=True, **more)
    write_atomically(path, buffer.getvalue())


def _picture(
    shapes: Sequence[RigidShape], bodies: list[Body], lines: Sequence[Polyline],
    boxes: tuple[np.ndarray, np.ndarray], organ: Mesh, words: tuple[Any, ...],
) -> Image.Image:  # fmt: skip
    """The whole cell, and from near the organ, with words round them."""
    figure = drawing.new_figure(*_SIZE_IN, left=0.0, right=1.0, bottom=0.0, top=1.0)
    axes, near = figure.add_subplot(), organ.box_mm.mean(0) @ _OBLIQUE[:2].T
    # A table's triangles are too large to be sorted among the others.
    layers = [
        [Body(s.mesh, s.colour, s.opacity, s.published_from_shape)
         for s in shapes if ("/" in s.name) == small]
        for small in (False, True)
    ]  # fmt: skip
    close = near - _CLOSE_MM, near + _CLOSE_MM
    for drawn, box in ((axes, boxes), (axes.inset_axes(_INSET), close)):
        for layer in filter(None, (*layers, bodies)):
            shaded(drawn, layer, _OBLIQUE, box)
        for line in lines:
            flat = line.points_mm @ _OBLIQUE[:2].T
            drawn.plot(*flat.T, color=np.array(line.colour) / 255, linewidth=1.4, zorder=3)
        (left, top), (right, low) = box
        drawn.set(xlim=(left, right), ylim=(low, top), xticks=[], yticks=[], aspect="equal")
    drawing.add_words(figure, *words)
    canvas = cast(FigureCanvasAgg, figure.canvas)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


class FilmSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="film"):
    """An animated GIF of a live resection: arms, and the organ as it is followed, groove, flap and
    all; dark beneath it the truth, where the source knows it.

    Attributes:
        every_s: at least so long from one picture to the next.
    """

    target: ClassVar[str] = "path"

    path: Path
    every_s: float = 1.0

    def __post_init__(self) -> None:
        _check_name(self.path)
        self.check_between("film:", every_s=(0.03, 3600))

    def open(self, context: SinkContext) -> FilmSink:
        if context.controller is None:
            raise InputError("film: nothing here moves an arm; it is for `tumortrack resect`.")
        check_place(self.path, "", None)
        return FilmSink(self, str(context.patient))


class FilmSink:
    """Written when it is closed."""

    def __init__(self, config: FilmSinkConfig, patient: str) -> None:
        self._path, self._every_ns, self._patient = config.path, config.every_s * 1e9, patient
        self._pictures, self._next_ns = list[Image.Image](), 0.0
        self._boxes: tuple[np.ndarray, np.ndarray] | None = None
        self._organ: Mesh | None = None  # the last that was known: what is shown from near

    def publish(self, result: TrackingResult) -> None:
        now, cell = result.transformed, result.control
        self._organ = self._organ if now is None else next(iter(now.meshes.values()))
        if self._organ is None or cell is None or result.stamp_ns < self._next_ns:
            return
        self._next_ns = result.stamp_ns + self._every_ns
        self._boxes = self._boxes or _boxes(cell.shapes, self._organ)
        bodies = [] if now is None else [
            Body(mesh, name_colour(n) if is_tumor(n) else ORGAN_PART, 0.6 if is_tumor(n) else 0.42)
            for n, mesh in now.meshes.items()
        ]  # fmt: skip
        if result.observation is not None and (truth := result.observation.truth) is not None:
            pose = result.published_frame.published_from_camera
            shown = [Body(mesh, TRUE, 1.0, pose) for mesh in truth.parts]
            bodies += [shown[0]._replace(opacity=0.2), *shown[1:]]
        words = f"{result.describe()}\n{cell.line}", [cell.stopped][: bool(cell.stopped)]
        picture = cell.shapes, bodies, cell.lines, self._boxes, self._organ
        self._pictures.append(_picture(*picture, (*words, [self._patient])))
        if len(self._pictures) > _MOST:
            self._pictures, self._every_ns = self._pictures[::2], 2 * self._every_ns

    def close(self) -> None:
        if self._pictures:
            _write(self._pictures, self._path)
        self._pictures = []


def divided(located: Located, plan: ResectionPlan) -> tuple[list[Body], list[Body]]:
    """What stays, and what comes away; between them is a gap as wide as the electrode."""
    whole = solid_of(located.organ, "the located organ")
    if len(plan.facets):
        rest = whole - trimmed(whole, plan.facets, -TOOLS.radius_mm)
    else:
        rest = whole - solid_of(plan.piece, "the piece")
    halves = [[Body(mesh, ORGAN_PART, _ORGAN_OPACITY)] for mesh in (mesh_of(rest), plan.piece)]
    for name, mesh in located.meshes.items():
        if is_tumor(name):
            halves[name in plan.taken].append(Body(mesh, name_colour(name)))
    return halves[0], halves[1]
