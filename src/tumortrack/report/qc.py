"""The picture that shows a prepared case: is everything outlined, and on the right side?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Shaped

from tumortrack.core.geometry import DIRECTIONS_LPS, transform_points
from tumortrack.core.types import Anatomy, LabelVolume, Volume
from tumortrack.report.drawing import (
    KIDNEY,
    draw_lines,
    finish_view,
    new_figure,
    save,
    section,
    show_legend,
)
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# On grey, apart in every colour vision: organ light orange, tumors yellow, sky blue, green, purple.
_ORGAN_LINE = (1.0, 0.62, 0.45)
_TUMOR_COLORS = ((0.97, 0.88, 0.22), (0.34, 0.71, 0.91), (0.56, 0.93, 0.56), (0.85, 0.55, 0.75))
_SOFT_TISSUE_HU = (-160.0, 240.0)
_MARGIN_MM, _ASPECT = 18.0, 1.22
_MOST_ROWS = 6  # tumors with slices of their own
_BORDERS = {
    "left": (0.025, 0.5),
    "right": (0.975, 0.5),
    "top": (0.5, 0.965),
    "bottom": (0.5, 0.035),
}


# The slices' views in LPS. Radiological convention: the patient's right is on the picture's left
# (axial seen from the feet, coronal from the front); sagittal with anterior on the left.
PLANES = (
    ParallelView("axial", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ParallelView("coronal", (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ParallelView("sagittal", (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
)


def border_letters(view: ParallelView) -> dict[str, str]:
    """Where the patient's sides lie: left, right, top, bottom of the picture -> L R A P S I."""
    right, down, _ = view.axes
    towards = {"right": right, "left": -right, "bottom": down, "top": -down}
    names = {tuple(np.array(v)): n[0].upper() for n, v in DIRECTIONS_LPS.items()}
    return {border: names[tuple(v)] for border, v in towards.items()}


def slice_volume(
    array: Shaped[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    view: ParallelView,
    frame: Frame,
    through_mm: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "h w"]:
    """A volume's values (nearest voxel, NaN outside) in the view's plane through a point.

    Row 0 is the frame's top, column 0 its left, as in ``ParallelView.draw``.
    """
    x, y = np.meshgrid(*frame.pixel_centres())
    depth = view.project(through_mm[None])[0, 2]
    lps = np.stack([x, y, np.full_like(x, depth)], axis=-1).reshape(-1, 3) @ view.axes
    index = transform_points(np.linalg.inv(lps_from_index), lps)
    index = np.floor(index + 0.5).astype(int)
    inside = ((index >= 0) & (index < array.shape)).all(1)
    values = np.full(len(index), np.nan)
    values[inside] = array[tuple(index[inside].T)]
    return values.reshape(x.shape)


def qc_picture(case_labels: LabelVolume, ct: Volume | None, anatomy: Anatomy, path: Path) -> None:
    """Orthogonal slices with outlines, a row through each tumor, and a 3-D view: what to check a
    prepared case by.

    Args:
        case_labels: shown as grey where there is no CT; patient frame.
        ct: the CT behind it, if there is one.
        anatomy: the prepared surfaces, in the same patient frame (LPS, mm). Of more than
            six tumors the six largest have rows.
        path: PNG to write, atomically.
    """
    order = sorted(range(len(anatomy.tumors)), key=lambda n: -abs(anatomy.tumors[n].volume_mm3))
    rows = sorted(order[:_MOST_ROWS])
    titles = [anatomy.names[n + 1].replace("_", " ") for n in rows] or ["kidney"]
    through = [anatomy.tumors[n] for n in rows] or [anatomy.organ]
    height = 3.85 * len(through)
    figure = new_figure(18.0, height + 1.0)
    figure.subplots_adjust(
        top=height / (height + 1.0), left=0.025, right=0.99, bottom=0.05 / (height + 1.0)
    )
    grid = figure.add_gridspec(len(through), 4, wspace=0.03, hspace=0.12)
    shown: LabelVolume | Volume = ct if ct is not None else case_labels
    window = _window(shown, anatomy)
    for row, (title, part) in enumerate(zip(titles, through, strict=True)):
        for column, view in enumerate(PLANES):
            axes = figure.add_subplot(grid[row, column])
            _draw_slice(axes, (shown, window), anatomy, view, part.box_mm.mean(0))
            if column == 0:
                axes.set_ylabel(f"through {title}", fontsize=12, fontweight="bold")
    _draw_solid(figure.add_subplot(grid[:, 3]), anatomy)
    what = "CT" if ct is not None else "label map"
    dropped = len(order) - len(rows)
    more = f" (slices through the {_MOST_ROWS} largest of {len(order)} tumors)" if dropped else ""
    figure.suptitle(f"Prepared case over its {what}{more}", x=0.015, ha="left", fontweight="bold")
    show_legend(figure, _legend(anatomy), 6, (0.99, 0.995))
    save(figure, path)


def _draw_slice(
    axes: Axes,
    background: tuple[Volume | LabelVolume, tuple[float, float]],
    anatomy: Anatomy,
    view: ParallelView,
    through_mm: Float[np.ndarray, " 3"],
) -> None:
    frame = _same_scale(view, anatomy)
    shown, (low, high) = background
    array = shown.hu if isinstance(shown, Volume) else shown.labels
    values = slice_volume(array, shown.lps_from_index, view, frame, through_mm)
    axes.imshow(np.ma.masked_invalid(values), cmap="gray", vmin=low, vmax=high, extent=frame.extent)
    colors = (_ORGAN_LINE, *(_tumor_color(n) for n in range(len(anatomy.tumors))))
    for color, part in zip(colors, anatomy.parts, strict=True):
        draw_lines(axes, section(part, view, through_mm), color=color, linewidth=1.7)
    finish_view(axes, frame, background="black")
    _write_letters(axes, view, "white")
    axis = int(np.argmax(np.abs(view.axes[2])))
    letter = ("LPS" if through_mm[axis] >= 0 else "RAI")[axis]
    where = f"{letter} {abs(through_mm[axis]):.1f} mm"
    axes.set_title(f"{view.name}, {where}", fontsize=10.5)


def _draw_solid(axes: Axes, anatomy: Anatomy) -> None:
    view = PLANES[1]
    frame = view.frame_around(anatomy.organ.vertices_mm, 8.0).widened(_ASPECT)
    bodies = [Body(tumor, _tumor_color(n)) for n, tumor in enumerate(anatomy.tumors)]
    picture = view.draw([*bodies, Body(anatomy.organ, KIDNEY, 0.38)], frame)
    axes.imshow(picture, extent=frame.extent, interpolation="bilinear")
    finish_view(axes, frame)
    _write_letters(axes, view, "black")
    axes.set_title("3-D, seen from the front", fontsize=10.5)


def _write_letters(axes: Axes, view: ParallelView, color: str) -> None:
    style: dict[str, Any] = {
        "ha": "center",
        "va": "center",
        "fontsize": 13,
        "fontweight": "bold",
        "color": color,
    }
    for border, letter in border_letters(view).items():
        axes.text(*_BORDERS[border], letter, transform=axes.transAxes, gid=border, **style)


def _tumor_color(number: int) -> RGB:
    return _TUMOR_COLORS[number % len(_TUMOR_COLORS)]


def _same_scale(view: ParallelView, anatomy: Anatomy) -> Frame:
    """A frame about the organ, equally large in all planes, so that lengths compare."""
    size_mm = float(np.ptp(anatomy.organ.box_mm, axis=0).max()) + 2 * _MARGIN_MM
    right, down, _ = view.project(anatomy.organ.box_mm.mean(0)[None])[0].tolist()
    half = size_mm / 2
    return Frame(right - _ASPECT * half, right + _ASPECT * half, down - half, down + half)


def _window(shown: Volume | LabelVolume, anatomy: Anatomy) -> tuple[float, float]:
    """Grey range: soft tissue, opened upwards as far as the organ and its tumors need."""
    if isinstance(shown, LabelVolume):
        return 0.0, float(shown.labels.max()) * 1.6 + 1e-6
    low, high = _SOFT_TISSUE_HU
    inner = np.concatenate([0.7 * p.vertices_mm + 0.3 * p.box_mm.mean(0) for p in anatomy.parts])
    index = np.rint(transform_points(np.linalg.inv(shown.lps_from_index), inner)).astype(int)
    index = index[((index >= 0) & (index < shown.hu.shape)).all(1)]
    brightest = float(np.percentile(shown.hu[tuple(index.T)], 98)) if len(index) else high
    return low, max(high, 1.15 * brightest)


def _legend(anatomy: Anatomy) -> list[Any]:
    from matplotlib.patches import Patch

    colors = [_ORGAN_LINE, *(_tumor_color(n) for n in range(len(anatomy.tumors)))]
    return [
        Patch(facecolor=color, label=f"{name.replace('_', ' ')} {part.volume_mm3 / 1000:.1f} ml")
        for color, name, part in zip(colors, anatomy.names, anatomy.parts, strict=True)
    ]
