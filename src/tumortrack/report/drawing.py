"""The parts pictures are drawn with: figures without a display, sections of meshes, scale bars."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.imaging.raster import voxelise
from tumortrack.report.shade import Frame, ShadedView, pixel_centres

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KIDNEY = (185 / 255, 102 / 255, 83 / 255)
ESTIMATED = (230 / 255, 140 / 255, 0.0)
TRUE = (0.0, 90 / 255, 160 / 255)
OBSERVED = (0.25, 0.25, 0.25)


def new_figure(width_in: float, height_in: float) -> Figure:
    """A figure without display or global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.subplots_adjust(left=0.02, right=0.98, top=0.9, bottom=0.03)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write the PNG atomically.

    Raises:
        StorageError: the disk refused.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue())


def section(
    mesh: Mesh, view: ShadedView, through_mm: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "n 2 2"]:
    """Outline of a mesh in the view's plane through a point: segments as (right, down) mm."""
    flat = view.project(mesh.vertices_mm)
    side = flat[:, 2] - view.project(through_mm[None])[0, 2]
    side = np.where(side == 0, 1e-9, side)  # no corner lies in the plane: always two crossings
    up = side[mesh.faces] > 0
    cut = mesh.faces[up.any(1) & ~up.all(1)]
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        start, end = cut[:, a], cut[:, b]
        gap = np.where(side[start] * side[end] < 0, side[start] - side[end], np.nan)
        share = (side[start] / gap)[:, None]
        ends.append(flat[start, :2] + share * (flat[end, :2] - flat[start, :2]))
    both = np.stack(ends, axis=1)
    return both[~np.isnan(both[:, :, 0])].reshape(-1, 2, 2)


def draw_lines(axes: Axes, segments: Float[np.ndarray, "n 2 2"], **style: Any) -> None:
    """Draw an outline's segments as one collection."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(segments), capstyle="round", **style))


def scale_bar(axes: Axes, frame: Frame, color: str = "black") -> None:
    """A bar of a round length in mm, in the lower left corner."""
    width, height = frame.right - frame.left, frame.bottom - frame.top
    length = max(n for n in (1, 2, 5, 10, 20, 50, 100) if n <= max(0.3 * width, 1))
    x, y = frame.left + 0.05 * width, frame.bottom - 0.05 * height
    axes.plot([x, x + length], [y, y], color=color, linewidth=3, solid_capstyle="butt")
    axes.text(
        x + length / 2,
        y - 0.015 * height,
        f"{length} mm",
        color=color,
        ha="center",
        va="bottom",
        fontsize=9,
    )


def axis_arrows(axes: Axes, frame: Frame, arrows: dict[str, tuple[float, float]]) -> None:
    """Small arrows that name the frame's axes, by their letters and directions (right, down), in
    the upper left corner; those that point up begin lower."""
    span = 0.07 * min(frame.right - frame.left, frame.bottom - frame.top)
    rises = any(down < 0 for _, down in arrows.values())
    x, y = frame.left + 0.6 * span, frame.top + (2.1 if rises else 0.6) * span
    for letter, (right, down) in arrows.items():
        axes.annotate(
            "",
            (x + right * span, y + down * span),
            (x, y),
            arrowprops={"arrowstyle": "->", "color": "0.35", "shrinkA": 0, "shrinkB": 0},
        )
        axes.text(
            x + 1.5 * right * span,
            y + 1.5 * down * span,
            letter,
            color="0.35",
            fontsize=8,
            ha="center",
            va="center",
        )


def blank(axes: Axes, frame: Frame, background: str = "white") -> None:
    """Axes in mm, down pointing down, equal scales, without ticks."""
    axes.set(xlim=(frame.left, frame.right), ylim=(frame.bottom, frame.top), aspect="equal")
    axes.set(xticks=[], yticks=[], facecolor=background)
    for spine in axes.spines.values():
        spine.set_color("0.8")


def section_mask(
    mesh: Mesh, view: ShadedView, frame: Frame, through_mm: Float[np.ndarray, " 3"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of a frame that lie inside a closed mesh, in the view's plane through a point."""
    x, y = pixel_centres(frame)
    axes = np.stack([view.down, view.right, np.cross(view.right, view.down)], axis=1).astype(float)
    depth = view.project(through_mm[None])[0, 2]
    data_from_index = np.eye(4)
    data_from_index[:3, :3] = axes * [y[1] - y[0], x[1] - x[0], 1.0]
    data_from_index[:3, 3] = axes @ [y[0], x[0], depth]
    return voxelise(mesh, data_from_index, (len(y), len(x), 1))[:, :, 0]


def tint(axes: Axes, mask: Bool[np.ndarray, "h w"], frame: Frame, color: tuple[float, ...]) -> None:
    """Lay a translucent colour over the mask."""
    picture = np.empty((*mask.shape, 4))
    picture[...] = (*color, 0.0)
    picture[mask, 3] = 0.25
    axes.imshow(picture, extent=frame.extent, zorder=1)
