"""The study's pictures: errors against depth and displacement.

Colours are Okabe and Ito's (told apart by every colour vision); each method also has a marker of
its own, so that the plots read in grey.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from tumortrack.report.drawing import new_figure, save
from tumortrack_lab.study.tables import groups, label_of

_STYLES = {
    "M_lim": ("#0072B2", "o"),
    "M_full": ("#E69F00", "s"),
    "clinic": ("#D55E00", "*"),
    "rigid_bound": ("#000000", "x"),
    "rigid": ("#7F7F7F", "v"),
    "elastic": ("#009E73", "P"),
}
_BANDS = 8  # groups of equally many points along a curve
_FEWEST = 40  # points in a group
_ALONG = {
    "depth_mm": "depth below the visible surface",
    "displacement_mm": "displacement left after the best rigid motion",
}


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
        order = np.argsort(x, kind="stable")
        color, marker = _STYLES.get(method, ("#56B4E9", "h"))
        parts = np.array_split(order, min(_BANDS, len(x) // (_FEWEST // 4)))
        at = np.array([np.median(x[part]) for part in parts])
        low, middle, high = np.transpose([np.percentile(error[p], (25, 50, 75)) for p in parts])
        highest = max(highest, 1.25 * float(middle.max()))
        if number < 2:
            axes.fill_between(at, low, high, color=color, alpha=0.13, linewidth=0)
        axes.plot(at, middle, linewidth=2, label=label_of(method), color=color, marker=marker)
    axes.set(xlabel=f"{_ALONG[key]}, mm", ylabel="distance to the estimated tumor surface, mm")
    axes.set_ylim(0, highest)  # bands may go beyond: a bad method must not flatten the others
    axes.set_xlim(left=0)
    axes.grid(axis="y", color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False, fontsize=9.5, alignment="left",
        title="median of each eighth of the points\n(band: middle half)", title_fontsize=9,
    )  # fmt: skip
    axes.set_title(f"Tumor error against {_ALONG[key]}", loc="left", fontsize=12)
    save(drawing, path)
    return True
