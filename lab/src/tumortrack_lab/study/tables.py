"""Measurements as one tidy table (a row for each scene and part), and Markdown tables of it.

Accuracy is told by organ, tumor and state: never pooled over organs, and with the worst. In the
table, and in every figure, infinite means not found. Every number comes from a measurement.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pandas as pd

from tumortrack_lab.study.document import table
from tumortrack_lab.study.tumor_sites import TumorSite

NOT_FOUND, NOTHING, EMPTY = "not found", "–", ""
ORGAN = "kidney"  # its rows stand for their scenes
_DISTANCES = ["hausdorff_mm", "center_mm", "target_mm"]
_NAMES = ["case", "method", "variant", "part"]
METHODS = {
    "rigid_bound": "best rigid pose (oracle)",
    "rigid": "rigid registration, many starts",
    "elastic": "linear-elastic surface fit",
}
Sites = dict[str, TumorSite]


def tidy(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """One row for each scene and part; ``carries``: whether the method carries points."""
    frame = pd.DataFrame(rows)
    frame = frame.reindex(columns=[*dict.fromkeys([*frame.columns, *_DISTANCES])])
    frame["carries"] = frame.target_mm.notna()
    frame[_DISTANCES] = frame[_DISTANCES].astype(float).fillna(np.inf)
    return ordered(frame, _NAMES)


def ordered(frame: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Columns that sort, and group, in the order in which their values first appear."""
    return frame.assign(**{key: pd.Categorical(frame[key], frame[key].unique()) for key in columns})


def groups(frame: pd.DataFrame, *keys: str) -> Iterator[tuple[tuple, pd.DataFrame]]:
    """The rows of each combination of values that there is."""
    return iter(frame.groupby(list(keys), observed=True))


def names(frame: pd.DataFrame, key: str) -> list[str]:
    """Distinct values of a column, in the order of the table's."""
    return [name for (name,), _ in groups(frame, key)]


def tumors(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[frame.part != ORGAN]


def scenes(frame: pd.DataFrame) -> pd.DataFrame:
    """One row for each scene and seed."""
    return frame[frame.part == ORGAN]


def is_deformed(frame: pd.DataFrame) -> pd.Series:
    """Neither at rest nor turned only."""
    return ~frame.variant.astype(str).str.fullmatch("D0|Rot.*")


def label_of(method: str) -> str:
    return METHODS.get(method, method)


def spread(values: pd.Series, digits: int = 1, high: bool = False) -> str:
    """``median / 90 % / 95 % / worst``: so many are no worse than this (nearest rank); ``high``:
    the lowest is the worst."""
    if values.empty:
        return NOTHING
    each = np.sort(values)[::-1] if high else np.sort(values)
    ranked = [each[-(-len(each) * percent // 100) - 1] for percent in (90, 95, 100)]
    figures = (np.median(each), *ranked)
    return " / ".join(NOT_FOUND if np.isinf(v) else f"{v:.{digits}f}" for v in figures)


def accuracy(frame: pd.DataFrame, sites: Sites) -> str:
    """One case: a row for each state, tumor and figure, a column for each method; each scene of
    each seed counts."""
    rows: list[list[str]] = []
    for state, mine in (("deformed", is_deformed(frame)), ("undeformed", ~is_deformed(frame))):
        each = [frame[mine & (frame.method == method)] for method in names(frame, "method")]
        if not mine.any():
            continue
        for number, (figure, cell) in enumerate(_figures(frame, sites).items()):
            rows.append([EMPTY if number else state, figure, *map(cell, each)])
    head = ["state", "figure", *map(label_of, names(frame, "method"))]
    return table(head, rows, left=2)


def _figures(frame: pd.DataFrame, sites: Sites) -> dict[str, Callable[[pd.DataFrame], str]]:
    def distance(tumor: str, key: str) -> Callable[[pd.DataFrame], str]:
        return lambda mine: spread(mine[mine.part == tumor][key])

    figures = {"scenes x seeds": lambda mine: f"{mine.variant.nunique()} x {mine.seed.nunique()}"}
    for tumor in names(tumors(frame), "part"):
        for words, key in (("HD", "hausdorff_mm"), ("centre", "center_mm")):
            figures[f"tumor {sites[tumor].text(tumor)}: {words}"] = distance(tumor, key)
    return figures | {
        "target error": lambda mine: spread(scenes(mine[mine.carries]).target_mm),
        "mIoU": lambda mine: spread(scenes(mine).miou, 2, high=True),
        "scenes with a part not found": lambda mine: str(scenes(mine).failed.sum()),
    }


def sites_text(case: str, sites: Sites) -> str:
    each = [
        f"{name.replace('_', ' ')} is {site.kind} ({100 * site.exposed_share:.0f} % of its surface "
        f"is the organ's own, least cover {site.cover_mm:.1f} mm)"
        for name, site in sites.items()
    ]
    return f"{case}: " + "; ".join(each) + "."


def caption(rows: list[dict[str, Any]], command: str) -> str:
    """What stands below a block: of what, where and when."""
    frame = pd.DataFrame(rows)
    count = len(frame.drop_duplicates(["case", "method", "seed", "variant"]))
    loads, seeds = frame.load.dropna(), _listed(frame.seed)
    return (
        f"`{command}`: {count} measurements (view: {_listed(frame.view)}), volumes of "
        f"{_listed(frame.grid, '{}³')} voxels at most, models by seed {seeds}. Measured on "
        f"{_listed(frame.on)}, {_listed(frame.when)}, load average {loads.min():.1f} to "
        f"{loads.max():.1f}."
    )


def _listed(items: Iterable[object], form: str = "{}") -> str:
    return ", ".join(map(form.format, sorted(set(items))))  # type: ignore[type-var]
