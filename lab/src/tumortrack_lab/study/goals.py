"""The goals of the preset clinic, and whether it meets them on each organ.

Of several seeds the worst counts. Whether a goal is met is decided by the exact number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import pandas as pd

from tumortrack_lab.study.document import table
from tumortrack_lab.study.methods import CLINIC
from tumortrack_lab.study.tables import (
    EMPTY,
    NOT_FOUND,
    NOTHING,
    Sites,
    is_deformed,
    names,
    scenes,
    tumors,
)
from tumortrack_lab.study.tumor_sites import Kind

RULE = (
    "Distances in mm; of the seeds, and of a case's tumors of a kind, the worst counts in every "
    "scene, then the median over the variants. A part that was not found counts as infinitely far. "
    "Deformed variants are those that are neither turned only nor at rest. HD is the symmetric "
    "distance. Beside each: that of the best rigid pose, an oracle. Numbers are rounded up (mIoU: "
    "down), and goals judged by the unrounded ones."
)
RIGID = "rigid_bound"
_GOALS_MM = {"exophytic": (1.5, 2.0, 3.0), "endophytic": (2.0, 3.0, 4.0)}


@dataclass(frozen=True)
class StudyGoal:
    """One figure: how it is read from one method's rows (infinite: not found; NaN: not measured),
    and what it should be at most (or at least, ``high``)."""

    text: str
    read: Callable[[pd.DataFrame], float]
    limit: float | None = None
    high: bool = False

    def ours(self, frame: pd.DataFrame) -> tuple[str, str]:
        """The number rounded to its disadvantage, and ``yes`` or ``no``; nothing where nothing was
        measured or there is no goal."""
        value, away = self.read(frame), math.floor if self.high else math.ceil
        if math.isnan(value):
            return NOTHING, NOTHING
        finite = math.isfinite(value)
        shown = f"{away(round(value * 100, 6)) / 100:.2f}" if finite else NOT_FOUND
        if self.limit is None:
            return shown, NOTHING
        met = value >= self.limit if self.high else value <= self.limit
        return shown, "yes" if met and finite else "no"


def goal_table(frame: pd.DataFrame, sites: dict[str, Sites]) -> str:
    """Every goal beside clinic and the best rigid pose on each case, never pooled: organs differ.
    ``sites``: by case and tumor."""
    kinds = [sites[case][part].kind if part in sites[case] else EMPTY
             for case, part in zip(frame.case, frame.part, strict=True)]  # fmt: skip
    frame = frame.assign(site=kinds)
    own, rigid = (frame[frame.method == name] for name in (CLINIC, RIGID))
    cases, rows = names(own, "case"), []
    for goal in GOALS:
        limit = EMPTY if goal.limit is None else f"{'≥' if goal.high else '≤'} {goal.limit:g}"
        row = [goal.text, limit]
        for case in cases:
            (value, met), (best, _) = (goal.ours(some[some.case == case]) for some in (own, rigid))
            row.append(f"{value}{f' ({met})' * (met != NOTHING)} / {best}")
        rows.append(row)
    return table(["figure", "goal", *(f"{case}: clinic / rigid" for case in cases)], rows)


def _deformed(frame: pd.DataFrame) -> pd.DataFrame:
    return frame[is_deformed(frame)]


def _per_scene(frame: pd.DataFrame, column: str, worst: Literal["min", "max"] = "max") -> pd.Series:
    """For each scene and part the worst of the seeds; infinite where a seed has none."""
    return frame.groupby(["case", "variant", "part"], observed=True)[column].agg(worst)


def _distance(frame: pd.DataFrame, variant: str, kind: str) -> float:
    """Of a case's tumors of a kind in a variant: the worst."""
    of_kind = frame[(frame.variant == variant) & (frame.site == kind)]
    return _per_scene(of_kind, "hausdorff_mm").max()


def _targets(frame: pd.DataFrame) -> pd.Series:
    return _per_scene(scenes(frame if frame.carries.any() else frame[:0]), "target_mm")


GOALS = (
    *(
        StudyGoal(f"tumor HD, {variant}, {kind}",
                  partial(_distance, variant=variant, kind=kind), limit)
        for kind in get_args(Kind)
        for variant, limit in zip(("D1", "D2", "D3"), _GOALS_MM[kind], strict=True)
    ),
    StudyGoal("tumor centre, worst variant",
              lambda f: _per_scene(tumors(f), "center_mm").max(), 2.5),
    StudyGoal("mIoU, deformed variants",
              lambda f: _per_scene(scenes(_deformed(f)), "miou", "min").median(), 0.90, True),
    StudyGoal("mIoU, all variants",
              lambda f: _per_scene(scenes(f), "miou", "min").median(), 0.90, True),
    StudyGoal("target error, deformed variants", lambda f: _targets(_deformed(f)).median(), 2.0),
    StudyGoal("target error, all variants", lambda f: _targets(f).median(), 2.0),
    StudyGoal("target error, worst variant", lambda f: _targets(f).max()),
    StudyGoal("scenes with a part not found, %", lambda f: 100 * scenes(f).failed.mean()),
)  # fmt: skip
