"""Plots of the study: error against depth and displacement, and per variant beside the paper.

Colours are Okabe and Ito's (told apart by every colour vision); each method also has a marker of
its own, so that the plots read in grey.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.study import paper
from tumortrack_lab.study.figures import figure, names, part_value, pick
from tumortrack_lab.study.tables import label_of, tumors_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STYLES = {
    "M_lim": ("#0072B2", "o"),
    "M_full": ("#E69F00", "s"),
    "clinic": ("#D55E00", "*"),
    "rigid_bound": ("#000000", "x"),
    "rigid": ("#7F7F7F", "v"),
    "cpd": ("#CC79A7", "^"),
    "bcpd": ("#56B4E9", "D"),
    "elastic": ("#009E73", "P"),
}
OTHER_STYLE = ("#56B4E9", "h")
_BANDS = 8  # groups of equally many points along a curve
_FEWEST = 40  # points in a group
_ALONG = {
    "depth_mm": "depth below the visible surface",
    "displacement_mm": "displacement left after the best rigid motion",
}


def error_against(cells: list[dict], key: str, path: Path) -> bool:
    """Error of points of the tumors' true surfaces against ``depth_mm`` or ``displacement_mm``:
    medians of groups of equally many points, the middle half shaded for the first two methods.

    Returns False, and draws nothing, where no cell has such points.
    """
    curves = {method: _points(pick(cells, method=method), key) for method in names(cells, "method")}
    curves = {name: curve for name, curve in curves.items() if len(curve[0]) >= _FEWEST}
    if not curves:
        return False
    highest = 1.0
    drawing = new_figure(9.4, 4.6)
    axes = drawing.add_axes((0.075, 0.125, 0.6, 0.8))
    for number, (method, (x, error)) in enumerate(curves.items()):
        color, marker = STYLES.get(method, OTHER_STYLE)
        at, low, middle, high = _grouped(x, error)
        highest = max(highest, 1.25 * float(middle.max()))
        if number < 2:
            axes.fill_between(at, low, high, color=color, alpha=0.13, linewidth=0)
        axes.plot(at, middle, color=color, marker=marker, linewidth=2, label=label_of(method))
    axes.set(xlabel=f"{_ALONG[key]}, mm", ylabel="distance to the estimated tumor surface, mm")
    axes.set_ylim(0, highest)  # bands may go beyond: a bad method must not flatten the others
    axes.set_xlim(left=0)
    tidy(axes)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(1.02, 1.0),
        frameon=False,
        fontsize=9.5,
        title="median of each eighth of the points\n(band: middle half)",
        title_fontsize=9,
        alignment="left",
    )
    axes.set_title(f"Tumor error against {_ALONG[key]}", loc="left", fontsize=12)
    save(drawing, path)
    return True


def error_per_variant(cells: list[dict], lies: dict[str, paper.Lie], path: Path) -> None:
    """One-sided Hausdorff distance of each tumor per variant and model, mean and spread over the
    seeds, with the paper's figures as open marks (a bar with an arrow: its upper bound)."""
    tumors, variants = tumors_of(cells), names(cells, "variant")
    drawing = new_figure(4.6 * len(tumors) + 2.4, 4.6)
    panels = drawing.subplots(1, len(tumors), sharey=True, squeeze=False)[0]
    narrow = len(tumors) == 1  # its legend takes two rows
    drawing.subplots_adjust(
        left=0.1 if narrow else 0.07, right=0.985, top=0.8 if narrow else 0.85, bottom=0.08,
        wspace=0.06,
    )  # fmt: skip
    for axes, tumor in zip(panels, tumors, strict=True):
        models = names(cells, "method")
        for number, model in enumerate(models):
            shift = (number - (len(models) - 1) / 2) * 0.26
            mine = pick(cells, method=model)
            _variant_bars(axes, mine, tumor, shift)
            _paper_marks(axes, variants, model, lies[tumor].kind, shift)
        axes.set_xticks(range(len(variants)), variants)
        axes.set_title(f"{tumor.replace('_', ' ')}, {lies[tumor].kind}", loc="left", fontsize=11)
        for place in range(len(variants) - 1):
            axes.axvline(place + 0.5, color="0.93", linewidth=0.8, zorder=0)
        axes.set_xlim(-0.5, len(variants) - 0.5)
        tidy(axes)
    panels[0].set_ylim(bottom=0)  # after all panels: it ends the search for common limits
    panels[0].set_ylabel("Hausdorff distance, estimate to truth, mm")
    drawing.legend(
        handles=_legend(names(cells, "method")),
        loc="upper left",
        bbox_to_anchor=(0.06, 0.995),
        ncols=3 if narrow else 5,
        frameon=False,
        fontsize=10,
    )
    save(drawing, path)


def _variant_bars(axes: Axes, cells: list[dict], tumor: str, shift: float) -> None:
    model = cells[0]["spec"]["method"]["name"]
    color, marker = STYLES.get(model, OTHER_STYLE)
    value = part_value(tumor, "hausdorff_one_sided_mm")
    for place, variant in enumerate(names(cells, "variant")):
        number = figure(pick(cells, variant=variant), value)
        x = place + shift
        axes.scatter([x] * len(number.finite), number.finite, s=14, color=color, alpha=0.45, lw=0)
        if number.mean is None:
            axes.annotate("not\nfound", (x, 0), ha="center", va="bottom", fontsize=7.5, color=color)
            continue
        axes.errorbar(
            x,
            number.mean,
            number.spread,
            color=color,
            marker=marker,
            markersize=7,
            capsize=3,
            lw=1.6,
        )


def _paper_marks(
    axes: Axes, variants: list[str], model: str, kind: paper.Kind, shift: float
) -> None:
    color, marker = STYLES.get(model, OTHER_STYLE)
    for place, variant in enumerate(variants):
        said = paper.hausdorff(variant, model, kind)
        if said is None:
            continue
        x = place + shift + 0.1
        if said.sign == "<=":
            axes.plot([x - 0.1, x + 0.1], [said.value_mm] * 2, color=color, lw=1.6)
            axes.annotate(
                "",
                (x, said.value_mm - 1.4),
                (x, said.value_mm),
                arrowprops={"arrowstyle": "->", "color": color, "shrinkA": 0, "shrinkB": 0},
            )
        else:
            axes.plot(
                x,
                said.value_mm,
                marker=marker,
                linestyle="",
                markersize=8,
                markerfacecolor="white",
                markeredgecolor=color,
                markeredgewidth=1.6,
            )


def _legend(models: list[str]) -> list:
    from matplotlib.lines import Line2D

    handles = []
    for model in models:
        color, marker = STYLES.get(model, OTHER_STYLE)
        handles.append(
            Line2D([], [], color=color, marker=marker, markersize=7, lw=1.6, label=f"{model}, here")
        )
        handles.append(
            Line2D(
                [],
                [],
                marker=marker,
                markersize=8,
                linestyle="",
                markerfacecolor="white",
                markeredgecolor=color,
                markeredgewidth=1.6,
                label=f"{model}, paper (hydrogel)",
            )
        )
    bound = Line2D([], [], color="0.4", marker=r"$\downarrow$", markersize=9, lw=1.6)
    bound.set_label("paper: at most")
    return [*handles, bound]


def _points(cells: list[dict], key: str) -> tuple[np.ndarray, np.ndarray]:
    """All points of all tumors that have this key, and their errors."""
    columns = [
        (part[key], part["error_mm"])
        for cell in cells
        for part in cell["points"].values()
        if key in part
    ]
    if not columns:
        return np.zeros(0), np.zeros(0)
    x, error = zip(*columns, strict=True)
    return np.concatenate(x), np.concatenate(error)


def _grouped(
    x: np.ndarray, error: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of groups of equally many points: median place, and the quartiles of the error."""
    groups = np.array_split(np.argsort(x, kind="stable"), min(_BANDS, len(x) // (_FEWEST // 4)))
    at = np.array([np.median(x[group]) for group in groups])
    low, middle, high = (
        np.array([np.percentile(error[group], q) for group in groups]) for q in (25, 50, 75)
    )
    return at, low, middle, high


def tidy(axes: Axes) -> None:
    """A light grid, and no more frame than needed."""
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.spines["left"].set_color("0.6")
    axes.spines["bottom"].set_color("0.6")
    axes.tick_params(color="0.6")
