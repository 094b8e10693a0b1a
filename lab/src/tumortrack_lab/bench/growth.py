"""The curves as one picture: time above, memory below, a column for each kind of work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.bench.row import Point

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours; each curve has a marker of its own too.
_STYLES = {
    "clinic": ("#D55E00", "*"),
    "quick": ("#0072B2", "o"),
    "paper": ("#009E73", "s"),
    "training": ("#000000", "v"),
}
_ALONG = {
    "queries": "queries",
    "points": "points of the cloud",
    "tumors": "tumors",
    "grid": "voxels along the longest side",
    "batch": "samples in a training step",
}
_MIB = 2**20
_LINEAR = "tumors"  # the other axes are logarithmic


def draw_growth(points: Sequence[Point], path: Path) -> None:
    """Write the PNG."""
    curves = [curve for curve in _ALONG if any(point.curve == curve for point in points)]
    drawing = new_figure(3.6 * len(curves), 6.4)
    width = 1 / len(curves)
    for column, curve in enumerate(curves):
        mine = [point for point in points if point.curve == curve]
        left = (column + 0.2) * width
        above = drawing.add_axes((left, 0.55, 0.76 * width, 0.4))
        below = drawing.add_axes((left, 0.09, 0.76 * width, 0.36))
        _lines(above, mine, [point.seconds for point in mine])
        _lines(below, mine, [(point.peak_bytes or 0) / _MIB for point in mine])
        above.set_yscale("log")
        below.set_ylim(bottom=0)
        below.set_xlabel(_ALONG[curve])
        above.legend(fontsize=7, frameon=False)
        if column == 0:
            above.set_ylabel("seconds, one core")
            below.set_ylabel("peak memory of the process, MiB")
    save(drawing, path)


def _lines(axes: Axes, points: Sequence[Point], values: list[float]) -> None:
    names = dict.fromkeys(point.what for point in points)
    for name in names:
        color, marker = _STYLES[name.replace(",", " ").split()[0]]
        chosen = [(p.size, v) for p, v in zip(points, values, strict=True) if p.what == name]
        axes.plot(*zip(*chosen, strict=True), color=color, marker=marker, label=name, linewidth=1.5)
    sizes = sorted({point.size for point in points})
    if points[0].curve != _LINEAR:
        axes.set_xscale("log")
    axes.set_xticks(sizes, [_short(size) for size in sizes])
    axes.minorticks_off()
    axes.grid(alpha=0.25)
    axes.tick_params(labelsize=8)


def _short(size: int) -> str:
    for unit, name in ((10**6, "M"), (10**3, "k")):
        if size >= unit:
            return f"{size / unit:g}{name}"
    return str(size)
