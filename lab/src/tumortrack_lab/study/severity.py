"""Error against the severity of one fault: a panel and rows of a table for each kind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.study.figures import Value, figure, names, part_value, pick
from tumortrack_lab.study.markdown import table
from tumortrack_lab.study.plots import OTHER_STYLE, STYLES, tidy
from tumortrack_lab.study.tables import (
    EMPTY,
    failed_text,
    label_of,
    miou_text,
    target_text,
    tumors_of,
)
from tumortrack_lab.twin.faults import KINDS, clean_level, parse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "noise": "sensor noise, times the D405's",
    "visible": "visible surface left, %",
    "outliers": "background points, %",
    "points": "points of the cloud",
    "offset": "depth offset, mm",
    "distance": "distance of the camera, mm",
    "tilt": "tilt of the camera, degrees",
}
RULE = (
    "they are over the states and the random draws of the fault. Most kinds have "
    "the clean scenes as one level; distance has not. Target error: mean over the scene's inner "
    "targets, for methods that carry points. Bars in the picture reach to the best and the worst "
    "scene, a cross at the top is a level where some scene's tumor was not found."
)
_FALLING = ("visible", "points")  # less is more severe
_DASHES: tuple[Literal["-", "--", ":", "-."], ...] = ("-", "--", ":", "-.")
_LEAST_MM = 0.1  # the scale is logarithmic
_TICKS_MM = (1, 2, 5, 10, 20, 50)
_COLUMNS = 4
_PANEL_IN = (3.1, 2.75)


def levels_of(cells: list[dict], kind: str) -> list[tuple[float, list[dict]]]:
    """The cells of each level of a kind, from mild to severe, the clean scene among them."""
    by_level: dict[float, list[dict]] = {}
    for fault in names(cells, "fault"):
        severity = parse(fault)
        if severity is not None and severity.kind == kind:
            by_level[severity.level] = pick(cells, fault=fault)
    clean, at = pick(cells, fault="clean"), clean_level(kind)
    if by_level and clean and at is not None:
        by_level[at] = clean
    return sorted(by_level.items(), reverse=kind in _FALLING)


def table_of(cells: list[dict]) -> str:
    """One row for each method, kind and level."""
    tumors = tumors_of(cells)
    keys = {"one-sided HD": "hausdorff_one_sided_mm", "HD": "hausdorff_mm", "centre": "center_mm"}
    head = ["method", "severity", "level"]
    head += [f"{tumor.replace('_', ' ')} {what}" for tumor in tumors for what in keys]
    head += ["target error", "mIoU", "failed"]
    rows = []
    for method in names(cells, "method"):
        mine = pick(cells, method=method)
        for kind in KINDS:
            for number, (level, here) in enumerate(levels_of(mine, kind)):
                first = [label_of(method), LABELS[kind]] if number == 0 else [EMPTY, EMPTY]
                row = [*first, f"{level:g}"]
                for tumor in tumors:
                    row += [figure(here, part_value(tumor, k)).text() for k in keys.values()]
                rows.append(row + _whole_scene(here))
    return table(head, rows, left=2)


def _whole_scene(cells: list[dict]) -> list[str]:
    return [target_text(cells), miou_text(cells), failed_text(cells)]


def curves(cells: list[dict], path: Path) -> None:
    """Hausdorff distance of each tumor against each kind's level, a panel for each kind, by
    ``RULE``. Errors are on a logarithmic scale, for what matters is by which factor they grow.

    Raises:
        StorageError: the disk refused.
    """
    kinds = [kind for kind in KINDS if levels_of(cells, kind)]
    columns = min(_COLUMNS, max(len(kinds), 1))
    rows = -(-max(len(kinds), 1) // columns)
    width, height = _PANEL_IN
    total = rows * height + 0.45
    drawing = new_figure(columns * width + 0.35, total)
    panels = drawing.subplots(rows, columns, squeeze=False, sharey=True)
    drawing.subplots_adjust(
        left=0.6 / (columns * width), right=0.985, top=1 - 0.45 / total, bottom=0.5 / total,
        wspace=0.1, hspace=0.38,
    )  # fmt: skip
    for place, axes in enumerate(panels.flat):
        if place < len(kinds):
            _panel(axes, cells, kinds[place])
        else:
            axes.set_visible(False)
    panels[0, 0].set_yscale("log")
    panels[0, 0].set_yticks(_TICKS_MM, [str(tick) for tick in _TICKS_MM], minor=False)
    panels[0, 0].set_yticks([], minor=True)
    low, high = panels[0, 0].get_ylim()
    panels[0, 0].set_ylim(min(low, 0.9), max(high, 11.0))
    for row in panels:
        row[0].set_ylabel("tumor Hausdorff distance, mm")
    drawing.legend(
        handles=_legend(cells), loc="upper left", bbox_to_anchor=(0.04, 1.0), ncols=4,
        frameon=False, fontsize=10,
    )  # fmt: skip
    save(drawing, path)


def _panel(axes: Axes, cells: list[dict], kind: str) -> None:
    for method in names(cells, "method"):
        color, marker = STYLES.get(method, OTHER_STYLE)
        levels = levels_of(pick(cells, method=method), kind)
        for tumor, dashes in zip(tumors_of(cells), _DASHES, strict=False):
            value = part_value(tumor, "hausdorff_mm")
            _curve(axes, levels, value, {"color": color, "marker": marker, "linestyle": dashes})
    axes.set_xlabel(LABELS[kind])
    if kind in _FALLING:
        axes.invert_xaxis()
    tidy(axes)


def _curve(
    axes: Axes, levels: list[tuple[float, list[dict]]], value: Value, style: dict[str, Any]
) -> None:
    middles, lost = [], []
    for level, here in levels:
        each = [one for cell in here if (one := value(cell)) is not None]
        if len(each) < len(here):
            lost.append(level)
        median = figure(here, value).mean
        if median is not None:
            low, middle, high = (max(v, _LEAST_MM) for v in (min(each), median, max(each)))
            middles.append((level, middle, max(middle - low, 0.0), max(high - middle, 0.0)))
    if middles:
        x, y, below, above = zip(*middles, strict=True)
        thin: dict[str, Any] = {"markersize": 5, "capsize": 2, "lw": 1.6, "elinewidth": 0.8}
        axes.errorbar(x, y, (below, above), **thin, **style)
    cross: dict[str, Any] = {"color": style["color"], "linestyle": "", "marker": "x"}
    axes.plot(lost, [0.97] * len(lost), transform=axes.get_xaxis_transform(), **cross)


def _legend(cells: list[dict]) -> list:
    from matplotlib.lines import Line2D

    handles = []
    for method in names(cells, "method"):
        color, marker = STYLES.get(method, OTHER_STYLE)
        handles.append(Line2D([], [], color=color, marker=marker, lw=1.6, label=label_of(method)))
    for tumor, dashes in zip(tumors_of(cells), _DASHES, strict=False):
        label = tumor.replace("_", " ")
        handles.append(Line2D([], [], color="0.3", linestyle=dashes, lw=1.6, label=label))
    return handles
