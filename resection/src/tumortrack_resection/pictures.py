"""Pictures of a resection plan, from above and from the side, in the table's frame; and surfaces of
the organ, its tumors and the piece that comes away."""

from __future__ import annotations

from pathlib import Path

import manifold3d
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from tumortrack.core.colours import PIECE, name_colour, part_colour, sweep_colour
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import contains
from tumortrack.core.organ import KIDNEY, organ_first, organ_name
from tumortrack.core.types import ORGAN, Mesh, part_names
from tumortrack.imaging.meshes import mesh_of, solid_of
from tumortrack.report import drawing
from tumortrack.report.drawing import CENTRED
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView, rgb
from tumortrack_resection.budget import kept_words
from tumortrack_resection.values import Cut, CutLayer, Located, ResectionPlan

FROM_ABOVE = ParallelView("from above", (1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
FROM_SIDE = ParallelView("from the side", (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
_ARROWS = {
    FROM_ABOVE: {"x": (1.0, 0.0), "y": (0.0, -1.0)},
    FROM_SIDE: {"x": (1.0, 0.0), "z": (0.0, -1.0)},
}
_METHODS = {"published": "published method", "margin": "margin method"}

_ASPECT = 1.28
_PIECE = rgb(PIECE)
_GRASP = (0.1, 0.1, 0.12)
_APPROACH_MM, _CUP_MM = 24.0, 5.0
_ORGAN_OPACITY, _PIECE_OPACITY = 0.36, 0.3
_BADGE_MM = 4.4  # numbers closer than this would cover each other
_ARROW_EVERY_MM, _HEAD_MM = 45.0, 2.6
_MOST_ARROWED = 8  # sweeps with arrows


def draw_plan(plan: ResectionPlan, located: Located, path: Path) -> None:
    """Write ``plan_figure`` as a PNG, atomically; raises as it does."""
    drawing.save(plan_figure(plan, located), path)


def plan_figure(plan: ResectionPlan, located: Located) -> Figure:
    """Warnings; organ, tumors, the piece, strokes with their directions, and the grasp point.

    Two axes in mm at one scale, down pointing down: from above x and -y, from the side x and -z.
    Strokes are bold in the organ. 1200 pixels wide, as high as needed. Raises InputError: the tumor
    or organ has no surface, or one that is not closed."""
    surfaces = organ_surfaces(located)
    if plan.label not in surfaces:
        raise InputError(f"{plan.tumor} was not located, so its plan can't be drawn.")
    organ = surfaces.pop(ORGAN)
    piece, rest = parted(organ, plan.layers)
    bodies = [Body(mesh, rgb(part_colour(label))) for label, mesh in surfaces.items()]
    bodies += [Body(rest, drawing.ORGAN, _ORGAN_OPACITY), Body(piece, _PIECE, _PIECE_OPACITY)]
    in_organ = [contains(organ, cut.path_mm) for cut in plan.cuts]
    reach_mm = plan.grasp_mm + np.array([0.0, 0.0, _APPROACH_MM])
    shown = [organ.vertices_mm, *(cut.path_mm for cut in plan.cuts), reach_mm[None]]
    borders = {"left": 0.012, "right": 0.988, "top": 0.94, "bottom": 0.01}
    figure = drawing.new_figure(12.0, 4.8, **borders, wspace=0.02)
    frames = [view.frame_around(np.concatenate(shown), 7.0) for view in (FROM_ABOVE, FROM_SIDE)]
    widest_mm = max(frame.widened(_ASPECT).width_mm for frame in frames)
    for column, view in enumerate((FROM_ABOVE, FROM_SIDE)):
        frame = frames[column].widened(_ASPECT, widest_mm)
        axes = figure.add_subplot(1, 2, column + 1)
        drawing.show_bodies(axes, view, bodies, frame)
        if len(piece.faces):
            drawing.outline(axes, piece, view, frame, _PIECE, 0.9)
        depth = np.min([view.depth_of(mesh, frame) for mesh in surfaces.values()], axis=0)
        hidden = [_behind(cut, depth, view, frame) for cut in plan.cuts]
        _draw_cuts(axes, plan, in_organ, hidden, view)
        _draw_numbers(axes, plan, view, frame)
        _draw_grasp(axes, plan, view)
        for label, mesh in surfaces.items():
            if label != plan.label:
                u, v = view.project(mesh.box_mm.mean(0)[None])[0, :2]
                halo = [Stroke(linewidth=2.5, foreground="white"), Normal()]
                style = {**CENTRED, "zorder": 9, "path_effects": halo}
                axes.text(u, v, f"tumor {label - ORGAN}", **style)
        drawing.finish_view(axes, frame, _ARROWS[view])
        axes.set_title(view.name, fontsize=11)
    _words(figure, plan, located)
    return figure


def _behind(
    cut: Cut, depth: Float[np.ndarray, "h w"], view: ParallelView, frame: Frame
) -> Bool[np.ndarray, " n"]:
    """Which points of a stroke are hidden by surfaces at that depth."""
    x, y = frame.pixel_centres()
    flat = view.project(cut.path_mm)
    column = np.rint((flat[:, 0] - x[0]) / (x[1] - x[0])).astype(int)
    row = np.rint((flat[:, 1] - y[0]) / (y[1] - y[0])).astype(int)
    return depth[row, column] < flat[:, 2]


def _draw_cuts(
    axes: Axes,
    plan: ResectionPlan,
    in_organ: list[Bool[np.ndarray, " _"]],
    hidden: list[Bool[np.ndarray, " _"]],
    view: ParallelView,
) -> None:
    """The lowest first and, from above, widest, so that strokes above each other all show; those
    behind a tumor are faint."""
    every = -(-plan.sweeps // _MOST_ARROWED)
    every += 1 - every % 2  # odd, to show that strokes alternate in direction
    for cut, inside, behind in reversed(list(zip(plan.cuts, in_organ, hidden, strict=True))):
        flat = view.project(cut.path_mm)
        colour = rgb(sweep_colour(cut.sweep, plan.sweeps))
        low = (cut.sweep - 1) / max(plan.sweeps - 1, 1) if view is FROM_ABOVE else 0.5
        width = (1.9 + 2.8 * low) * (1.0 if cut.kind == "wall" else 0.6)
        casing = [Stroke(linewidth=width + 1.2, foreground="white", alpha=0.8), Normal()]
        axes.plot(*flat[:, :2].T, color=colour, linewidth=0.9, alpha=0.8, zorder=5)
        faint = np.where((inside & behind)[:, None], flat[:, :2], np.nan)
        axes.plot(*faint.T, color=colour, linewidth=0.8 * width, alpha=0.4, zorder=5)
        bold = np.where((inside & ~behind)[:, None], flat[:, :2], np.nan)
        axes.plot(*bold.T, color=colour, linewidth=width, path_effects=casing, zorder=6)
        if cut.kind == "wall" and (plan.sweeps - cut.sweep) % every == 0:
            _draw_arrows(axes, flat, colour)


def _draw_arrows(axes: Axes, flat: Float[np.ndarray, "n 3"], colour: RGB) -> None:
    """Arrow heads along a stroke, on the side towards the viewer."""
    style = "simple,head_width=0.85,head_length=0.9,tail_width=0.01"
    arrow = {"arrowstyle": style, "mutation_scale": 13, "shrinkA": 0, "shrinkB": 0}
    arrow |= {"facecolor": colour, "edgecolor": "white", "linewidth": 0.6}
    steps = np.linalg.norm(np.diff(flat[:, :2], axis=0), axis=1)
    near = flat[:-1, 2] <= (flat[:, 2].min() + flat[:, 2].max()) / 2 + 1e-6
    good = np.flatnonzero(near & (steps >= 0.6 * steps[near].max()))
    count = max(1, round(float(steps[good].sum()) / _ARROW_EVERY_MM))
    for n in good[(len(good) * (np.arange(count) + 0.5) / count).astype(int)]:
        along = flat[n + 1, :2] - flat[n, :2]
        tip = flat[n, :2] + along / np.linalg.norm(along) * _HEAD_MM / 2
        axes.annotate("", tip, 2 * flat[n, :2] - tip, arrowprops=arrow, zorder=8)


def _draw_numbers(axes: Axes, plan: ResectionPlan, view: ParallelView, frame: Frame) -> None:
    """Numbers of sweeps: from above where they start, from the side at their heights. The first,
    the last, and those between that have room."""
    first = {cut.sweep: cut for cut in reversed(plan.cuts)}
    taken: list[Float[np.ndarray, " 2"]] = []
    for sweep in sorted(first, key=lambda sweep: (sweep not in (1, plan.sweeps), sweep)):
        flat = view.project(first[sweep].path_mm)[:, :2]
        colour = rgb(sweep_colour(sweep, plan.sweeps))
        spot = flat[0] if view is FROM_ABOVE else np.array([frame.right - 6.0, flat[0, 1]])
        if any(np.linalg.norm(spot - other) < _BADGE_MM for other in taken):
            continue
        taken.append(spot)
        if view is FROM_SIDE:
            x = [flat[:, 0].max(), spot[0]]
            axes.plot(x, [spot[1]] * 2, ":", color=colour, lw=0.9, zorder=4)
        badge = {"boxstyle": "circle,pad=0.22", "facecolor": colour, "edgecolor": "white"}
        style = {**CENTRED, "fontsize": 7.5, "weight": "bold", "color": "white", "zorder": 10}
        axes.annotate(str(sweep), tuple(spot), bbox=badge, **style)


def _draw_grasp(axes: Axes, plan: ResectionPlan, view: ParallelView) -> None:
    """The cup, and from the side its approach."""
    u, v, _ = view.project(plan.grasp_mm[None])[0]
    if view is FROM_ABOVE:
        for radius, width in ((_CUP_MM, 1.8), (0.35, 2.4)):
            turn = np.linspace(0, 2 * np.pi, 60)
            x, y = u + radius * np.cos(turn), v + radius * np.sin(turn)
            axes.plot(x, y, color=_GRASP, linewidth=width, zorder=9)
        return
    x, y = u + _CUP_MM * np.array([-1, 1, 0.5, -0.5]), v - np.array([0, 0, 4, 4])
    axes.fill(x, y, color=_GRASP, zorder=9)
    arrow = {"arrowstyle": "-|>", "color": _GRASP, "linewidth": 1.8, "mutation_scale": 14}
    axes.annotate("", (u, v - 4.0), (u, v - _APPROACH_MM), arrowprops=arrow, zorder=9)


def _words(figure: Figure, plan: ResectionPlan, located: Located) -> None:
    """Warnings, title, legend, volumes and all other notes."""
    ml, tumor = plan.volumes_ml, plan.tumor.replace("_", " ")
    sweeps = f"{plan.sweeps} sweep" + ("s" if plan.sweeps > 1 else "")
    title = f"Plan to resect {tumor}, {located.patient}: {_METHODS[plan.method]}, {sweeps}"
    share = ml["healthy"] / ml["parenchyma"]
    lines = [
        f"{ml['piece']:.1f} ml come away: {ml['tumor']:.1f} ml tumor and {ml['healthy']:.1f} ml "
        f"healthy tissue ({share:.0%} of the organ's)",
        f"{kept_words(plan, located)}; {plan.exophytic:.0%} of the tumor outside the organ's "
        f"hull; {sum(cut.length_mm for cut in plan.cuts) / 10:.0f} cm of cuts, bold in the organ",
        *(note for note in plan.notes if note not in plan.warnings),
    ]
    ends = {n: rgb(sweep_colour(n, plan.sweeps)) for n in sorted({1, plan.sweeps})}
    organ, *tumors = organ_first(located.meshes)
    handles = [
        Patch(facecolor=(*drawing.ORGAN, 0.5), label=organ.replace("_", " ")),
        *(Patch(facecolor=rgb(name_colour(t)), label=t.replace("_", " ")) for t in tumors),
        Patch(facecolor=(*_PIECE, 0.45), edgecolor=_PIECE, label="comes away"),
        *(Line2D([], [], color=c, lw=2.8, label=f"sweep {n}") for n, c in ends.items()),
        Line2D([], [], color=_GRASP, marker="o", mfc="none", mew=1.8, ls="", label="grasp"),
    ]
    drawing.add_words(figure, title, plan.warnings, lines, handles)


def organ_surfaces(located: Located) -> dict[int, Mesh]:
    """By label 1 (the whole organ, tumors included), 2, ...: closed surfaces, table frame, mm."""
    organ = organ_name(located.meshes) or KIDNEY.name
    labels = {name: label for label, name in enumerate(part_names(255, organ), start=1)}
    return {labels[name]: mesh for name, mesh in located.meshes.items() if name in labels}


def parted(organ: Mesh, layers: tuple[CutLayer, ...]) -> tuple[Mesh, Mesh]:
    """The piece that comes away, and the rest."""
    solid = solid_of(organ, "the located organ")
    above_mm = organ.box_mm[1, 2] + 1.0
    slabs = []
    for layer in layers:
        area = manifold3d.CrossSection(list(layer.rings_mm), manifold3d.FillRule.NonZero)
        height = min(layer.top_mm, above_mm) - layer.bottom_mm
        if height > 0:
            slabs.append(area.extrude(height).translate((0.0, 0.0, layer.bottom_mm)))
    taken = manifold3d.Manifold.batch_boolean(slabs, manifold3d.OpType.Add)
    return mesh_of(solid ^ taken), mesh_of(solid - taken)
