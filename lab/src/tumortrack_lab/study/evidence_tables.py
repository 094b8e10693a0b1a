"""Tables of what evidence brings, from the rows of ``tumortrack_lab.study.evidence``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D

from tumortrack.report import drawing
from tumortrack_lab.study.evidence import WRONG
from tumortrack_lab.study.tables import NOTHING


def errors(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each kind of evidence; of held tumors themselves, also of the pulled ones alone,
    beside what they are without."""
    own = rows[rows.organ == "own"]
    held, some = own.kind.str.startswith("held"), [own[~own.kind.str.startswith("held")]]
    for name, mine in (("", own), ("pulled, ", own[own.family == "pull"])):
        theirs = mine[(mine.tumor == mine.held) & (held[mine.index] | (mine.kind == "none"))]
        beside = theirs.kind.replace("none", "none, of the held tumor")
        some.append(theirs.assign(kind=name + beside))
    groups = pd.concat(some).groupby("kind", sort=False)
    return pd.DataFrame([_errors(name, group) for name, group in groups])


def _errors(name: str, some: pd.DataFrame) -> dict[str, Any]:
    answers = some[some.quality != "none"]
    scenes = answers.drop_duplicates(["kidney", "scene", "kind"])
    good = answers[answers.quality == "good"]
    miss, false = answers.miss_mm, scenes.false.sum()
    true = scenes.pieces.sum() - false
    return {
        "kind": name,
        "tumors": len(some),
        "answers %": _percent(len(answers), len(some)),
        "good %": _percent(len(good), len(some)),
        "poor by evidence left out %": _percent((some.finding == "evidence").sum(), len(some)),
        "median, mm": _rounded(miss.median()),
        "95 %": _rounded(miss.quantile(0.95)),
        "worst": _rounded(miss.max()),
        "of good: median": _rounded(good.miss_mm.median()),
        "its 95 %": _rounded(good.miss_mm.quantile(0.95)),
        "rigid fit: median": _rounded(answers.rigid_mm.median()),
        "its 95 %, mm": _rounded(answers.rigid_mm.quantile(0.95)),
        "false left out %": _percent(scenes.false_out.sum(), false),
        "true left out %": _percent(scenes.true_out.sum(), true),
    }


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Errors of tumors' centres against the number of touches, as advised and at random: what half
    and 95 % of all answers keep."""
    own, figure = (
        rows[(rows.organ == "own") & (rows.quality != "none")],
        drawing.new_figure(6.4, 3.4),
    )
    axes, lines = figure.add_axes((0.09, 0.14, 0.89, 0.72)), list[Line2D]()
    for way, color in (("chosen", "C1"), ("random", "C0")):
        pattern = rf"^(\d+) touches, {way}$"
        count = own.kind.str.extract(pattern)[0].where(own.kind != "none", "0").astype(float)
        of = own.groupby(count).miss_mm
        for share, style in ((0.95, "-"), (0.5, "--")):
            axes.plot(of.quantile(share), style, marker="o", color=color, markersize=4)
        lines.append(Line2D([], [], color=color, label=way))
    lines.append(Line2D([], [], color="0.4", linestyle="-", label="95 % within"))
    lines.append(Line2D([], [], color="0.4", linestyle="--", label="median"))
    axes.set(xlabel="touches", ylabel="error of a tumor's centre, mm", ylim=(0, None))
    drawing.show_legend(figure, lines, 4, (0.98, 1.0))
    drawing.save(figure, path)


def foresight(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each three touches that were advised: deviations foreseen, errors found (root mean
    square), both along the axis that was least sure, and the found share of the foreseen gain."""
    told = rows[rows.then_std_mm.notna()].drop_duplicates(["kidney", "scene", "kind"])
    lines = []
    for kind, some in told.groupby("kind", sort=False):
        ratio = (some.off_before_mm - some.off_after_mm) / (some.std_mm - some.then_std_mm)
        lines.append({
            "with": kind,
            "advised": len(some),
            "foreseen before, mm": _rounded(_root_mean_square(some.std_mm), 2),
            "and after": _rounded(_root_mean_square(some.then_std_mm), 2),
            "found before, mm": _rounded(_root_mean_square(some.off_before_mm), 2),
            "found after": _rounded(_root_mean_square(some.off_after_mm), 2),
            "found before, median": _rounded(some.off_before_mm.median(), 2),
            "after, median": _rounded(some.off_after_mm.median(), 2),
            "found/foreseen gain: median": _rounded(ratio.median(), 2),
            "10 %": _rounded(ratio.quantile(0.1)),
            "90 %": _rounded(ratio.quantile(0.9)),
        })  # fmt: skip
    return pd.DataFrame(lines)


def verdicts(rows: pd.DataFrame) -> pd.DataFrame:
    """How often the own organ, its mirror image and another one are called good, by evidence."""
    scenes = rows[rows.kind.isin(WRONG)].drop_duplicates(["kidney", "scene", "organ", "kind"])
    lines = []
    for organ, some in scenes.groupby("organ", sort=False):
        line = {"organ": organ, "scenes": int((some.kind == WRONG[0]).sum())}
        for kind in WRONG:
            mine = some[some.kind == kind].quality
            line[f"good %: {kind}"] = _percent((mine == "good").sum(), len(mine))
        lines.append(line)
    return pd.DataFrame(lines)


def _root_mean_square(values: pd.Series) -> float:
    return float(np.sqrt((values**2).mean()))


def _percent(count: float, of: float) -> str:
    return f"{100 * count / of:.0f}" if of else NOTHING


def _rounded(value: float, digits: int = 1) -> str:
    return NOTHING if np.isnan(value) else f"{value:.{digits}f}"
