"""The goals, with what was measured beside each: the paper, peers, our presets, the bounds.

Every number is first averaged over the seeds of networks (none where one seed has none), then
taken over variants and cases. Whether a goal is met is decided by the exact number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import get_args

import pandas as pd

from tumortrack_lab.study.document import table
from tumortrack_lab.study.methods import CLINIC
from tumortrack_lab.study.paper import Kind, Lie, hausdorff
from tumortrack_lab.study.tables import EMPTY, NOT_FOUND, NOTHING, label_of, names, scenes, tumors

RULE = (
    "Distances in mm. Medians over cases and variants (and tumors, where a case has several), "
    "numbers of networks averaged over their seeds before; a part that was not found counts as "
    "infinitely far. Deformed variants are those that are neither turned only nor at rest. HD is "
    "the symmetric distance, one-sided the paper's, from the estimate to the truth. Numbers of "
    f"{CLINIC} are rounded to its disadvantage, and its goals judged by the unrounded ones. Hidden "
    "surface: median error with 40 % of the visible surface hidden over the median error without, "
    "both on clean depth. Bounds: our elastic body fitted to the true places of the visible "
    "surface, and of all surfaces, in least squares: a single distance may come out below them. "
    "Training: the longest of the models, by the wall clock of a machine with the load said here, "
    "without the seconds that building the elastic body takes; for the surface fit its preparation."
)
_GOALS_MM = {"exophytic": (1.5, 2.0, 3.0), "endophytic": (2.0, 3.0, 4.0)}
_TRAINING_MIN = {"cpu": 15.0, "H100": 2.0}  # by device


@dataclass(frozen=True)
class StudyGoal:
    """One figure: how it is read from one method's rows (infinite: not found; NaN: not measured),
    and what it should be at most (or at least, ``high``)."""

    text: str
    read: Callable[[pd.DataFrame], float]
    limit: float | None = None
    paper: str = EMPTY
    high: bool = False

    def value(self, frame: pd.DataFrame) -> str:
        value = self.read(frame)
        if not math.isfinite(value):
            return NOTHING if math.isnan(value) else NOT_FOUND
        return f"{value:.2f}"

    def ours(self, frame: pd.DataFrame) -> tuple[str, str]:
        """The number rounded to its disadvantage, and ``yes`` or ``no``; nothing where nothing was
        measured or there is no goal."""
        value, away = self.read(frame), math.floor if self.high else math.ceil
        shown = f"{away(round(value * 100, 6)) / 100:.2f}" if math.isfinite(value) else None
        if self.limit is None or math.isnan(value):
            return shown or self.value(frame), NOTHING
        met = value >= self.limit if self.high else value <= self.limit
        return shown or self.value(frame), "yes" if met and math.isfinite(value) else "no"


def goal_tables(frame: pd.DataFrame, lies: dict[str, dict[str, Lie]]) -> str:
    """The goals with every method, then each case by itself. ``lies``: by case and tumor."""
    kinds = [lies[case][part].kind if part in lies[case] else EMPTY
             for case, part in zip(frame.case, frame.part, strict=True)]  # fmt: skip
    frame = frame.assign(lie=kinds)
    by_method = {name: frame[frame.method == name] for name in names(frame, "method")}
    own = by_method.pop(CLINIC, frame[:0])
    bounds = {name: mine for name, mine in by_method.items() if "bound" in name}
    before = {name: mine for name, mine in by_method.items() if name not in bounds}
    head = ["figure", "paper", *map(label_of, before), CLINIC, "goal", "met"]
    cases, rows, each = names(own, "case"), [], []
    for goal in goals_of(own):
        ours, met = goal.ours(own)
        limit = EMPTY if goal.limit is None else f"{'≥' if goal.high else '≤'} {goal.limit:g}"
        theirs = [[goal.value(mine) for mine in some.values()] for some in (before, bounds)]
        rows.append([goal.text, goal.paper, *theirs[0], ours, limit, met, *theirs[1]])
        by_case = [goal.ours(own[own.case == case]) for case in cases]
        texts = [value if met == NOTHING else f"{value} ({met})" for value, met in by_case]
        each.append([goal.text, *texts])
    whole = table([*head, *map(label_of, bounds)], rows)
    return f"{whole}\n\nEach case of {CLINIC}:\n\n{table(['figure', *cases], each)}"


def goals_of(own: pd.DataFrame) -> list[StudyGoal]:
    """Every goal; that of training depends on the device that trained our own."""
    goals = []
    for kind in get_args(Kind):
        for variant, limit in zip(("D1", "D2", "D3"), _GOALS_MM[kind], strict=True):
            theirs = hausdorff(variant, "M_lim", kind)
            for words, key in (("one-sided", "hausdorff_one_sided_mm"), ("HD", "hausdorff_mm")):
                read = partial(_distance, variant=variant, kind=kind, key=key)
                shown = theirs.text if theirs and words == "one-sided" else EMPTY
                goals.append(StudyGoal(f"tumor {words}, {variant}, {kind}", read, limit, shown))
    deformed = partial(_noisy, deformed=True)
    return [
        *goals,
        StudyGoal("tumor centre, worst variant of any case",
                  lambda f: _per_scene(tumors(_noisy(f)), "center_mm").max(), 2.5, "< 10"),
        StudyGoal("mIoU, deformed variants",
                  lambda f: _per_scene(scenes(deformed(f)), "miou").median(), 0.90, "0.71", True),
        StudyGoal("mIoU, all variants",
                  lambda f: _per_scene(scenes(_noisy(f)), "miou").median(), 0.90, high=True),
        StudyGoal("target error, deformed variants", lambda f: _targets(deformed(f)).median(), 2.0),
        StudyGoal("target error, all variants", lambda f: _targets(_noisy(f)).median(), 2.0),
        StudyGoal("target error, worst variant of any case", lambda f: _targets(_noisy(f)).max()),
        StudyGoal("hidden surface: tumor HD, times",
                  partial(_ratio, of=lambda f: _per_scene(tumors(f), "hausdorff_mm")), 1.3),
        StudyGoal("hidden surface: target error, times", partial(_ratio, of=_targets), 1.3),
        StudyGoal("training, minutes",
                  lambda f: scenes(f[f.kind != "bound"]).prepare_s.max() / 60,
                  _training_limit(own), "120 (RTX 4090)"),
        StudyGoal("scenes with a part not found, %",
                  lambda f: 100 * scenes(_noisy(f)).failed.mean()),
    ]  # fmt: skip


def _noisy(frame: pd.DataFrame, deformed: bool = False) -> pd.DataFrame:
    """The scenes without further faults; ``deformed``: neither at rest nor turned only."""
    here = frame[frame.fault == "none"]
    still = here.variant.astype(str).str.fullmatch("D0|Rot.*")
    return here[~still] if deformed else here


def _per_scene(frame: pd.DataFrame, column: str) -> pd.Series:
    """For each scene and part the mean over the method's seeds; infinite where a seed has none."""
    keys = ["case", "scene", "fault", "fault_seed", "part"]
    return frame.groupby(keys, observed=True)[column].mean()


def _distance(frame: pd.DataFrame, variant: str, kind: str, key: str) -> float:
    """Of tumors of a kind in a variant: median over cases and tumors."""
    here = _noisy(frame)
    return _per_scene(here[(here.variant == variant) & (here.lie == kind)], key).median()


def _targets(frame: pd.DataFrame) -> pd.Series:
    return _per_scene(scenes(frame if frame.carries.any() else frame[:0]), "target_mm")


def _ratio(frame: pd.DataFrame, of: Callable[[pd.DataFrame], pd.Series]) -> float:
    above = of(frame[frame.fault.astype(str).str.contains("=")]).median()
    below = of(frame[frame.fault == "clean"]).median()
    if math.isnan(above + below):
        return math.nan
    return above / below if 0 < below < math.inf else math.inf


def _training_limit(own: pd.DataFrame) -> float | None:
    """The goal on the device that trained, if there is one for it."""
    devices = own.device.unique()
    limits = [v for device in devices for key, v in _TRAINING_MIN.items() if key in device]
    return limits[0] if len(limits) == len(devices) == 1 else None
