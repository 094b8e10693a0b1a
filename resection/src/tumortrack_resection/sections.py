"""From where a plan is looked at; a section for each sweep, through the electrode where it comes
nearest to a part; and what both have in common."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import numpy as np
from jaxtyping import Bool
from matplotlib.axes import Axes
from matplotlib.patheffects import Normal, Stroke

from tumortrack.core.colours import NONE, PIECE, name_colour, structure_colour
from tumortrack.core.organ import is_tumor
from tumortrack.core.types import Mesh
from tumortrack.report import drawing
from tumortrack.report.drawing import CENTRED
from tumortrack.report.renderer import RGB, Frame, ParallelView, rgb
from tumortrack_resection.facets import Tools
from tumortrack_resection.sweeps import Sweep
from tumortrack_resection.values import Located, ResectionPlan

INK = (0.1, 0.1, 0.12)
HALO = [Stroke(linewidth=2.5, foreground="white"), Normal()]
ORGAN_OPACITY, PIECE_OPACITY = 0.36, 0.25
_PART_OPACITY = 0.85
_AROUND_MM = 5.0  # what is shown beside the piece and the electrode
_LINK_MM = 0.5  # a shorter way gives the section no direction
_NEAR_MM = 15.0  # distances that are written
_LETTERS = 48  # in a line of a title
_SMALL, _OVER = 0.03, 0.1  # shares of what is shown
_LEAST, _ALIKE = 0.45, 0.87  # length of an axis' arrow; cosine between two
_INSIDE = (0.12, 0.15), (0.8, 0.88)  # where names may stand: shares of height and width


def side_view(plan: ResectionPlan, located: Located) -> ParallelView:
    """Level, across the way from the tumor to the nearest other one, or else to the organ's middle,
    so that both lie beside each other; from the side on which the tumor is in front."""
    tumors = {n: m.box_mm.mean(0) for n, m in located.meshes.items() if is_tumor(n)}
    middle, whole_mm = tumors.pop(plan.tumor), located.organ.box_mm.mean(0)
    nearest = min(tumors.values(), key=lambda at: np.linalg.norm(at - middle), default=whole_mm)
    way = (nearest - middle)[:2]
    right = way / np.linalg.norm(way) if np.linalg.norm(way) > 1.0 else np.array([1.0, 0.0])
    if (middle - whole_mm)[:2] @ [-right[1], right[0]] > 0:
        right = -right
    x, y = right.tolist()
    return ParallelView("from the side", (x, y, 0.0), (0.0, 0.0, -1.0))


def section_view(sweep: Sweep, plan: ResectionPlan) -> tuple[ParallelView, Frame]:
    """The plane through the electrode and the place of a part that it comes nearest to; across the
    facet, if that lies straight ahead. What is higher is higher in the picture."""
    near = min(sweep.near.values(), key=lambda each: each.mm)
    back, aside = sweep.back[near.pose], near.part_mm - near.axis_mm
    aside = aside - (aside @ back) * back
    if np.linalg.norm(aside) < _LINK_MM:
        aside = plan.facets[sweep.number - 1, :3] if len(plan.facets) else np.array([0.0, 0.0, 1.0])
    ahead = np.cross(back, aside)
    ahead /= np.linalg.norm(ahead)
    up = np.eye(3)[2 if abs(ahead[2]) < 0.9 else 1]
    down = (up @ ahead) * ahead - up
    down /= np.linalg.norm(down)
    right = np.cross(down, ahead)
    right = right if right[0] >= 0 else -right
    view = ParallelView("", tuple(right.tolist()), tuple(down.tolist()))
    ends = np.stack([sweep.lines[near.pose, 0], sweep.along(near.pose), near.part_mm])
    edge = drawing.section(plan.piece, view, ends[0]).reshape(-1, 2)
    flat = np.concatenate([edge, view.project(ends)[:, :2]])
    (left, top), (far, low) = flat.min(0) - _AROUND_MM, flat.max(0) + _AROUND_MM
    return view, Frame(float(left), float(far), float(top), float(low))


def draw_section(
    axes: Axes, view: ParallelView, frame: Frame, plan: ResectionPlan, located: Located,
    sweep: Sweep, tools: Tools,
) -> None:  # fmt: skip
    """Organ, piece and parts, the electrode as wide as it is, and its way to the nearest part; the
    title says how far that is, in red if the electrode goes into it."""
    near = min(sweep.near.values(), key=lambda each: each.mm)
    through = sweep.lines[near.pose, 0]
    picture = np.ones((*frame.size(0.25)[::-1], 3))

    def paint(mesh: Mesh, colour: RGB, opacity: float) -> Bool[np.ndarray, "h w"]:
        there = drawing.section_mask(mesh, view, frame, through)
        picture[there] += opacity * (np.array(colour) - picture[there])
        edge = drawing.section(mesh, view, through)
        drawing.draw_lines(axes, edge, color=colour, linewidth=0.9, zorder=3)
        return there

    paint(located.organ, drawing.ORGAN, ORGAN_OPACITY)
    paint(plan.piece, rgb(PIECE), PIECE_OPACITY)
    for name, mesh in parts_of(located).items():
        there = paint(mesh, colour_of(name, located), _PART_OPACITY * mesh.closed)
        if there.any():
            pixels = np.argwhere(there)
            own = sweep.near.get(name)
            said = (
                f"\n{abs(own.mm):.1f} mm{' deep' * (own.mm < 0)}"
                if own is not None and own.mm < _NEAR_MM
                else ""
            )
            spot = pixels.mean(0) / there.shape
            if len(pixels) < _SMALL * there.size:  # over it: it would be hidden
                spot[0] = pixels[:, 0].min() / there.shape[0] - _OVER
            shares = spot.clip(*_INSIDE)[::-1]
            size = np.array([frame.width_mm, frame.bottom - frame.top])
            x, y = [frame.left, frame.top] + shares * size
            write(axes, (float(x), float(y)), spoken(name) + said, colour_of(name, located))
    axes.imshow(picture, extent=frame.extent, zorder=2, interpolation="bilinear")
    flat = view.project(sweep.lines[near.pose])[:, :2]
    side = (flat[0] - flat[1])[::-1] * [1, -1]
    side *= tools.radius_mm / np.linalg.norm(side)
    rim = np.concatenate([flat + side, (flat - side)[::-1]])
    axes.fill(*rim.T, facecolor=rgb(sweep.colour), edgecolor="white", linewidth=0.6, zorder=6)
    ends = view.project(np.stack([near.axis_mm, near.part_mm]))[:, :2]
    axes.plot(*ends.T, color=INK, linewidth=1.6, path_effects=HALO, zorder=7)
    drawing.finish_view(axes, frame, arrows(view))
    axes.set_title(title_of(sweep), fontsize=10, fontweight="bold",
                   color=rgb(NONE) if near.mm < 0 else INK)  # fmt: skip


def title_of(sweep: Sweep) -> str:
    """The sweep, and how near it comes to which part."""
    part, near = min(sweep.near.items(), key=lambda item: item[1].mm)
    return fill(f"sweep {sweep.number}: {_far(near.mm)} {spoken(part)}", _LETTERS)


def _far(mm: float) -> str:
    return f"{mm:.1f} mm from" if mm >= 0 else f"{-mm:.1f} mm INTO"


def parts_of(located: Located) -> dict[str, Mesh]:
    """Tumors and structures."""
    tumors = {name: mesh for name, mesh in located.meshes.items() if is_tumor(name)}
    return {**tumors, **located.structures}


def colour_of(name: str, located: Located) -> RGB:
    structures = list(located.structures)
    return rgb(
        structure_colour(structures.index(name)) if name in structures else name_colour(name)
    )


def spoken(name: str) -> str:
    return name.replace("_", " ")


def write(axes: Axes, place: tuple[float, float], words: str, paper: RGB | None = None) -> None:
    style: dict[str, Any] = {**CENTRED, "path_effects": HALO, "zorder": 9}
    if paper is not None:
        style["bbox"] = {"boxstyle": "round,pad=0.25", "facecolor": paper, "edgecolor": "white"}
    axes.text(*place, words, **style)


def arrows(view: ParallelView) -> dict[str, tuple[float, float]]:
    """The table's axes as they are seen, the two that are seen best; none points to the left."""
    flat = {letter: way[:2] for letter, way in zip("xyz", view.project(np.eye(3)), strict=True)}
    shown: dict[str, np.ndarray] = {}
    for letter, way in sorted(flat.items(), key=lambda item: -np.linalg.norm(item[1]).round(6)):
        name, seen = (letter, way) if way[0] > -0.1 else (f"\N{MINUS SIGN}{letter}", -way)
        long = float(np.linalg.norm(seen))
        alike = any(seen @ one > _ALIKE * long * np.linalg.norm(one) for one in shown.values())
        if long >= _LEAST and not alike and len(shown) < 2:
            shown[name] = seen
    return {name: (float(u), float(v)) for name, (u, v) in shown.items()}
