"""Pictures of a resection plan in the table's frame: from above, from the side, and a section for
each sweep; and surfaces of the organ and its tumors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from tumortrack.core.colours import PIECE
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import KIDNEY, is_tumor, organ_first, organ_name
from tumortrack.core.types import Mesh, part_names
from tumortrack.report import drawing
from tumortrack.report.drawing import CENTRED
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView, rgb
from tumortrack_resection.budget import foreseen_mm, kept_words, lost_words
from tumortrack_resection.facets import TOOLS, Tools, across
from tumortrack_resection.sections import (
    INK,
    ORGAN_OPACITY,
    PIECE_OPACITY,
    arrows,
    colour_of,
    draw_section,
    parts_of,
    section_view,
    side_view,
    spoken,
    title_of,
    write,
)
from tumortrack_resection.sweeps import Lines, Sweep, sweeps_of
from tumortrack_resection.values import CUTS_TUMOR, Located, ResectionPlan

FROM_ABOVE = ParallelView("from above", (1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
_METHODS = {"published": "published method", "margin": "margin method"}

_WIDE_IN, _VIEWS_IN, _SECTIONS_IN, _LINE_IN = 12.0, 4.5, 3.0, 0.17  # the last: of a title
_ASPECT = 1.28  # of the views
_STRIP_OPACITY = 0.5
_CUP_FROM_MM = 24.0
_POSES = (0.5, 0.3, 0.7, 0.15, 0.85)  # shares of a sweep at which that may be drawn
_BADGE_MM = 5.5  # numbers closer than this would cover each other
_SECTIONS = (
    "Each sweep's section goes through the electrode where it comes nearest to a part; the black "
    "line is that distance."
)
_HEAD = "simple,head_width=0.7,head_length=0.75,tail_width=0.01"


def draw_plan(
    plan: ResectionPlan, located: Located, path: Path, tools: Tools = TOOLS,
    poses_mm: Lines | None = None,
) -> None:  # fmt: skip
    """Write ``plan_figure`` as a PNG, atomically; raises as it does."""
    drawing.save(plan_figure(plan, located, tools, poses_mm), path)


def plan_figure(
    plan: ResectionPlan, located: Located, tools: Tools = TOOLS, poses_mm: Lines | None = None
) -> Figure:
    """Warnings; the electrode's least distances; organ, tumors, the piece, the tip's paths and what
    the electrode covers, from where instrument and cup come; a section for each sweep.

    Axes in mm, down pointing down: first two views at one scale, from above x and -y; then the
    sections, at one of their own. 1200 pixels wide, as high as needed. ``poses_mm``: of the
    electrode while it cuts (``check.electrode_poses``), for cuts without a direction. Raises
    InputError: the tumor or organ has no surface, or one that is not closed."""
    if plan.tumor not in located.meshes:
        raise InputError(f"{plan.tumor} was not located, so its plan can't be drawn.")
    sweeps = sweeps_of(plan, located, tools, poses_mm)
    near = [sweep for sweep in sweeps if sweep.near]
    columns = 4 if len(near) == 4 or len(near) > 6 else 3
    lines = 1 + max((title_of(sweep).count("\n") for sweep in near), default=0)
    rows_in = [0.12 + _LINE_IN, _VIEWS_IN]
    rows_in += [0.16 + _LINE_IN * lines, _SECTIONS_IN] * -(-len(near) // columns)
    borders = {"left": 0.012, "right": 0.988, "bottom": 0.0, "top": 1.0, "hspace": 0, "wspace": 0.1}
    figure = drawing.new_figure(_WIDE_IN, sum(rows_in), **borders)
    grid = figure.add_gridspec(len(rows_in), 2 * columns, height_ratios=rows_in)
    views = [figure.add_subplot(grid[1, n * columns : (n + 1) * columns]) for n in range(2)]
    _draw_views(views, (FROM_ABOVE, side_view(plan, located)), plan, located, sweeps, tools)
    aspect = _WIDE_IN / columns / _SECTIONS_IN
    scenes = [section_view(sweep, plan) for sweep in near]
    widest_mm = max((frame.widened(aspect).width_mm for _, frame in scenes), default=0.0)
    for n, (sweep, (view, frame)) in enumerate(zip(near, scenes, strict=True)):
        row, column = divmod(n, columns)
        axes = figure.add_subplot(grid[3 + 2 * row, 2 * column : 2 * column + 2])
        frame = frame.widened(aspect, widest_mm)
        draw_section(axes, view, frame, plan, located, sweep, tools)
    _words(figure, plan, located, sweeps, tools)
    return figure


def _draw_views(
    every: list[Axes], views: tuple[ParallelView, ...], plan: ResectionPlan, located: Located,
    sweeps: list[Sweep], tools: Tools,
) -> None:  # fmt: skip
    organ, parts = located.organ, parts_of(located)
    bodies = [Body(mesh, colour_of(name, located)) for name, mesh in parts.items()]
    bodies.append(Body(organ, drawing.ORGAN, ORGAN_OPACITY))
    bodies.append(Body(plan.piece, rgb(PIECE), PIECE_OPACITY))
    strips = [Body(sweep.strip(), rgb(sweep.colour), _STRIP_OPACITY) for sweep in sweeps]
    bodies += [strip for strip in strips if len(strip.mesh.faces)]
    points = [organ.vertices_mm, plan.grasp_mm[None] + _CUP_FROM_MM * plan.lift]
    for sweep in sweeps:
        points += [*sweep.paths_mm, *(sweep.coming(at) for at in _POSES if sweep.near)]
    frames = [view.frame_around(np.concatenate(points), 4.0) for view in views]
    widest_mm = max(frame.widened(_ASPECT).width_mm for frame in frames)
    for axes, view, frame in zip(every, views, frames, strict=True):
        frame = frame.widened(_ASPECT, widest_mm)
        drawing.show_bodies(axes, view, bodies, frame)
        drawing.outline(axes, plan.piece, view, rgb(PIECE), 0.9)
        depth = np.min([view.depth_of(mesh, frame) for mesh in parts.values()], axis=0)
        for sweep in sweeps[::-1]:
            low = 0.0 if sweep.near else (sweep.number - 1) / max(len(sweeps) - 1, 1)
            width = 1.9 + 2.8 * low * (view is FROM_ABOVE)  # of the lower: so that both are seen
            for path_mm in sweep.paths_mm:
                flat = view.project(path_mm)
                behind = _behind(flat, depth, frame)
                _draw_path(axes, flat, contains(organ, path_mm), behind, rgb(sweep.colour), width)
        _draw_numbers(axes, sweeps, view)
        _draw_cup(axes, plan, view, tools.cup_radius_mm)
        for name, mesh in parts.items():
            if is_tumor(name) and name != plan.tumor:
                u, v, _ = view.project(mesh.box_mm.mean(0)[None])[0].tolist()
                write(axes, (u, v), spoken(name))
        drawing.finish_view(axes, frame, arrows(view))
        axes.set_title(view.name, fontsize=11)


def _behind(
    flat: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, "h w"], frame: Frame
) -> Bool[np.ndarray, " n"]:
    """Which projected points are hidden by surfaces at that depth."""
    x, y = frame.pixel_centres()
    column = np.rint((flat[:, 0] - x[0]) / (x[1] - x[0])).astype(int)
    row = np.rint((flat[:, 1] - y[0]) / (y[1] - y[0])).astype(int)
    return depth[row, column] < flat[:, 2]


def _draw_path(
    axes: Axes, flat: Float[np.ndarray, "n 3"], inside: Bool[np.ndarray, " n"],
    behind: Bool[np.ndarray, " n"], colour: RGB, width: float,
) -> None:  # fmt: skip
    """Bold in the organ, faint behind a part; with an arrow head."""
    casing = [Stroke(linewidth=width + 1.2, foreground="white", alpha=0.8), Normal()]
    axes.plot(*flat[:, :2].T, color=colour, linewidth=0.9, alpha=0.8, zorder=5)
    faint = np.where((inside & behind)[:, None], flat[:, :2], np.nan)
    axes.plot(*faint.T, color=colour, linewidth=0.8 * width, alpha=0.4, zorder=5)
    bold = np.where((inside & ~behind)[:, None], flat[:, :2], np.nan)
    axes.plot(*bold.T, color=colour, linewidth=width, path_effects=casing, zorder=6)
    _draw_arrow(axes, flat[len(flat) // 4 :][:2, :2], colour, _HEAD)


def _draw_arrow(
    axes: Axes, ends: Float[np.ndarray, "2 2"], colour: RGB, style: str = "-|>"
) -> None:
    arrow = {"arrowstyle": style, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0, "lw": 1.8}
    start, end = ends.tolist()
    axes.annotate("", end, start, arrowprops={**arrow, "color": colour}, zorder=9)


def _draw_numbers(axes: Axes, sweeps: list[Sweep], view: ParallelView) -> None:
    """Of sweeps, where the instrument comes from, with an arrow; else where they begin."""
    taken = [np.full(2, np.inf)]
    for sweep in sweeps:
        path = sweep.paths_mm[0]
        ways = [
            sweep.coming(at) if sweep.near else path[[int(at * len(path))] * 2] for at in _POSES
        ]
        flat = [view.project(way)[:, :2] for way in ways]
        free = [min(np.linalg.norm(way[1] - other) for other in taken) for way in flat]
        first = next((n for n, mm in enumerate(free) if mm > _BADGE_MM), int(np.argmax(free)))
        end, spot = flat[first]
        taken.append(spot)
        if np.linalg.norm(spot - end) > _BADGE_MM / 2:
            _draw_arrow(axes, np.stack([spot, end]), rgb(sweep.colour))
        colour = rgb(sweep.colour)
        badge = {"boxstyle": "circle,pad=0.22", "facecolor": colour, "edgecolor": "white"}
        style = {**CENTRED, "fontsize": 7.5, "weight": "bold", "color": "white", "zorder": 10}
        axes.annotate(str(sweep.number), tuple(spot), bbox=badge, **style)


def _draw_cup(axes: Axes, plan: ResectionPlan, view: ParallelView, radius_mm: float) -> None:
    """Its rim where it holds the piece, and from where it comes."""
    turn = np.linspace(0, 2 * np.pi, 60)
    rim_mm = radius_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across(plan.lift)
    axes.plot(*view.project(plan.grasp_mm + rim_mm)[:, :2].T, color=INK, linewidth=1.8, zorder=9)
    ends = view.project(plan.grasp_mm + np.outer([_CUP_FROM_MM, 0.0], plan.lift))[:, :2]
    axes.plot(*ends[1], ".", color=INK, markersize=5, zorder=9)
    if np.linalg.norm(ends[0] - ends[1]) > 3:
        _draw_arrow(axes, ends, INK)


def _words(
    figure: Figure, plan: ResectionPlan, located: Located, sweeps: list[Sweep], tools: Tools
) -> None:
    """Warnings; title with the least distances; legend, volumes and all other notes."""
    least_mm = plan.least_mm or foreseen_mm(plan, located, tools)
    ml, warnings, tumor = plan.volumes_ml, plan.warnings, spoken(plan.tumor)
    if not plan.clearances:  # else its notes say so
        deep = {name: -mm for name, mm in least_mm.items() if mm < 0 and is_tumor(name)}
        harm = [f"{CUTS_TUMOR} {name}, up to {mm:.1f} mm deep." for name, mm in deep.items()]
        warnings = (*harm, *warnings)
    count = f"{plan.sweeps} sweep" + ("s" if plan.sweeps > 1 else "")
    title = f"Plan to resect {tumor}, {located.patient}: {_METHODS[plan.method]}, {count}"
    lines = [
        f"{ml['piece']:.1f} ml come away with {ml['tumor']:.1f} ml of {tumor}; {lost_words(plan)}",
        f"{plan.exophytic:.0%} of the tumor outside the organ's hull; "
        f"{sum(cut.length_mm for cut in plan.cuts) / 10:.0f} cm of cuts, bold in the organ",
        *(note for note in plan.notes if note not in plan.warnings),
    ]
    if any(sweep.near for sweep in sweeps):
        lines = [_SECTIONS, *lines]
    handles = [
        Patch(facecolor=(*drawing.ORGAN, 0.5), label=spoken(organ_first(located.meshes)[0])),
        *(Patch(facecolor=colour_of(n, located), label=spoken(n)) for n in parts_of(located)),
        Patch(facecolor=(*rgb(PIECE), 0.45), edgecolor=rgb(PIECE), label="comes away"),
        *(Line2D([], [], color=rgb(each.colour), lw=2.8, label=f"sweep {each.number}")
          for each in sweeps),
        Line2D([], [], color=INK, marker="o", mfc="none", mew=1.8, ls="", label="cup"),
    ]  # fmt: skip
    title = f"{title}\n{kept_words(plan, least_mm)}"
    drawing.add_words(figure, title, warnings, lines, handles)


def organ_surfaces(located: Located) -> dict[int, Mesh]:
    """By label 1 (the whole organ, tumors included), 2, ...: closed surfaces, table frame, mm."""
    organ = organ_name(located.meshes) or KIDNEY.name
    labels = {name: label for label, name in enumerate(part_names(255, organ), start=1)}
    return {labels[name]: mesh for name, mesh in located.meshes.items() if name in labels}
