"""The picture of a plan, in the table's frame: from above, from the side, and for each sweep a
section through the electrode where it comes nearest to a part."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float, Float64
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke

from tumortrack.core.colours import (
    NONE,
    ORGAN_PART,
    PIECE,
    Colour,
    name_colour,
    structure_colour,
    sweep_colour,
)
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import plane_section, transform_points
from tumortrack.core.organ import is_tumor, organ_first
from tumortrack.core.types import Mesh
from tumortrack.report import drawing
from tumortrack_resection.budget import foreseen_mm, kept_words, lost_words, nearest
from tumortrack_resection.facets import TOOLS, Tools, across
from tumortrack_resection.values import CUTS_TUMOR, Cut, Located, ResectionPlan

_INK, _HALO = (0.1, 0.1, 0.12), [Stroke(linewidth=2.5, foreground="white"), Normal()]
_WIDE_IN, _VIEWS_IN, _SECTIONS_IN, _COLUMNS = 12.0, 4.5, 3.2, 4
_ORGAN_OPACITY, _PIECE_OPACITY = 0.45, 0.3
_AROUND_MM, _COMING_MM = 5.0, 20.0  # beside what is shown; from where cup and electrode come
_ALONG_MM = 1.0  # between points of an electrode
_LIGHT = np.array([-0.35, -0.55, -1.0]) / np.linalg.norm([0.35, 0.55, 1.0])  # right, down, away
ABOVE = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # right, down, away

Axes3 = Float64[np.ndarray, "3 3"]  # unit vectors to the picture's right, down and away


class Body(NamedTuple):
    """A surface, where it is, and how it looks."""

    mesh: Mesh
    colour: Colour
    opacity: float = 1.0
    world_from_mesh: Float[np.ndarray, "4 4"] | None = None


def shaded(axes: Axes, bodies: list[Body], view: Axes3, box: Any = (-np.inf, np.inf)) -> None:
    """The triangles that face the viewer, the farthest first; opaque ones below the others.
    ``box``: the corners of what is shown (right, down)."""
    corners, colours = [], []
    for mesh, colour, opacity, pose in bodies:
        vertices = mesh.vertices_mm if pose is None else transform_points(pose, mesh.vertices_mm)
        triangles = (vertices @ view.T)[mesh.faces]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        seen = (normals[:, 2] < 0) & (triangles[:, :, :2].max(1) > box[0]).all(1)
        seen &= (triangles[:, :, :2].min(1) < box[1]).all(1)
        normals = normals[seen] / np.linalg.norm(normals[seen], axis=1, keepdims=True)
        light = 0.55 + 0.45 * np.clip(normals @ _LIGHT, 0, 1)
        opaque = np.full((len(light), 1), opacity)
        colours.append(np.hstack([light[:, None] * np.array(colour) / 255, opaque]))
        corners.append(triangles[seen])
    every, paint = np.concatenate(corners), np.concatenate(colours)
    order = np.lexsort([-every[:, :, 2].mean(1), paint[:, 3] < 1])
    style: dict[str, Any] = {"linewidths": 0.2, "zorder": 2}
    edges = np.where(paint[order, 3:] < 1, 0.0, paint[order])  # else gaps between opaque ones
    axes.add_collection(
        PolyCollection(
            list(every[order, :, :2]), facecolors=paint[order], edgecolors=edges, **style
        )
    )


def draw_plan(plan: ResectionPlan, located: Located, path: Path, tools: Tools = TOOLS) -> None:
    """Write ``plan_figure`` as a PNG, atomically; raises as it does."""
    drawing.save(plan_figure(plan, located, tools), path)


def plan_figure(plan: ResectionPlan, located: Located, tools: Tools = TOOLS) -> Figure:
    """Warnings; the electrode's least distances; organ, tumors, the piece, the tip's paths, the
    electrode on them, the cup; a section for each sweep whose instrument has a direction.

    1200 pixels wide, down pointing down. Raises InputError: the tumor has no surface."""
    if plan.tumor not in located.meshes:
        raise InputError(f"{plan.tumor} was not located, so its plan can't be drawn.")
    cuts = [cut for cut in plan.cuts if cut.axis is not None]
    rows = -(-len(cuts) // _COLUMNS)
    heights = [_VIEWS_IN, *[_SECTIONS_IN] * rows]
    borders = {"left": 0.012, "right": 0.988, "bottom": 0.0, "top": 0.94, "hspace": 0.16}
    figure = drawing.new_figure(_WIDE_IN, sum(heights) * 1.08, **borders)
    grid = figure.add_gridspec(1 + rows, _COLUMNS, height_ratios=heights)
    half = _COLUMNS // 2
    for n, (name, view) in enumerate(
        {"above": ABOVE, "the side": side_view(plan, located)}.items()
    ):
        axes = figure.add_subplot(grid[0, n * half : (n + 1) * half])
        _draw_view(axes, view, plan, located, tools)
        axes.set_title(f"from {name}", fontsize=11)
    for n, cut in enumerate(cuts):
        axes = figure.add_subplot(grid[1 + n // _COLUMNS, n % _COLUMNS])
        _draw_section(axes, cut, plan, located, tools)
    _words(figure, plan, located, tools)
    return figure


def side_view(plan: ResectionPlan, located: Located) -> Axes3:
    """Level, across the way from the tumor to the nearest other one, or else to the organ's middle,
    so that both lie beside each other; from the side on which the tumor is in front."""
    tumors = {name: m.box_mm.mean(0) for name, m in located.meshes.items() if is_tumor(name)}
    middle, whole_mm = tumors.pop(plan.tumor), located.organ.box_mm.mean(0)
    nearest_mm = min(tumors.values(), key=lambda at: np.linalg.norm(at - middle), default=whole_mm)
    way = (nearest_mm - middle)[:2]
    x, y = way / np.linalg.norm(way) if np.linalg.norm(way) > 1.0 else np.array([1.0, 0.0])
    if (middle - whole_mm)[:2] @ [-y, x] > 0:
        x, y = -x, -y
    return np.array([[x, y, 0.0], [0.0, 0.0, -1.0], [-y, x, 0.0]])


def _draw_view(
    axes: Axes, view: Axes3, plan: ResectionPlan, located: Located, tools: Tools
) -> None:
    parts = _parts(located)
    bodies = [
        Body(located.organ, ORGAN_PART, _ORGAN_OPACITY),
        Body(plan.piece, PIECE, _PIECE_OPACITY),
    ]
    shaded(axes, [*bodies, *(Body(mesh, colour) for mesh, colour in parts.values())], view)
    for cut in plan.cuts:
        colour = _rgb(sweep_colour(cut.sweep, plan.sweeps))
        flat = cut.path_mm @ view[:2].T
        if cut.axis is not None:
            rear = flat - tools.electrode_mm * (view[:2] @ cut.axis)
            lines = np.stack([flat, rear], axis=1)[:: max(1, len(flat) // 12)]
            axes.add_collection(LineCollection(list(lines), colors=[(*colour, 0.35)], zorder=4))
        axes.plot(*flat.T, color=colour, linewidth=2.0, path_effects=_HALO, zorder=5)
        badge = {"boxstyle": "circle,pad=0.22", "facecolor": colour, "edgecolor": "white"}
        style: dict[str, Any] = {"color": "white", "weight": "bold", "fontsize": 7.5, "zorder": 10}
        at = (
            flat[0] if cut.axis is None else rear[len(rear) // 2] * 0.4 + flat[len(flat) // 2] * 0.6
        )
        axes.annotate(str(cut.sweep), tuple(at), bbox=badge, **style, **drawing.CENTRED)
    turn = np.linspace(0, 2 * np.pi, 60)
    rim_mm = tools.cup_radius_mm * np.stack([np.cos(turn), np.sin(turn)], 1) @ across(plan.lift)
    axes.plot(*((plan.grasp_mm + rim_mm) @ view[:2].T).T, color=_INK, linewidth=1.8, zorder=9)
    end, start = (plan.grasp_mm + np.outer([0.0, _COMING_MM], plan.lift)) @ view[:2].T
    arrow = {"arrowstyle": "-|>", "color": _INK, "shrinkA": 0, "shrinkB": 0, "lw": 1.8}
    axes.annotate("", end, start, arrowprops=arrow, zorder=9)
    for name, (mesh, _) in parts.items():
        if is_tumor(name) and name != plan.tumor:
            _write(axes, mesh.box_mm.mean(0) @ view[:2].T, _spoken(name))
    points = [located.organ.vertices_mm, *(cut.path_mm for cut in plan.cuts)]
    _finish(axes, view, np.concatenate([np.concatenate(points) @ view[:2].T, [start]]), _AROUND_MM)


def _draw_section(
    axes: Axes, cut: Cut, plan: ResectionPlan, located: Located, tools: Tools
) -> None:
    """The plane of the electrode and the place of a part that it comes nearest to; in red where it
    goes into one."""
    assert cut.axis is not None
    parts = _parts(located)
    far = np.arange(0.0, tools.electrode_mm + _ALONG_MM / 2, _ALONG_MM)
    points = (cut.path_mm[:, None] - np.outer(far, cut.axis)).reshape(-1, 3)
    found = {name: nearest(mesh, points, tools.radius_mm) for name, (mesh, _) in parts.items()}
    name, (mm, at, place_mm) = min(found.items(), key=lambda item: item[1][0])
    back, tip = -cut.axis, cut.path_mm[at // len(far)]
    aside = (place_mm - tip) - (place_mm - tip) @ back * back
    if np.linalg.norm(aside) < 0.5:
        aside = across(back)[0]
    away = np.cross(back, aside) / np.linalg.norm(np.cross(back, aside))
    up = np.eye(3)[2 if abs(away[2]) < 0.9 else 1]
    down = (up @ away) * away - up
    down /= np.linalg.norm(down)
    view = np.stack([np.cross(down, away), down, away])
    shapes = {"organ": (located.organ, ORGAN_PART), "piece": (plan.piece, PIECE), **parts}
    edges = [_draw_outline(axes, mesh, colour, view, tip) for mesh, colour in shapes.values()]
    flat = np.stack([tip, tip + tools.electrode_mm * back]) @ view[:2].T
    side = (flat[0] - flat[1])[::-1] * [1, -1]
    side *= tools.radius_mm / np.linalg.norm(side)
    rim = np.concatenate([flat + side, (flat - side)[::-1]])
    colour = _rgb(sweep_colour(cut.sweep, plan.sweeps))
    axes.fill(*rim.T, facecolor=colour, edgecolor="white", linewidth=0.6, zorder=6)
    ends = np.stack([points[at], place_mm]) @ view[:2].T
    axes.plot(*ends.T, color=_INK, linewidth=1.6, path_effects=_HALO, zorder=7)
    _finish(axes, view, np.concatenate([edges[1], flat[:1], ends]), 3 * _AROUND_MM)
    how = f"{mm:.1f} mm from" if mm >= 0 else f"{-mm:.1f} mm INTO"
    title = fill(f"sweep {cut.sweep}: {how} {_spoken(name)}", 34)
    axes.set_title(title, fontsize=10, fontweight="bold", color=_rgb(NONE) if mm < 0 else _INK)


def _draw_outline(
    axes: Axes, mesh: Mesh, colour: Colour, view: Axes3, through_mm: np.ndarray
) -> Float64[np.ndarray, "n 2"]:
    """A surface's section, filled if it is closed; points on it."""
    segments = plane_section(mesh.vertices_mm, mesh.faces, view[2], through_mm) @ view[:2].T
    axes.add_collection(
        LineCollection(list(segments), colors=[_rgb(colour)], linewidths=0.9, zorder=3)
    )
    if mesh.closed and len(segments):
        lines = shapely.set_precision(shapely.multilinestrings(list(segments)), 1e-6)
        for ring in shapely.get_parts(shapely.build_area(lines)):
            axes.fill(*np.array(ring.exterior.coords).T, color=(*_rgb(colour), 0.35), zorder=2)
    return segments.reshape(-1, 2)


def _finish(axes: Axes, view: Axes3, flat: Float[np.ndarray, "n 2"], around_mm: float) -> None:
    """Equal scales, a scale bar, and the two of the table's axes that are seen best."""
    (left, top), (right, low) = flat.min(0) - around_mm, flat.max(0) + around_mm
    axes.set(xlim=(left, right), ylim=(low, top), xticks=[], yticks=[])
    axes.set_aspect("equal")
    style: dict[str, Any] = {"transform": axes.transAxes, "fontsize": 8, "color": "0.35"}
    seen = sorted(zip("xyz", view[:2].T, strict=True), key=lambda item: -np.linalg.norm(item[1]))
    ways = [f"{letter} {_arrow(way)}" for letter, way in seen[:2]]
    axes.text(0.02, 0.97, "  ".join(ways), va="top", **style)
    length = max(n for n in (1, 2, 5, 10, 20, 50, 100) if n <= max(0.3 * (right - left), 1))
    bar = axes.plot([left + 1, left + 1 + length], [low - 2] * 2, color="black", linewidth=3)[0]
    bar.set_solid_capstyle("butt")
    axes.text(left + 1 + length / 2, low - 3, f"{length} mm", ha="center", fontsize=8)


def _arrow(way: Float[np.ndarray, " 2"]) -> str:
    """The sign nearest to a direction (right, down)."""
    return "→↘↓↙←↖↑↗"[round(float(np.arctan2(way[1], way[0])) / (np.pi / 4)) % 8]


def _words(figure: Figure, plan: ResectionPlan, located: Located, tools: Tools) -> None:
    """Warnings; title with the least distances; legend, volumes and all other notes."""
    least_mm = plan.least_mm or foreseen_mm(plan, located, tools)
    ml, warnings, tumor = plan.volumes_ml, plan.warnings, _spoken(plan.tumor)
    if not plan.clearances:  # else its notes say so
        deep = {name: -mm for name, mm in least_mm.items() if mm < 0 and is_tumor(name)}
        harm = [f"{CUTS_TUMOR} {name}, up to {mm:.1f} mm deep." for name, mm in deep.items()]
        warnings = (*harm, *warnings)
    count = f"{plan.sweeps} sweep" + ("s" if plan.sweeps > 1 else "")
    title = f"Plan to resect {tumor}, {located.patient}: {plan.method} method, {count}"
    lines = [
        f"{ml['piece']:.1f} ml come away with {ml['tumor']:.1f} ml of {tumor}; {lost_words(plan)}",
        f"{plan.exophytic:.0%} of the tumor outside the organ's hull; "
        f"{sum(cut.length_mm for cut in plan.cuts) / 10:.0f} cm of cuts",
        *(note for note in plan.notes if note not in plan.warnings),
    ]
    colours = {
        organ_first(located.meshes)[0]: ORGAN_PART,
        **{name: colour for name, (_, colour) in _parts(located).items()},
        "comes away": PIECE,
        **{f"sweep {n}": sweep_colour(n, plan.sweeps) for n in range(1, plan.sweeps + 1)},
    }
    handles: list[Any] = [Patch(color=_rgb(c), label=_spoken(name)) for name, c in colours.items()]
    handles.append(Line2D([], [], color=_INK, marker="o", mfc="none", mew=1.8, ls="", label="cup"))
    title = f"{title}\n{kept_words(plan, least_mm)}"
    drawing.add_words(figure, title, warnings, lines, handles)


def _parts(located: Located) -> dict[str, tuple[Mesh, Colour]]:
    """Tumors and structures, with their colours."""
    tumors = {n: (mesh, name_colour(n)) for n, mesh in located.meshes.items() if is_tumor(n)}
    structures = enumerate(located.structures.items())
    return tumors | {name: (mesh, structure_colour(n)) for n, (name, mesh) in structures}


def _rgb(colour: Colour) -> tuple[float, float, float]:
    red, green, blue = (value / 255 for value in colour)
    return red, green, blue


def _write(axes: Axes, place: Float[np.ndarray, " 2"], words: str) -> None:
    axes.annotate(words, tuple(place), path_effects=_HALO, zorder=9, **drawing.CENTRED)


def _spoken(name: str) -> str:
    return name.replace("_", " ")
