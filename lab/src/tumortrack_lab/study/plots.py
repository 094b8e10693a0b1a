"""The study's pictures: errors against depth, displacement and severity; a gallery.

Colours are Okabe and Ito's (told apart by every colour vision); each method also has a marker of
its own, so that the plots read in grey.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.report.drawing import new_figure, save, show_legend
from tumortrack.report.pictures import FROM_SIDE, draw_solid_view, scene_legend
from tumortrack.report.protocol import compare
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack_lab.study import tables as of
from tumortrack_lab.study.measure import Job
from tumortrack_lab.study.tables import by_seed, groups, label_of, names, spaced, tumors
from tumortrack_lab.twin.faults import KINDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

_STYLES = {
    "M_lim": ("#0072B2", "o"),
    "M_full": ("#E69F00", "s"),
    "clinic": ("#D55E00", "*"),
    "rigid_bound": ("#000000", "x"),
    "rigid": ("#7F7F7F", "v"),
    "cpd": ("#CC79A7", "^"),
    "bcpd": ("#56B4E9", "D"),
    "elastic": ("#009E73", "P"),
}
_BANDS = 8  # groups of equally many points along a curve
_FEWEST = 40  # points in a group
_ALONG = {
    "depth_mm": "depth below the visible surface",
    "displacement_mm": "displacement left after the best rigid motion",
}
_DASHES: tuple[Literal["-", "--", ":", "-."], ...] = ("-", "--", ":", "-.")  # by tumor
_LEAST_MM = 0.1  # the scale of severities is logarithmic
_TICKS_MM = (1, 2, 5, 10, 20, 50)


def _style(method: str) -> dict[str, Any]:
    color, marker = _STYLES.get(method, ("#56B4E9", "h"))
    return {"color": color, "marker": marker}


def error_against(frame: pd.DataFrame, key: str, path: Path) -> bool:
    """Error of points of the tumors' true surfaces against ``depth_mm`` or ``displacement_mm``:
    medians of groups of equally many points, the middle half shaded for the first two methods.
    False, and nothing drawn, where no measurement has such points."""
    known = frame[frame[key].notna()]
    curves = {
        method: (np.concatenate([*mine[key]]), np.concatenate([*mine.error_mm]))
        for (method,), mine in groups(known, "method")
    }
    curves = {name: curve for name, curve in curves.items() if len(curve[0]) >= _FEWEST}
    if not curves:
        return False
    highest = 1.0
    drawing = new_figure(9.4, 4.6)
    axes = drawing.add_axes((0.075, 0.125, 0.6, 0.8))
    for number, (method, (x, error)) in enumerate(curves.items()):
        order, style = np.argsort(x, kind="stable"), _style(method)
        parts = np.array_split(order, min(_BANDS, len(x) // (_FEWEST // 4)))
        at = np.array([np.median(x[part]) for part in parts])
        low, middle, high = np.transpose([np.percentile(error[p], (25, 50, 75)) for p in parts])
        highest = max(highest, 1.25 * float(middle.max()))
        if number < 2:
            axes.fill_between(at, low, high, color=style["color"], alpha=0.13, linewidth=0)
        axes.plot(at, middle, linewidth=2, label=label_of(method), **style)
    axes.set(xlabel=f"{_ALONG[key]}, mm", ylabel="distance to the estimated tumor surface, mm")
    axes.set_ylim(0, highest)  # bands may go beyond: a bad method must not flatten the others
    axes.set_xlim(left=0)
    _tidy(axes)
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False, fontsize=9.5, alignment="left",
        title="median of each eighth of the points\n(band: middle half)", title_fontsize=9,
    )  # fmt: skip
    axes.set_title(f"Tumor error against {_ALONG[key]}", loc="left", fontsize=12)
    save(drawing, path)
    return True


def _handles(lines: dict[str, dict[str, Any]]) -> list[Line2D]:
    """Of a legend: by their labels."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], label=label, **style) for label, style in lines.items()]


def severity_curves(frame: pd.DataFrame, path: Path) -> None:
    """Hausdorff distance of each tumor against each kind's level, by the rule of the table. Errors
    are on a logarithmic scale: what matters is by which factor they grow."""
    kinds = [kind for kind in KINDS if of.levels_of(frame, kind)]
    columns = min(4, max(len(kinds), 1))
    rows = -(-max(len(kinds), 1) // columns)
    width, height = 3.1 * columns, rows * 2.75 + 0.45
    drawing = new_figure(width + 0.35, height)
    panels = drawing.subplots(rows, columns, squeeze=False, sharey=True)
    drawing.subplots_adjust(
        left=0.6 / width, right=0.985, top=1 - 0.45 / height, bottom=0.5 / height, wspace=0.1,
        hspace=0.38,
    )  # fmt: skip
    dashes = [*zip(names(tumors(frame), "part"), _DASHES, strict=False)]
    for axes, kind in zip(panels.flat, kinds, strict=False):
        for (method,), mine in groups(frame, "method"):
            levels = of.levels_of(mine, kind)
            for tumor, dash in dashes:
                here = [(level, rows[rows.part == tumor]) for level, rows in levels]
                _severity_curve(axes, here, {**_style(method), "linestyle": dash})
        axes.set_xlabel(of.SEVERITIES[kind])
        if kind in of.FALLING:
            axes.invert_xaxis()
        _tidy(axes)
    for axes in panels.flat[len(kinds) :]:
        axes.set_visible(False)
    first = panels[0, 0]
    first.set_yscale("log")
    first.set_yticks(_TICKS_MM, [str(tick) for tick in _TICKS_MM], minor=False)
    first.set_yticks([], minor=True)
    low, high = first.get_ylim()
    first.set_ylim(min(low, 0.9), max(high, 11.0))
    for row in panels:
        row[0].set_ylabel("tumor Hausdorff distance, mm")
    lines = {label_of(method): _style(method) for method in names(frame, "method")}
    lines |= {spaced(tumor): {"color": "0.3", "linestyle": dash} for tumor, dash in dashes}
    drawing.legend(
        handles=_handles({label: {"lw": 1.6, **style} for label, style in lines.items()}),
        loc="upper left", bbox_to_anchor=(0.04, 1.0), ncols=4, frameon=False, fontsize=10,
    )  # fmt: skip
    save(drawing, path)


def _severity_curve(
    axes: Axes, levels: list[tuple[float, pd.DataFrame]], style: dict[str, Any]
) -> None:
    middles, lost = [], []
    for level, here in levels:
        each = here.hausdorff_mm[np.isfinite(here.hausdorff_mm)]
        if len(each) < len(here):
            lost.append(level)
        median = by_seed(here, "hausdorff_mm").mean()
        if np.isfinite(median):
            low, middle, high = (max(v, _LEAST_MM) for v in (each.min(), median, each.max()))
            middles.append((level, middle, max(middle - low, 0.0), max(high - middle, 0.0)))
    if middles:
        x, y, below, above = zip(*middles, strict=True)
        thin: dict[str, Any] = {"markersize": 5, "capsize": 2, "lw": 1.6, "elinewidth": 0.8}
        axes.errorbar(x, y, (below, above), **thin, **style)
    cross: dict[str, Any] = {"color": style["color"], "linestyle": "", "marker": "x"}
    axes.plot(lost, [0.97] * len(lost), transform=axes.get_xaxis_transform(), **cross)


def gallery(jobs: list[Job], path: Path) -> None:
    """The estimate over the truth, seen from the side: a row for each variant, a column for each
    method of these jobs of one case. Raises InputError: a scene cannot be read."""
    methods = list({id(job.method): job.method for job in jobs}.values())
    scenes = list(dict.fromkeys((job.variant, job.view) for job in jobs))
    columns = min(4, 2 * len(methods))  # of the legend: each takes up to 2.2 inches
    top = 0.7 + 0.25 * (4 // columns)
    total = len(scenes) * 2.75 + top
    drawing = new_figure(4.4 * len(methods) + 0.5, total)
    panels = drawing.subplots(len(scenes), len(methods), squeeze=False)
    drawing.subplots_adjust(
        left=0.045, right=0.99, top=1 - top / total, bottom=0.1 / total, wspace=0.04, hspace=0.16
    )
    bold: dict[str, Any] = {"fontweight": "bold"}
    for axes, method in zip(panels[0], methods, strict=True):
        label, place = label_of(method.identity["name"]), {"transform": axes.transAxes}
        axes.text(0.5, 1.17, label, ha="center", fontsize=12, **place, **bold)
    for row, (variant, view) in zip(panels, scenes, strict=True):
        scene = read_scene(jobs[0].case.scene(variant, view))
        row[0].set_ylabel(variant, fontsize=13, **bold)
        for axes, method in zip(row, methods, strict=True):
            estimate = None
            with contextlib.suppress(NoEstimate, InputError):
                estimate = method.locate(scene, jobs[0].grid).estimate
            title = _numbers(estimate, scene) if estimate else "nothing found"
            draw_solid_view(axes, scene, estimate, FROM_SIDE)
            axes.set_title(title, fontsize=9.5)
    show_legend(drawing, scene_legend(), columns, (0.99, 0.999))
    save(drawing, path)


def _numbers(estimate: Estimate, scene: Scene) -> str:
    parts = {name: part for name, part in compare(estimate, scene).items() if name != of.ORGAN}
    return "Hausdorff: " + ", ".join(
        f"{spaced(name)} " + (f"{part['hausdorff_mm']:.1f} mm" if part["found"] else "not found")
        for name, part in parts.items()
    )


def _tidy(axes: Axes) -> None:
    """A light grid, and no more frame than needed."""
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.6")
    axes.tick_params(color="0.6")
