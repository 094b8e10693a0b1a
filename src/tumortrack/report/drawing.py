"""The parts pictures are drawn with: figures without a display, sections of meshes, scale bars."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from tumortrack.core import colours
from tumortrack.core.geometry import plane_section
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import voxelise
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView, rgb

ORGAN = rgb(colours.ORGAN_PART)
ESTIMATED = (230 / 255, 140 / 255, 0.0)
TRUE = (0.0, 90 / 255, 160 / 255)
OBSERVED = (0.25, 0.25, 0.25)
CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}


def new_figure(width_in: float, height_in: float, **borders: float) -> Figure:
    """A figure without display or global state; ``borders`` as in ``subplots_adjust``."""
    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.subplots_adjust(**{"left": 0.02, "right": 0.98, "top": 0.9, "bottom": 0.03} | borders)
    return figure


def show_legend(
    figure: Figure, handles: list[Any], columns: int, corner: tuple[float, float], **style: Any
) -> None:
    """A legend without a frame; ``corner`` is its upper right one, as shares of the figure."""
    style = {"loc": "upper right", "frameon": False, "fontsize": 9.5, **style}
    figure.legend(handles=handles, ncols=columns, bbox_to_anchor=corner, **style)


def save(figure: Figure, path: Path) -> None:
    """Write the PNG atomically. Raises StorageError: the disk refused."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
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
    (x, y), axes = frame.pixel_centres(), view.axes.T[:, [1, 0, 2]]
    data_from_index = np.eye(4)
    data_from_index[:3, :3] = axes * [y[1] - y[0], x[1] - x[0], 1.0]
    data_from_index[:3, 3] = axes @ [y[0], x[0], view.project(through_mm[None])[0, 2]]
    return voxelise(mesh, data_from_index, (len(y), len(x), 1))[:, :, 0]


def show_bodies(axes: Axes, view: ParallelView, bodies: list[Body], frame: Frame) -> None:
    """Draw shaded bodies on white."""
    picture = view.draw(bodies, frame)
    axes.imshow(picture, extent=frame.extent, zorder=2, interpolation="bilinear")


def outline(
    axes: Axes, mesh: Mesh, view: ParallelView, frame: Frame, color: RGB | str, width: float,
    **style: Any,
) -> None:  # fmt: skip
    """Draw the contour of what the mesh covers."""
    x, y = np.meshgrid(*frame.pixel_centres())
    mask = view.silhouette(mesh, frame)
    axes.contour(x, y, mask, levels=[0.5], colors=[color], linewidths=width, **style)


def draw_lines(axes: Axes, segments: Float[np.ndarray, "n 2 2"], **style: Any) -> None:
    """Draw a section's segments as one collection."""
    axes.add_collection(LineCollection(list(segments), capstyle="round", **style))


def tint(axes: Axes, mask: Bool[np.ndarray, "h w"], frame: Frame, color: RGB) -> None:
    """Lay a translucent colour over the mask."""
    picture = np.where(mask[..., None], (*color, 0.25), (*color, 0.0))
    axes.imshow(picture, extent=frame.extent, zorder=1)


def finish_view(
    axes: Axes,
    frame: Frame,
    arrows: dict[str, tuple[float, float]] | None = None,
    background: str = "white",
) -> None:
    """Axes in mm, down pointing down, equal scales, without ticks; a scale bar of a round length
    in the lower left corner. ``arrows``, in the upper left one, name the frame's axes by letter
    and direction (right, down)."""
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
    rises = any(down < 0 for _, down in ways.values())  # those that point up begin lower
    x, y = frame.left + 0.6 * span, frame.top + (2.1 if rises else 0.6) * span
    arrow = {"arrowstyle": "->", "color": "0.35", "shrinkA": 0, "shrinkB": 0}
    for letter, (right, down) in ways.items():
        axes.annotate("", (x + right * span, y + down * span), (x, y), arrowprops=arrow)
        spot = x + 1.5 * right * span, y + 1.5 * down * span
        axes.text(*spot, letter, color="0.35", fontsize=8, **CENTRED)
