"""Parts of pictures: figures without a display, text that is never cut off, sections of meshes,
scale bars."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.text import Text

from tumortrack.core import colours
from tumortrack.core.geometry import plane_section
from tumortrack.core.raster import voxelise
from tumortrack.core.store import write_atomically
from tumortrack.core.types import FIRST_TUMOR, Mesh
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView, rgb
from tumortrack.report.wrapping import wrapped

ORGAN = rgb(colours.ORGAN_PART)
ESTIMATED = rgb(colours.part_colour(FIRST_TUMOR))  # of one tumor, or a curve
TRUE = rgb(colours.TRUTH)
OBSERVED = rgb(colours.OBSERVED)
_WARNING: dict[str, Any] = {
    **{"fontsize": 12, "fontweight": "bold", "color": "white"},
    "bbox": {"facecolor": rgb(colours.NONE), "edgecolor": "none", "boxstyle": "square,pad=0.3"},
}
SIGN = "\N{WARNING SIGN}"
_EDGE_IN = 0.17
CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}


def new_figure(width_in: float, height_in: float, **borders: float) -> Figure:
    """A figure without display or global state; ``borders`` as in ``subplots_adjust``."""
    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.subplots_adjust(**{"left": 0.02, "right": 0.98, "top": 0.9, "bottom": 0.03} | borders)
    return figure


def add_words(
    figure: Figure,
    title: str,
    warnings: Sequence[str] = (),
    below: Sequence[str] = (),
    handles: Sequence[Any] = (),
) -> None:
    """Add text to a finished figure, which grows by the height it takes: above the axes each
    warning in a red box, then title and legend; below them the lines ``below``. Call it once."""
    texts = [f"{SIGN} WARNING: {text}" for text in warnings]
    over: list[Text | Legend] = [*_paragraphs(figure, texts, _WARNING)]
    over += _paragraphs(figure, [title], {"fontsize": 13, "fontweight": "bold"})
    over += [_legend(figure, handles)] if handles else []
    under: list[Text | Legend] = [*_paragraphs(figure, below, {"fontsize": 10.5})]
    above_in, below_in = (
        sum(_height_in(figure, artist) for artist in artists) + _EDGE_IN * bool(artists)
        for artists in (over, under)
    )
    borders, old_in = figure.subplotpars, figure.get_figheight()
    axes_in = borders.bottom * old_in + below_in, borders.top * old_in + below_in
    new_in = old_in + above_in + below_in
    figure.set_figheight(new_in)
    figure.subplots_adjust(bottom=axes_in[0] / new_in, top=axes_in[1] / new_in)
    for artists, y_in in ((over, new_in - _EDGE_IN), (under, below_in)):
        for artist in artists:
            position = _EDGE_IN / figure.get_figwidth(), y_in / new_in
            if isinstance(artist, Legend):
                artist.set_bbox_to_anchor(position, figure.transFigure)
            else:
                artist.set_position(position)
            y_in -= _height_in(figure, artist)


def _paragraphs(figure: Figure, texts: Sequence[str], style: dict[str, Any]) -> Iterator[Text]:
    """Wrapped to the figure's width."""
    renderer = cast(FigureCanvasAgg, figure.canvas).get_renderer()
    font = FontProperties(size=style["fontsize"], weight=style.get("fontweight"))
    room = (figure.get_figwidth() - 3 * _EDGE_IN) * figure.dpi

    def length_of(text: str) -> float:
        return renderer.get_text_width_height_descent(text, font, False)[0]

    for text in texts:
        lines = wrapped(text, room, length_of)
        style = {"va": "top", "linespacing": 1.25, "parse_math": False, **style}
        yield figure.text(0, 0, "\n".join(lines), **style)


def _legend(figure: Figure, handles: Sequence[Any]) -> Legend:
    """Without a frame, in as few rows as the figure's width allows."""
    style: dict[str, Any] = {"loc": "upper left", "frameon": False, "fontsize": 9.5}
    style |= {"borderpad": 0, "borderaxespad": 0, "columnspacing": 1.4, "handlelength": 1.6}
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(handles=list(handles), ncols=columns, **style)
        width_in = legend.get_window_extent().width / figure.dpi
        if columns == 1 or width_in <= figure.get_figwidth() - 2 * _EDGE_IN:
            break
        legend.remove()
    return legend


def _height_in(figure: Figure, artist: Text | Legend) -> float:
    """With the space under it."""
    boxed = isinstance(artist, Text) and artist.get_bbox_patch() is not None
    return artist.get_window_extent().height / figure.dpi + (0.2 if boxed else 0.1)


def show_legend(
    figure: Figure, handles: list[Any], columns: int, corner: tuple[float, float]
) -> None:
    """A legend without a frame; ``corner`` is its upper right one, as shares of the figure."""
    style: dict[str, Any] = {"loc": "upper right", "frameon": False, "fontsize": 9.5}
    figure.legend(handles=handles, ncols=columns, bbox_to_anchor=corner, **style)


def save(figure: Figure, path: pathlib.Path) -> None:
    """Write the PNG atomically. Raises StorageError: the disk refused."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 3})  # half of 6's time
    write_atomically(path, buffer.getvalue())


def section(
    mesh: Mesh, view: ParallelView, through_mm: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "n 2 2"]:
    """Outline of a mesh in the view's plane through a point: segments as (right, down) mm."""
    ends_mm = plane_section(mesh.vertices_mm, mesh.faces, view.axes[2], through_mm)
    return view.project(ends_mm.reshape(-1, 3))[:, :2].reshape(-1, 2, 2)


def section_mask(
    mesh: Mesh, view: ParallelView, frame: Frame, through_mm: Float[np.ndarray, " 3"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of a frame that lie inside a closed mesh, in the view's plane through a point."""
    # Rays along the rows, so that only triangles in the plane are met
    (x, y), axes = frame.pixel_centres(), view.axes.T[:, [2, 1, 0]]
    data_from_index = np.eye(4)
    data_from_index[:3, :3] = axes * [1.0, y[1] - y[0], x[1] - x[0]]
    data_from_index[:3, 3] = axes @ [view.project(through_mm[None])[0, 2], y[0], x[0]]
    return voxelise(mesh, data_from_index, (1, len(y), len(x)))[0]


def show_bodies(axes: Axes, view: ParallelView, bodies: list[Body], frame: Frame) -> None:
    picture = view.draw(bodies, frame)
    axes.imshow(picture, extent=frame.extent, zorder=2, interpolation="bilinear")


def outline(
    axes: Axes, mesh: Mesh, view: ParallelView, color: RGB | str, width: float, **style: Any
) -> None:
    """Draw the mesh's silhouette as a contour."""
    around = view.frame_around(mesh.vertices_mm, 1.0)
    mask = view.silhouette(mesh, around)
    style |= {"levels": [0.5], "colors": [color], "linewidths": width}
    axes.contour(*around.pixel_centres(), mask, **style)


def draw_lines(axes: Axes, segments: Float[np.ndarray, "n 2 2"], **style: Any) -> None:
    codes = np.tile(np.array([Path.MOVETO, Path.LINETO], Path.code_type), len(segments))
    lines = Path(segments.reshape(-1, 2), codes)  # as one: many are slow
    axes.add_artist(PathPatch(lines, fill=False, capstyle="round", **style))


def finish_view(
    axes: Axes,
    frame: Frame,
    arrows: dict[str, tuple[float, float]] | None = None,
    background: str = "white",
) -> None:
    """Set up axes in mm with equal scales, down pointing down, without ticks, and a scale bar of a
    round length at the lower left. ``arrows``, at the upper left: letter of an axis -> direction
    (right, down)."""
    axes.set(xlim=(frame.left, frame.right), ylim=(frame.bottom, frame.top), aspect="equal")
    axes.set(xticks=[], yticks=[], facecolor=background)
    for spine in axes.spines.values():
        spine.set_color("0.8")
    width, height = frame.right - frame.left, frame.bottom - frame.top
    length = max(n for n in (1, 2, 5, 10, 20, 50, 100) if n <= max(0.3 * width, 1))
    x, y = frame.left + 0.05 * width, frame.bottom - 0.05 * height
    color = "black" if background == "white" else "white"
    axes.plot([x, x + length], [y, y], color=color, linewidth=3, solid_capstyle="butt")
    style: dict[str, Any] = {"color": color, "ha": "center", "va": "bottom", "fontsize": 9}
    axes.text(x + length / 2, y - 0.015 * height, f"{length} mm", **style)
    span, ways = 0.07 * min(width, height), arrows or {}
    rises = any(down < 0 for _, down in ways.values())  # arrows that point up start lower
    x, y = frame.left + 0.6 * span, frame.top + (2.1 if rises else 0.6) * span
    arrow = {"arrowstyle": "->", "color": "0.35", "shrinkA": 0, "shrinkB": 0}
    for letter, (right, down) in ways.items():
        axes.annotate("", (x + right * span, y + down * span), (x, y), arrowprops=arrow)
        spot = x + 1.5 * right * span, y + 1.5 * down * span
        axes.text(*spot, letter, color="0.35", fontsize=8, **CENTRED)
