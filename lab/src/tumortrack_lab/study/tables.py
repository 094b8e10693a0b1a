"""Measurements as one tidy table (a row for each scene and part), and statistics of it.

Accuracy is given by organ, tumor and state: never pooled over organs, and with the worst. Infinite
means not found.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from tumortrack_lab.study.tumor_sites import TumorSite

NOT_FOUND, NOTHING, EMPTY = "not found", "–", ""
HD, CENTER = "Hausdorff, mm", "centre, mm"
ORGAN = "kidney"  # its rows stand for their scenes
_DISTANCES = ["hausdorff_mm", "center_mm", "target_mm"]
_NAMES = ["case", "method", "variant", "part"]
METHODS = {
    "rigid_bound": "best rigid pose",
    "rigid_fit": "rigid fit",
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


def spread(values: pd.Series, digits: int = 1, high: bool = False) -> dict[str, str]:
    """Median, and so many are no worse than this (nearest rank); ``high``: the lowest is the
    worst."""
    if values.empty:
        return {}
    each = np.sort(values)[::-1] if high else np.sort(values)
    ranked = [each[-(-len(each) * percent // 100) - 1] for percent in (90, 95, 100)]
    figures = dict(
        zip(("median", "90 %", "95 %", "worst"), (np.median(each), *ranked), strict=True)
    )
    return {k: NOT_FOUND if np.isinf(v) else f"{v:.{digits}f}" for k, v in figures.items()}


def accuracy(frame: pd.DataFrame, sites: dict[str, Sites]) -> pd.DataFrame:
    """A row for each organ, method, state (all deformed ones, each of them, and the others), part
    and figure; each scene of each seed counts."""
    # Neither at rest nor turned only.
    bent, rows = ~frame.variant.astype(str).str.fullmatch("D0|Rot.*"), []
    each = frame[bent].assign(state=frame.variant.astype(str))
    every = pd.concat([frame.assign(state=np.where(bent, "deformed", "undeformed")), each])
    for (case, method, state), mine in every.groupby(["case", "method", "state"], observed=True):
        whole, tumors = mine[mine.part == ORGAN], mine[mine.part != ORGAN]
        about = {"organ": case, "state": state, "method": METHODS.get(method, method)}
        about |= {"scenes": mine.variant.nunique(), "seeds": mine.seed.nunique()}
        about |= {"scenes with a part not found": whole.failed.sum()}
        for part, part_rows in tumors.groupby("part", observed=True):
            site = sites[case][part]
            lies = {"part": part, "kind": site.kind, "cover mm": f"{site.cover_mm:.1f}"}
            lies["on the surface %"] = f"{100 * site.exposed_share:.0f}"
            rows.append(about | lies | {"figure": HD} | spread(part_rows.hausdorff_mm))
            rows.append(about | lies | {"figure": CENTER} | spread(part_rows.center_mm))
        carried, overlap = spread(whole[whole.carries].target_mm), spread(whole.miou, 2, high=True)
        rows.append(about | {"part": "organ", "figure": "target error, mm"} | carried)
        rows.append(about | {"part": "all", "figure": "mIoU"} | overlap)
    return pd.DataFrame(rows).fillna(EMPTY)


def accuracy_summary(rows: pd.DataFrame) -> pd.DataFrame:
    """A row for each tumor of a deformed organ: clinic beside the best rigid pose and a rigid fit
    that starts there. Of what was not measured: ``NOTHING``."""
    some = rows[(rows.state == "deformed") & (rows.kind != EMPTY)]
    some = some.assign(shown=some["median"] + " / " + some["worst"])
    wide = some.pivot(index=["organ", "part", "kind"], columns=["figure", "method"], values="shown")
    methods = "clinic", METHODS["rigid_bound"], METHODS["rigid_fit"]
    shown = [(figure, method) for figure in (HD, CENTER) for method in methods]
    wide = wide.reindex(columns=pd.MultiIndex.from_tuples(shown)).astype(object).fillna(NOTHING)
    wide.columns = [f"{figure}, median / worst: {method}" for figure, method in shown]
    return wide.reset_index()


def sample(rows: list[dict[str, Any]]) -> str:
    """What was measured."""
    frame = pd.DataFrame(rows)
    count = len(frame.drop_duplicates(["case", "method", "seed", "variant"]))
    return (
        f"{count} measurements (view: {_listed(frame.view)}), volumes of "
        f"{_listed(frame.grid, '{}³')} voxels at most, models by seed {_listed(frame.seed)}"
    )


def _listed(items: Iterable[object], form: str = "{}") -> str:
    return ", ".join(map(form.format, sorted(set(items))))  # type: ignore[type-var]
